"""What the corruptions of drives and of scans share: job, settings, and the entry in what is written."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from dsrc.options.drives import CorruptOptions
from sensors.corruptions import DEFAULT_SEVERITY, Family, drive_seed, settings_of
from sim.errors import SettingsError, complaint, did_you_mean, one_line
from sim.settings import convert


@dataclass(frozen=True, slots=True)
class CorruptionJob:
    """Drive or scan to corrupt.

    Attributes:
        source: its folder or its file.
        out: that of the corrupted one.
        drive: name of the drive, from which its weather and its faults are drawn.
        options: of the whole run.
    """

    source: Path
    out: Path
    drive: str
    options: CorruptOptions

    @property
    def drive_seed(self) -> int:
        """Seed of the drive's weather and faults."""
        return drive_seed(self.options.seed, self.drive)


def corruption_entry(options: CorruptOptions, code: str) -> dict[str, Any]:
    """Return the entry of a corruption among the settings of what it has made, of plain values.

    Args:
        code: hash of the code that corrupts.
    """
    family, settings = run_settings(options)
    severity = DEFAULT_SEVERITY if options.severity is None else options.severity
    return {
        "kind": options.corruption,
        **({"severity": severity} if options.preset is None else {"preset": options.preset}),
        "family": family,
        "seed": options.seed,
        "settings": msgspec.to_builtins(settings),
        "code": code,
    }


def run_settings(options: CorruptOptions) -> tuple[Family, Any]:
    """Return family and settings of the corruption of a run.

    Raises:
        SettingsError: an unknown kind, severity, family or preset, two of these that exclude each other, or a wrong
            change of a setting.
    """
    family, settings = settings_of(options.corruption, options.severity, options.family, options.preset)
    return family, changed_settings(settings, options.set)


def changed_settings(settings: object, changes: Sequence[str]) -> Any:
    """Return settings of a corruption with values changed by `field=value`.

    Raises:
        SettingsError: an unknown field, or a value of another type or out of its range.
    """
    known = getattr(settings, "__struct_fields__", ())
    plain = {name: getattr(settings, name) for name in known}
    for change in changes:
        name, _, value = change.partition("=")
        if name not in known:
            found, hint = one_line(name, 80), did_you_mean(name[:80], known)
            raise SettingsError(complaint("corrupt", "set", f"a setting of {type(settings).__name__}", found, hint))
        try:
            plain[name] = msgspec.json.decode(value)
        except (msgspec.DecodeError, RecursionError):
            plain[name] = value
    return convert(plain, type(settings), "corrupt: set", SettingsError) if changes else settings
