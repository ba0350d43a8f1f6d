"""What the corruptions of drives and of scans share: job, settings, and the entry in what is written."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from dsrc.options.drives import CorruptOptions
from sensors.corruptions import DEFAULT_SEVERITY, EVERYONE, Condition, drive_seed, parse_agents, settings_of


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
    condition = run_condition(options)
    return {
        "kind": condition.kind,
        **({"severity": condition.severity} if condition.preset is None else {"preset": condition.preset}),
        "family": condition.family,
        "seed": options.seed,
        "settings": msgspec.to_builtins(condition.resolved()),
        "code": code,
        **({} if condition.agents == EVERYONE else {"who": condition.agents_text}),
    }


def run_condition(options: CorruptOptions) -> Condition:
    """Return the condition of a run.

    Raises:
        SettingsError: an unknown kind, severity, family or preset, two of these that exclude each other, agents that
            the kind cannot corrupt, or a wrong change of a setting.
    """
    family, _ = settings_of(options.corruption, options.severity, options.family, options.preset)
    level = DEFAULT_SEVERITY if options.severity is None else options.severity
    changes = tuple(map(_change, options.set))
    made = Condition(options.corruption, level, family, parse_agents(options.corrupted_agents), changes, options.preset)
    made.resolved("corrupt: set")
    return made.checked()


def _change(text: str) -> tuple[str, Any]:
    """Return name and value of `field=value`; a value that is no JSON is a text."""
    name, _, value = text.partition("=")
    try:
        return name, msgspec.json.decode(value)
    except (msgspec.DecodeError, RecursionError):
        return name, value
