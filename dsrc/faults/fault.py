"""A fault: a cause with its numbers, a time and a place, read from and written as one line of text.

    fog:3 from 4 s to 9 s on helpers
    loss:0.3
    fog:3 on 1003 + loss:0.3 from 2 s + delay:0.2

Faults of one line, between plus signs, are there at once. A kind is followed by its numbers, the first without a name:
`misalignment:2,up_cm=10`; a share may be in percent, `loss:30%`. Times are seconds of the episode: from the first until
before the second, or `for` so many in place of `to`. Without times a fault is there all the time, without agents it
acts on all whom its kind can act on.
"""

import itertools
import math
import re
from collections.abc import Sequence
from math import inf
from typing import Any, Self

import msgspec

from dsrc.faults.kinds import CORRUPTION, KINDS, FaultKind, FaultSettings, Severity, kind_names
from sensors.corruptions import FAMILIES, Condition, CorruptedAgents, parse_agents
from sensors.corruptions.apply import AGENTS_TEXT, in_group
from sim.errors import SettingsError, complaint, did_you_mean

_TIME = re.compile(r"(?P<number>[0-9.eE+-]+)\s*s?")
_WORDS = re.compile(r"\s+(from|to|for|on)\s+")
_TIGHT_PLUS = re.compile(r"\w\+ *[a-z]|\w *\+[a-z]")
_LAST_WORD = re.compile(r"\s(from|to|for|on)$")
_SLACK_S = 1e-6
_KINDS_OF: dict[str, set[str]] = {
    "all": {"ego", "vehicle", "unit"},
    "ego": {"ego"},
    "helpers": {"vehicle", "unit"},
    "vehicles": {"ego", "vehicle"},
    "roadside": {"unit"},
}
"""Agents of each group: the ego, other vehicles, roadside units."""


class Fault(msgspec.Struct, frozen=True, kw_only=True):
    """One cause, somewhere, for some time.

    Attributes:
        kind: a corruption, or a key of `KINDS`.
        settings: its numbers.
        from_s: begin, s of the episode.
        to_s: end, s of the episode, no longer part of it.
        agents: on whom it acts.
    """

    kind: str
    settings: FaultSettings
    from_s: float = 0.0
    to_s: float = inf
    agents: CorruptedAgents = "all"

    @classmethod
    def of(cls, condition: Condition) -> Self:
        """Return the fault of a corruption that is there all the time."""
        own = Severity(condition.severity, condition.family, condition.settings, condition.preset)
        return cls(kind=condition.kind, settings=own, agents=condition.agents)

    @property
    def what(self) -> FaultKind:
        """Its kind."""
        return KINDS.get(self.kind, CORRUPTION)

    @property
    def always(self) -> bool:
        """Whether it is there all the time."""
        return self.from_s <= 0.0 and self.to_s == inf

    @property
    def first(self) -> str:
        """Name of its first number."""
        return self.settings.__struct_fields__[0]

    @property
    def value(self) -> float:
        """Its first number."""
        return float(getattr(self.settings, self.first))

    def at(self, time_s: float) -> bool:
        """Whether it is there at a time of the episode, s; at infinity, where time has no meaning: whether always."""
        return self.always if time_s == inf else self.from_s - _SLACK_S <= time_s < self.to_s - _SLACK_S

    def on(self, agent_id: int, ego_id: int) -> bool:
        """Whether it acts on an agent."""
        return in_group(self.agents, agent_id, ego_id)

    @property
    def condition(self) -> Condition:
        """Condition of the sweeps; TypeError of anything but a corruption."""
        if not isinstance(own := self.settings, Severity):
            raise TypeError(self.kind)
        return Condition(self.kind, own.severity, own.family, self.agents, own.changes, own.preset)

    @property
    def radio(self) -> dict[str, float]:
        """Changes of a sender's radio, by the names of `sim.radio.CHANGES`."""
        names = self.what.radio
        return dict(zip(names, msgspec.structs.astuple(self.settings), strict=True)) if names else {}

    @property
    def needs(self) -> str:
        """What it acts on beside the ego itself: `sensor`, `radio` (helpers), `message` (objects they tell), or ""."""
        if self.what.place == "localisation":
            return "radio" if self.agents in ("helpers", "roadside") else ""
        return self.what.place if self.what.place in ("sensor", "radio", "message") else ""

    @property
    def attack(self) -> bool:
        """Whether helpers lie."""
        return self.what.place == "message"

    @property
    def agents_text(self) -> str:
        """Agents as texts have them."""
        return self.agents if isinstance(self.agents, str) else ",".join(map(str, self.agents))

    @property
    def text(self) -> str:
        """The fault as `parse_faults` reads it."""
        first, *others = self.settings.__struct_fields__ or ("",)
        usual = {one.name: one.default for one in msgspec.structs.fields(self.settings)}
        numbers = [_written(getattr(self.settings, first))] if first else []
        numbers += [
            f"{name}={_written(value)}" for name in others if (value := getattr(self.settings, name)) != usual.get(name)
        ]
        text = f"{self.kind}:{','.join(numbers)}" if numbers else self.kind
        text += f" from {_written(self.from_s)} s" if self.from_s > 0.0 else ""
        text += f" to {_written(self.to_s)} s" if self.to_s < inf else ""
        return text if self.agents == self.what.agents else f"{text} on {self.agents_text}"

    def decisive(self) -> dict[str, Any]:
        """Return what decides its effect, of plain values: parts of keys."""
        own = self.condition.decisive() if isinstance(self.settings, Severity) else {}
        numbers = own.get("settings", msgspec.to_builtins(self.settings))
        until = None if self.to_s == inf else self.to_s
        own |= {"kind": self.kind, "settings": numbers, "who": self.agents_text, "from_s": self.from_s, "to_s": until}
        return own


