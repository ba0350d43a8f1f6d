"""The door of drivers: any driver by the text that `--driver` takes."""

from collections.abc import Callable
from typing import cast

from dsrc.closed_loop.driving.anticipating import AnticipatingDriver
from dsrc.closed_loop.driving.careful import CarefulDriver
from dsrc.closed_loop.driving.evading import EvadingDriver
from dsrc.closed_loop.driving.own.process import START_S, ProcessDriver
from dsrc.closed_loop.driving.planner import PlanningDriver
from dsrc.closed_loop.types import Driver
from dsrc.detectors.classes import class_hash, load_own
from dsrc.detectors.line import process_sha256
from dsrc.detectors.texts import Kind, kind_of
from sim.errors import SettingsError, complaint, did_you_mean

DRIVERS: dict[str, Callable[[], Driver]] = {
    "planning": PlanningDriver,
    "anticipating": AnticipatingDriver,
    "evading": EvadingDriver,
    "careful": CarefulDriver,
}
"""Drivers by name."""
_OWN: tuple[Kind, ...] = ("class", "pipe", "tcp")


def open_driver(text: str, answer_s: float = 60.0) -> Driver:
    """Return a driver.

    Args:
        text: `planning`, `anticipating`, `evading`, `careful`, `module:Class` of one's own with `reset(lanes)` and
            `decide(ego, tracks)`, made without arguments, `pipe:COMMAND ...` or `tcp://localhost:PORT`, see
            `dsrc.closed_loop.driving.own.process`. Modules of the current folder are found.
        answer_s: longest time to an answer of a process, s.

    Raises:
        SettingsError: an unknown name, a class that does not load or lacks a method, or no process is named.
        DataError: the process does not answer.
    """
    if text in DRIVERS:
        return DRIVERS[text]()
    if not is_own(text):
        expected = f"{', '.join(DRIVERS)}, module:Class, pipe:COMMAND or tcp://localhost:PORT"
        raise SettingsError(complaint("driver", "name", expected, text, did_you_mean(text, DRIVERS)))
    if kind_of(text) == "class":
        return cast(Driver, load_own(text, "driver", "reset and decide", "reset+decide"))
    return ProcessDriver(text, answer_s)


def is_own(text: str) -> bool:
    """Whether a text names a driver of one's own: a class or a process."""
    return text not in DRIVERS and kind_of(text) in _OWN


def driver_sha256(text: str) -> str:
    """Return the SHA-256 of all that tells a driver of one's own from others, for the keys of its episodes.

    It is that of the name of a class and its source; of the command or address of a process, the name that it says,
    and the files among the command's words. "" of a shipped driver, which the hash of the code is of.

    Raises:
        DataError: the process does not answer.
    """
    if not is_own(text):
        return ""
    if kind_of(text) == "class":
        return class_hash(text)
    driver = ProcessDriver(text, START_S)
    driver.close()
    return process_sha256(text, driver.name)
