"""Run folder of a training: record of its settings, checkpoints, detector and result."""

import os
import platform
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import msgspec
import torch

from dsrc.runs.provenance import commit, versions
from dsrc.training.recipes import PARTS, Stage, of_today
from sim.errors import CheckpointError, DataError, SettingsError, complaint
from sim.files import write_file
from sim.reading import read_bytes

DETECTOR, SETTINGS, RESULT, ENVIRONMENT = "detector.pt", "settings.json", "result.json", "environment.json"
"""Files of a run folder."""
_WITHOUT_EFFECT = ("name", "alarm_after", "workers")
"""Fields of a recipe that do not change the detector."""
_OF_THE_CHOICE = ("validate_every", "validation_frames")
"""Fields that change the weights only where validations choose them, or the end of the training."""

State = Literal["new", "interrupted", "finished"]


class RecordedSettings(msgspec.Struct, frozen=True):
    """Recipe and stage of a run, the recipe as of the version that recorded it; see `of_today`."""

    recipe: dict[str, Any]
    stage: Stage


class Record(msgspec.Struct, frozen=True):
    """Record of a run, `settings.json`."""

    settings: RecordedSettings
    seed: int
    versions: dict[str, str]
    data: dict[str, str]
    folders: dict[str, str | None] = {}
    validation: dict[str, str] | None = None
    teacher: str | None = None
    init: dict[str, Any] | None = None


class RunFolder:
    """Run folder of one stage; its files are described in `dsrc.training.train.train`."""

    def __init__(self, path: Path) -> None:
        """Name the files of a folder; nothing is read or written."""
        self.path = path
        self.detector, self.settings, self.result = path / DETECTOR, path / SETTINGS, path / RESULT
        self.environment = path / ENVIRONMENT
        self.checkpoints = path / "checkpoints"
        self.last, self.best = self.checkpoints / "last.ckpt", self.checkpoints / "best.pt"

    def state(self, record: Mapping[str, object]) -> State:
        """Return the progress of the run that the folder holds.

        Raises:
            SettingsError: it was started with other settings, data, teacher or start than the record's, or the folder
                holds a detector alone, which a training would replace.
            CheckpointError: its last checkpoint is damaged.
        """
        finished = self.detector.exists() and self.result.exists()
        if not finished and not self.last.exists():
            if self.detector.exists():
                hint = "; choose another folder, or move the file away"
                found = "a detector without its run"
                raise SettingsError(complaint(self.detector, "output", "a new folder, or a run to resume", found, hint))
            return "new"
        self._check_same_run(record)
        if finished:
            return "finished"
        _check_archive(self.last)
        return "interrupted"

    def start(self, record: Mapping[str, object], anew: bool) -> None:
        """Write the record of a run.

        Args:
            record: its settings, seed, versions and hashes.
            anew: remove detector, result and checkpoints of an earlier run, which this one's would be taken for if it
                is interrupted before it writes its own.
        """
        if anew:
            self.detector.unlink(missing_ok=True)
            self.result.unlink(missing_ok=True)
            self.last.unlink(missing_ok=True)
            self.best.unlink(missing_ok=True)
        # A detector without its result is of a run that was interrupted between the two, and so is the record.
        if not self.detector.exists():
            write_json(self.settings, record)

    def note_environment(self, devices: int) -> None:
        """Append machine, libraries and commit to `environment.json`, unless its last entry is the same."""
        now = {
            "versions": versions(),
            "python": platform.python_version(),
            "platform": platform.platform(),
            "commit": commit(),
            "processor": _processor(),
            "cores": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "gpus": [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())],
            "devices": devices,
        }
        try:
            content = read_bytes(self.environment, "list of environments")
            before = msgspec.json.decode(content, type=list[dict[str, Any]])
        except (DataError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            before = []
        if before[-1:] != [now]:
            write_json(self.environment, [*before, now])

    def _check_same_run(self, record: Mapping[str, object]) -> None:
        if not self.settings.exists():
            hint = "; choose another folder or remove this one"
            raise SettingsError(
                complaint(self.settings, "file", "the settings of the run in this folder", "none", hint)
            )
        try:
            content = read_bytes(self.settings, "settings of a training", SettingsError)
            before, now = _decisive(msgspec.json.decode(content)), _decisive(record)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, KeyError, TypeError, AttributeError):
            found = complaint(self.settings, "file", "the settings of a training", "something else")
            raise SettingsError(found) from None
        for name in sorted(before.keys() & now.keys()):
            if before[name] != now[name]:
                hint = "; choose another folder or remove this one"
                expected = f"{now[name]} as asked for now"
                raise SettingsError(complaint(self.settings, name, expected, before[name], hint))


def validations_decide(keep: str, patience: int | None) -> str | None:
    """Return the recipe's field by which validations choose the weights or end the training; None without one."""
    return "keep" if keep == "best" else "patience" if patience is not None else None


def _decisive(record: Mapping[str, object]) -> dict[str, object]:
    """Return the entries of a record that decide the weights, by name."""
    plain = msgspec.json.decode(msgspec.json.encode(record))
    recipe = of_today(plain["settings"]["recipe"])
    parts = {f"{part}.{name}": value for part in PARTS for name, value in recipe.get(part, {}).items()}
    decide = validations_decide(recipe.get("keep", "last"), recipe.get("patience"))
    chosen = {"validation": sorted((plain["validation"] or {}).values())} if decide else {}
    left_out = {*PARTS, *_WITHOUT_EFFECT, *(() if decide else _OF_THE_CHOICE)}
    whole = {name: value for name, value in recipe.items() if name not in left_out}
    return {
        **parts,
        **whole,
        **chosen,
        "stage": plain["settings"]["stage"],
        "seed": plain["seed"],
        "data": sorted(plain["data"].values()),
        "teacher": plain["teacher"],
        "init": (plain.get("init") or {}).get("sha256"),
        "devices": plain.get("devices", 1),
        "own validation drives": plain["validation"] is not None,
    }


def _check_archive(path: Path) -> None:
    """Compare the parts of a checkpoint with their checksums, which torch's reader does not verify."""
    try:
        with zipfile.ZipFile(path) as file:
            whole = file.testzip() is None
    except Exception:  # the reader of a damaged directory raises many types
        whole = False
    if not whole:
        raise CheckpointError(complaint(path, "file", "a checkpoint", "a damaged one", "; remove it to start afresh"))


def write_json(path: Path, content: object) -> None:
    """Write a JSON file atomically."""
    write_file(path, msgspec.json.format(msgspec.json.encode(content), indent=2) + b"\n")


def _processor() -> str:
    """Return the processor's name, from Linux's file or else as Python knows it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())