Faults = tuple[Fault, ...]
"""Faults that are there at once."""


def faults_text(faults: Sequence[Fault]) -> str:
    """Return faults as `parse_faults` reads them."""
    return " + ".join(one.text for one in faults)


def parse_faults(text: str, where: str = "drive") -> Faults:
    """Return the faults of a text, see this module.

    Args:
        where: command or file that it is of, for messages.

    Raises:
        SettingsError: an unknown kind, number or word, a number out of its range, or a fault that overlaps itself; one
            line names the part of the text.
    """
    parts = fault_parts(text)
    found = tuple(_parse_one(part, where) for part in parts)
    require_apart(found, where, texts=parts)
    return found


def fault_parts(text: str) -> list[str]:
    """Return the texts of the single faults of a text."""
    return [part.strip() for part in re.split(r"\s\+\s", text)]


def require_apart(
    faults: Sequence[Fault], where: str, ego_id: int | None = None, texts: Sequence[str] | None = None
) -> None:
    """Raise SettingsError where two faults of one kind act on one agent at one time.

    Args:
        ego_id: the ego; None before it is known: ids may then be those of helpers, not of the ego.
        texts: the faults as they were written, for the message; None for their own texts.
    """
    written = texts or [fault.text for fault in faults]
    for (one, said), (other, again) in itertools.combinations(zip(faults, written, strict=True), 2):
        if one.kind == other.kind and _share_time(one, other) and _share_agent(one, other, ego_id):
            expected = f"one fault of the kind '{one.kind}' at a time on an agent"
            raise SettingsError(complaint(where, f"fault '{again}'", expected, f"'{said}' beside it"))


def _share_time(one: Fault, other: Fault) -> bool:
    return max(one.from_s, other.from_s) < min(one.to_s, other.to_s)


def _share_agent(one: Fault, other: Fault, ego_id: int | None) -> bool:
    if isinstance(one.agents, str) and isinstance(other.agents, str):
        return bool(_KINDS_OF[one.agents] & _KINDS_OF[other.agents])
    if isinstance(one.agents, str):
        return _share_agent(other, one, ego_id)
    if isinstance(other.agents, str):
        return any(other.on(agent, agent + 1 if ego_id is None else ego_id) for agent in one.agents)
    return bool(set(one.agents) & set(other.agents))


