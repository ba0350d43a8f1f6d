"""Condition of sweeps: one value for the corruption of some agents, read, checked, labelled and hashed here alone."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self, cast

import msgspec

from sensors.corruptions.apply import EVERYONE, CorruptedAgents, corrupt_frame, parse_agents, require_agents
from sensors.corruptions.physics.levels import DEFAULT_SEVERITY, require_severity
from sensors.corruptions.presets import settings_of
from sensors.corruptions.registry import (
    CLEAN,
    CORRUPTIONS,
    PAPER_SIX,
    Family,
    kinds_of,
    require_corruption,
)
from sensors.frame import Frame
from sim.errors import SettingsError, complaint, did_you_mean, one_line
from sim.kept.code_hash import own_code_hash
from sim.settings import convert

ALL = "all"
"""Every corruption of a family."""
PAPER_TABLE = "paper_six"
"""The six corruptions of the paper's tables."""


Changes = tuple[tuple[str, Any], ...]
"""Names and values of settings."""


@dataclass(frozen=True, slots=True)
class Condition:
    """Condition of the sweeps of a frame.

    Attributes:
        kind: key of `CORRUPTIONS`, or `clean`.
        severity: 1 to 5, 0 for clean.
        family: models of the corruption.
        agents: agents whose sweeps are corrupted.
        settings: settings that differ from the severity's.
        preset: published settings in place of the severity's, see `PRESETS`.
    """

    kind: str = CLEAN
    severity: int = 0
    family: Family = "physical"
    agents: CorruptedAgents = EVERYONE
    settings: Changes = ()
    preset: str | None = None

    @classmethod
    def of(
        cls,
        kind: str,
        severity: int = DEFAULT_SEVERITY,
        family: Family | str = "physical",
        agents: CorruptedAgents | str = EVERYONE,
        settings: Changes = (),
    ) -> Self:
        """Return a condition from words; clean sweeps have one, whatever the other arguments.

        Raises:
            SettingsError: `agents` is a text that names no agents.
        """
        named = parse_agents(agents) if isinstance(agents, str) else agents
        return cls() if kind == CLEAN else cls(kind, severity, cast(Family, family), named, settings)

    def checked(self) -> Self:
        """Return the condition itself.

        Raises:
            SettingsError: an unknown kind, severity or family, a family without a model of the kind, agents that the
                kind cannot corrupt, or a wrong setting.
        """
        severity = DEFAULT_SEVERITY if self.kind == CLEAN else self.severity
        require_corruption(self.kind, severity, self.family)
        require_agents(self.kind, self.agents)
        if self.settings:
            self.resolved()
        return self

    @property
    def agents_text(self) -> str:
        """Corrupted agents as files and tables have them: a word, or ids between commas."""
        return self.agents if isinstance(self.agents, str) else ",".join(map(str, self.agents))

    @property
    def key(self) -> tuple[str, int, str, str]:
        """Kind, severity, family and agents, which sort."""
        return self.kind, self.severity, self.family, self.agents_text

    @property
    def label(self) -> str:
        """Title: `clean`, `fog 3`, `fog 3 (paper), helpers`, `fog 3 with extinction 0.1`."""
        if self.kind == CLEAN:
            return CLEAN
        family = "" if self.family == "physical" else f" ({self.family})"
        agents = "" if self.agents == EVERYONE else f", {self.agents_text}"
        changes = ", ".join(f"{name} {value}" for name, value in self.settings)
        level = self.preset or self.severity
        return f"{self.kind.replace('_', ' ')} {level}{family}{agents}{changes and f' with {changes}'}"

    def among(self, ids: Collection[int]) -> Self:
        """Return the condition of those named agents that are present; clean where none is: agents come and go."""
        if isinstance(self.agents, str):
            return self
        present = tuple(one for one in self.agents if one in ids)
        return replace(self, agents=present) if present else type(self)()

    def apply(self, frame: Frame, seed: int, ego_id: int | None = None) -> Frame:
        """Return the frame under the condition, see `corrupt_frame`."""
        if self.kind == CLEAN:
            return frame
        return corrupt_frame(
            frame,
            self.kind,
            self.severity,
            seed,
            self.family,
            ego_id=ego_id,
            corrupted_agents=self.agents,
            settings=self.resolved() if self.settings or self.preset else None,
        )

    def resolved(self, where: str = "") -> Any:
        """Return the settings of the corruption, the changed ones included; None for clean.

        Args:
            where: begins the messages of errors.

        Raises:
            SettingsError: an unknown preset or setting, or a value of another type or out of its range.
        """
        if self.kind == CLEAN:
            return None
        if self.preset is None:
            usual = CORRUPTIONS[self.kind].settings_of(self.family).severity(self.severity)
        else:
            usual = settings_of(self.kind, preset=self.preset)[1]
        if not self.settings:
            return usual
        where = where or f"corruption '{self.kind}': settings"
        known = getattr(usual, "__struct_fields__", ())
        for name, _ in self.settings:
            if name not in known:
                found, expected = one_line(name, 80), f"a setting of {type(usual).__name__}"
                place, _, field = where.rpartition(": ")
                raise SettingsError(complaint(place, field, expected, found, did_you_mean(name[:80], known)))
        changed = {**{name: getattr(usual, name) for name in known}, **dict(self.settings)}
        return convert(changed, type(usual), where, SettingsError)

    def decisive(self) -> dict[str, Any]:
        """Return what decides the sweeps, of plain values: parts of keys."""
        listed: dict[str, Any] = {"kind": self.kind, "severity": self.severity, "family": self.family}
        if self.kind == CLEAN:
            return listed
        if self.agents != EVERYONE:
            listed["who"] = self.agents_text
        corruption = CORRUPTIONS[self.kind]
        paper = self.family == "paper"
        model = (
            corruption.paper_apply or corruption.paper_in_frame if paper else corruption.apply or corruption.in_frame
        )
        if code := own_code_hash(model):
            listed["code"] = code
        return {**listed, "settings": msgspec.to_builtins(self.resolved())}


