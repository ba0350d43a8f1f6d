"""Conditions of sweeps and settings of channels, without a network: cheap to import."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from sensors import corruptions as registry
from sensors.corruptions import CLEAN, Family
from sim.errors import SettingsError, complaint, did_you_mean
from sim.files import file_sha256
from sim.kept.code_hash import own_code_hash
from sim.radio import ChannelSpec

ALL = "all"
"""Every corruption of a family."""
PAPER_TABLE = "paper_six"
"""The six corruptions of the paper's tables."""


@dataclass(frozen=True, slots=True)
class Condition:
    """Condition of the sweeps.

    Attributes:
        kind: of the corruption, or `clean`.
        severity: 1 to 5, 0 for clean.
        family: of the corruption's settings.
        who: agents whose sweeps are corrupted, see `sensors.corruptions.parse_who`.
    """

    kind: str = CLEAN
    severity: int = 0
    family: Family = "physical"
    who: str = registry.EVERYONE


def corruption_kinds(names: Sequence[str], family: Family = "physical", where: str = "evaluate") -> tuple[str, ...]:
    """Kinds of corruption by name, in the order of `CORRUPTIONS`.

    Args:
        names: kinds, `paper_six` for those of the paper's tables, `all` for all of the family, `clean` for none.
        where: begins the messages of errors.

    Raises:
        SettingsError: an unknown corruption or family, or a family without a model of the corruption.
    """
    groups = {CLEAN: (), PAPER_TABLE: registry.PAPER_SIX, ALL: registry.kinds_of(family)}
    for name in names:
        if name not in (*groups, *registry.CORRUPTIONS):
            hint = did_you_mean(name, [*groups, *registry.CORRUPTIONS])
            raise SettingsError(complaint(where, "corruptions", "a corruption", name, hint))
        if name not in groups:
            try:
                registry.require_corruption(name, family=family)
            except SettingsError as error:
                raise SettingsError(f"{where}: corruptions: {error}") from None
    wanted = {kind for name in names for kind in groups.get(name, (name,))}
    return tuple(kind for kind in registry.CORRUPTIONS if kind in wanted)


def check_numbers(where: str, severities: Sequence[int], seed: int, limit: int | None) -> None:
    """Raise SettingsError for a number out of its range; `where` begins the message."""
    for severity in severities:
        if not 1 <= severity <= 5:
            raise SettingsError(complaint(where, "severity", "1 to 5", severity))
    if seed < 0:
        raise SettingsError(complaint(where, "seed", "at least 0", seed))
    if limit is not None and limit < 1:
        raise SettingsError(complaint(where, "limit", "at least 1 frame (--frames)", limit))


def condition_settings(condition: Condition) -> dict[str, Any]:
    """Settings of a condition, those of its corruption included."""
    listed = {"kind": condition.kind, "severity": condition.severity, "family": condition.family}
    if condition.kind == CLEAN:
        return listed
    if condition.who != registry.EVERYONE:
        listed["who"] = condition.who
    corruption = registry.CORRUPTIONS[condition.kind]
    paper = condition.family == "paper"
    model = corruption.paper_apply or corruption.paper_in_frame if paper else corruption.apply or corruption.in_frame
    if code := own_code_hash(model):
        listed["code"] = code
    settings = corruption.settings_of(condition.family).severity(condition.severity)
    return {**listed, "settings": msgspec.to_builtins(settings)}


def channel_settings(spec: ChannelSpec) -> dict[str, Any]:
    """Settings of a channel without its name; of a trace the hash of its file."""
    settings = msgspec.to_builtins(spec)
    del settings["name"]
    return {**settings, "trace": file_sha256(Path(spec.trace))} if spec.trace else settings