def _parse_one(text: str, where: str) -> Fault:
    field = f"fault '{text}'"
    if _TIGHT_PLUS.search(text):
        raise SettingsError(complaint(where, field, "' + ' with spaces between two faults", text))
    if unfinished := _LAST_WORD.search(text):
        after = "agents" if unfinished[1] == "on" else "seconds"
        raise SettingsError(complaint(where, field, f"{after} after '{unfinished[1]}'", "nothing"))
    head, *rest = _WORDS.split(text)
    name, _, numbers = head.partition(":")
    if name not in kind_names():
        hint = did_you_mean(name, kind_names())
        raise SettingsError(complaint(where, field, "a kind of fault", name or "none", hint))
    given = dict(zip(rest[::2], rest[1::2], strict=True))
    if len(given) < len(rest) // 2 or {"to", "for"} <= given.keys():
        raise SettingsError(complaint(where, field, "from, to or for, and on once each", text))
    kind = KINDS.get(name, CORRUPTION)
    begin, end = (
        _seconds(given[word], word, where, field) if word in given else usual
        for word, usual in (("from", 0.0), ("to", inf))
    )
    if "for" in given:
        end = round(begin + _seconds(given["for"], "for", where, field), 9)
    if not begin < end:
        raise SettingsError(complaint(where, field, f"an end after {begin:g} s", f"{end:g} s"))
    agents = kind.agents
    if "on" in given:
        try:
            agents = parse_agents(given["on"].strip())
        except SettingsError:
            expected = f"{AGENTS_TEXT}, such as 1003,-1, after 'on'"
            raise SettingsError(complaint(where, field, expected, given["on"])) from None
        if (kind.agents == "ego" and agents != "ego") or (kind.agents == "helpers" and agents in ("ego", "all")):
            expected = f"{kind.agents}{', vehicles, roadside or ids' if kind.agents == 'helpers' else ''} after 'on'"
            raise SettingsError(complaint(where, field, expected, given["on"]))
    made = Fault(kind=name, settings=_settings(kind, numbers, where, field), from_s=begin, to_s=end, agents=agents)
    if kind is CORRUPTION:
        try:
            made.condition.checked()
        except SettingsError as error:
            raise SettingsError(f"{where}: {field}: {error}") from None
    return made


def _seconds(text: str, word: str, where: str, field: str) -> float:
    found = _TIME.fullmatch(text.strip())
    value = _number(found["number"]) if found else math.nan
    if not 0.0 <= value < inf:
        raise SettingsError(complaint(where, field, f"seconds >= 0 after '{word}'", text))
    return value


def _settings(kind: FaultKind, text: str, where: str, field: str) -> FaultSettings:
    """Return the numbers of a fault."""
    fields = msgspec.structs.fields(kind.settings)
    known = {one.name: one for one in fields if one.name not in ("changes", "preset")}
    values: dict[str, Any] = {}
    for place, part in enumerate(text.split(",") if text else []):
        name, _, number = part.strip().rpartition("=")
        if not name and place == 0 and known:
            name = next(iter(known))
        if name not in known:
            expected = f"{' or '.join(known) or 'no number'}"
            raise SettingsError(complaint(where, field, expected, part.strip() or "nothing"))
        if name == "family":
            if number not in FAMILIES:
                raise SettingsError(complaint(where, f"{field}, {name}", " or ".join(FAMILIES), number))
            values[name] = number
            continue
        low, high = kind.settings.RANGES.get(name, (-inf, inf))
        whole = known[name].type is int
        value = _number(number[:-1]) / 100.0 if number.endswith("%") and (low, high) == (0.0, 1.0) else _number(number)
        fits = math.isfinite(value) and low <= value <= high and not (whole and value != round(value))
        if name in values or not fits:
            expected = "once" if name in values else f"{'a whole number, ' if whole else ''}{_range_text(low, high)}"
            raise SettingsError(complaint(where, f"{field}, {name}", expected, number))
        values[name] = int(value) if whole else value
    if kind.settings.ANY and not values:
        raise SettingsError(complaint(where, field, f"one of {', '.join(known)}", "none"))
    lacking = [name for name, one in known.items() if one.required and name not in values]
    if lacking:
        low, high = kind.settings.RANGES.get(lacking[0], (-inf, inf))
        raise SettingsError(complaint(where, f"{field}, {lacking[0]}", _range_text(low, high), "none"))
    return kind.settings(**values)


def _written(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:.12g}"


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _range_text(low: float, high: float) -> str:
    if low == -inf:
        return "a number"
    return f"a number >= {low:g}" if high == inf else f"{low:g} to {high:g}"