def corruption_kinds(names: Sequence[str], family: Family = "physical", where: str = "evaluate") -> tuple[str, ...]:
    """Return kinds of corruption by name, in the order of `CORRUPTIONS`.

    Args:
        names: kinds, `paper_six` for the paper's tables, `all` for the whole family, `clean` for none.
        where: begins the messages of errors.

    Raises:
        SettingsError: an unknown corruption or family, or a family without a model of the corruption.
    """
    groups = {CLEAN: (), PAPER_TABLE: PAPER_SIX, ALL: kinds_of(family)}
    for name in names:
        if name not in (*groups, *CORRUPTIONS):
            hint = did_you_mean(name, [*groups, *CORRUPTIONS])
            raise SettingsError(complaint(where, "corruptions", "a corruption", name, hint))
        if name not in groups:
            try:
                require_corruption(name, family=family)
            except SettingsError as error:
                raise SettingsError(f"{where}: corruptions: {error}") from None
    wanted = {kind for name in names for kind in groups.get(name, (name,))}
    return tuple(kind for kind in CORRUPTIONS if kind in wanted)


def conditions_of(
    names: Sequence[str],
    severities: Sequence[int],
    families: Sequence[Family] = ("physical",),
    agents: CorruptedAgents | str = EVERYONE,
    where: str = "evaluate",
) -> list[Condition]:
    """Return the checked conditions of a study: clean, then, family by family, every corruption at every severity.

    Args:
        names: see `corruption_kinds`.
        where: begins the messages of errors.

    Raises:
        SettingsError: a wrong name, severity or family, or agents that a corruption cannot have.
    """
    kinds = [(kind, family) for family in families for kind in corruption_kinds(names, family, where)]
    try:
        named = parse_agents(agents) if isinstance(agents, str) else agents
        for level in severities:
            require_severity(level)
        made = [Condition(kind, level, family, named) for kind, family in kinds for level in severities]
        return [Condition(), *(condition.checked() for condition in made)]
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from None
