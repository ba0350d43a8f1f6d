"""Corruptions: what weather and faults do to a sweep.

Weather is shared: its parameters follow from the severity alone, so all agents of a frame are in the same fog or snow.
Faults are each sensor's own. Streams of randomness, children of the seed by spawn key:

| key                                       | what                                                  |
|-------------------------------------------|-------------------------------------------------------|
| (2, crc32 of kind, 1 + frame, agent)      | one agent's sweep in one frame                        |
| (2, crc32 of kind, 0, agent)              | a fault that stays for a drive (`Corruption.steady`)  |

(agent modulo 2^32). A corruption draws the same numbers at every severity, wherever that can be.
"""

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sensors.corruptions import beam_missing, cross_sensor, crosstalk, fog, motion_blur, snow
from sensors.corruptions.levels import PAPER, SEVERITIES, check_severity
from sensors.frame import Frame
from sensors.sweep import Sweep
from sim.errors import SettingsError, did_you_mean

__all__ = [
    "CLEAN",
    "CORRUPTIONS",
    "PAPER",
    "SEVERITIES",
    "Corruption",
    "check_corruption",
    "corrupt",
    "corrupt_frame",
    "corruption_rng",
]

CLEAN = "clean"
"""The kind that changes nothing."""

_STREAM = 2


@dataclass(frozen=True, slots=True)
class Corruption:
    """One kind of corruption.

    Attributes:
        settings: its parameters, a frozen struct whose defaults are the paper's, with `severity(level)`.
        apply: `apply(sweep, severity or settings, rng) -> Sweep`, never in place.
        steady: what it draws stays the same over a drive.
    """

    settings: type
    apply: Callable[..., Sweep]
    steady: bool = False


CORRUPTIONS: dict[str, Corruption] = {
    "beam_missing": Corruption(beam_missing.BeamMissing, beam_missing.corrupt, steady=True),
    "motion_blur": Corruption(motion_blur.MotionBlur, motion_blur.corrupt),
    "fog": Corruption(fog.Fog, fog.corrupt),
    "snow": Corruption(snow.Snow, snow.corrupt),
    "crosstalk": Corruption(crosstalk.Crosstalk, crosstalk.corrupt),
    "cross_sensor": Corruption(cross_sensor.CrossSensor, cross_sensor.corrupt),
}
"""The paper's six corruptions, in its order."""


def corrupt(sweep: Sweep, kind: str, severity: int, rng: np.random.Generator) -> Sweep:
    """Return the sweep as the sensor would have delivered it under a corruption; severity 3 is the paper's.

    Raises:
        SettingsError: an unknown kind or severity.
    """
    check_corruption(kind, severity)
    if kind == CLEAN:
        return sweep
    return CORRUPTIONS[kind].apply(sweep, severity, rng)


def corrupt_frame(frame: Frame, kind: str, severity: int, seed: int) -> Frame:
    """Corrupt the sweeps of all agents of a frame; ground truth and its point counts stay.

    Args:
        frame: as recorded.
        kind: key of `CORRUPTIONS`, or `clean`.
        severity: 1 to 5.
        seed: of the drive's corruption; frames may be corrupted in any order.

    Raises:
        SettingsError: an unknown kind or severity.
    """
    check_corruption(kind, severity)
    if kind == CLEAN:
        return frame
    streams = (corruption_rng(seed, kind, frame.index, agent.agent_id) for agent in frame.agents)
    return frame.with_sweeps(
        [corrupt(agent.sweep, kind, severity, rng) for agent, rng in zip(frame.agents, streams, strict=True)]
    )


def corruption_rng(seed: int, kind: str, index: int, agent_id: int) -> np.random.Generator:
    """Return the stream of one agent's sweep in one frame."""
    when = 0 if CORRUPTIONS[kind].steady else 1 + index
    key = (_STREAM, zlib.crc32(kind.encode()), when, agent_id % 2**32)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


def check_corruption(kind: str, severity: int = PAPER) -> None:
    """Raise SettingsError unless this kind, or `clean`, and this severity exist."""
    if kind != CLEAN and kind not in CORRUPTIONS:
        raise SettingsError(f"unknown corruption '{kind}'{did_you_mean(kind, [CLEAN, *CORRUPTIONS])}")
    if kind != CLEAN:
        check_severity(severity)
