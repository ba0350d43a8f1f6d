"""What an episode or a frame is disturbed by: a corruption, a channel and faults, each said once.

A fault that is there all the time may have an older spelling: `loss:0.3` is the channel `ideal,loss=0.3`, `fog:3` the
corruption of that name. Episodes and cells have the older one, so that both are one.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import msgspec

from dsrc.faults.fault import Faults, fault_parts, faults_text, parse_faults
from dsrc.faults.kinds import REPLAY, Severity
from dsrc.faults.sweeps import SensorFaults
from sensors.corruptions import CLEAN, CORRUPTIONS, Changes, Condition, CorruptedAgents, Family, ego_of
from sensors.frame import Frame
from sim.errors import DataError, SettingsError, complaint
from sim.radio import IDEAL, ChannelSpec, Radio, changed_spec


class Disturbance(NamedTuple):
    """What an episode is driven in.

    Attributes:
        condition: of the sweeps, all the time.
        channel: name of the radio channel, with what is changed of it all the time.
        faults: what neither of them says.
    """

    condition: Condition
    channel: str
    faults: Faults = ()


def settled(faults: Faults, channel: str) -> Disturbance:
    """Return the disturbance of faults: what condition and channel can say, they say.

    A corruption with another fault beside it stays a fault: each acts on what those before it left.
    """
    radio, left = Radio.parse(channel), []
    for fault in faults:
        if fault.radio and fault.always and fault.agents == "helpers":
            radio = radio.changed(**fault.radio)
        else:
            left.append(fault)
    if len(left) == 1 and left[0].always and isinstance(left[0].settings, Severity):
        return Disturbance(left[0].condition, radio.label)
    return Disturbance(Condition(), radio.label, tuple(left))


def radio_faults(
    faults: Faults, spec: ChannelSpec, interval_s: float, ego_id: int
) -> Callable[[int, int], ChannelSpec] | None:
    """Return the settings of the messages that an agent sends in an instant, for `sim.radio.Channel`; None: `spec`.

    Args:
        faults: those that do not act on the radio do not matter.
        interval_s: time between instants, s; the first one of an episode is 1.
    """
    acting = [fault for fault in faults if fault.radio]

    def sent_with(index: int, sender: int) -> ChannelSpec:
        changed = spec
        for fault in acting:
            if (fault.always or fault.at((index - 1) * interval_s)) and fault.on(sender, ego_id):
                changed = changed_spec(changed, fault.radio)
        return changed

    return sent_with if acting else None


@dataclass(frozen=True, slots=True)
class Faulted(Condition):
    """Condition of frames under faults, each of which acts on what those before it left; its kind is their text."""

    faults: Faults = ()

    @property
    def label(self) -> str:
        """Title: the text of the faults."""
        return self.kind

    def checked(self) -> Self:
        """Return the condition itself: its faults were checked when they were read."""
        return self

    def among(self, ids: Collection[int]) -> Self:
        """Return the condition of those named agents that are present."""
        kept = []
        for fault in self.faults:
            named = fault.agents
            present = named if isinstance(named, str) else tuple(one for one in named if one in ids)
            kept += [msgspec.structs.replace(fault, agents=present)] if present else []
        return replace(self, faults=tuple(kept))

    def apply(self, frame: Frame, seed: int, ego_id: int | None = None) -> Frame:
        """Return the frame with the faults of its sensors and of where its agents believe to be.

        Raises:
            DataError: a fault names an id that is no agent, or the ego where it acts on helpers, or a sweep lacks what
                a corruption needs.
        """
        ego, ids = ego_of(frame) if ego_id is None else ego_id, [agent.agent_id for agent in frame.agents]
        for fault in self.faults:
            known = [one for one in ids if one != ego] if fault.what.agents == "helpers" else ids
            for one in () if isinstance(fault.agents, str) else fault.agents:
                if one not in known:
                    where, expected = f"frame {frame.index}", f"ids among the agents {known}"
                    raise DataError(complaint(where, f"fault '{fault.text}'", expected, one))
        return SensorFaults(self.faults, seed).apply(frame, ego)

    def decisive(self) -> dict[str, Any]:
        """Return what decides the sweeps and the radio beside the channel, of plain values: parts of keys."""
        condition, _, left = settled(self.faults, IDEAL)
        return condition.decisive() | ({"faults": [fault.decisive() for fault in left]} if left else {})


def faults_of(condition: Condition) -> Faults:
    """Return the faults of a condition; those of a corruption it says itself."""
    return condition.faults if isinstance(condition, Faulted) else ()


def frame_condition(text: str, where: str) -> Faulted:
    """Return the condition of frames under the faults of a text, see `dsrc.faults.fault`.

    Args:
        where: command or file that it is of, for messages.

    Raises:
        SettingsError: as `parse_faults`; a fault has a time, or acts on what happens between frames.
    """
    faults = parse_faults(text, where)
    for fault, part in zip(faults, fault_parts(text), strict=True):
        field = f"fault '{part}'"
        if not fault.always:
            expected = "none of from, to and for: frames are judged one by one"
            raise SettingsError(complaint(where, field, expected, "a time; it has a meaning in dsrc drive"))
        if fault.kind in _IN_TIME or fault.what.place in ("computing", "actuation"):
            expected = "a fault that acts in a single frame"
            raise SettingsError(complaint(where, field, expected, f"{fault.kind}; it has a meaning in dsrc drive"))
    return Faulted(faults_text(faults), faults=faults)


_IN_TIME = ("freeze", "localisation_drift", "speed_reading", REPLAY)
"""Kinds of faults of sensors, poses and messages that act on what happens between frames."""


def condition_of(
    kind: str, severity: int, family: Family, agents: CorruptedAgents | str, settings: Changes = ()
) -> Condition:
    """Return a condition from the words of a stored one, see `Condition.of`; a kind may be the text of faults.

    Raises:
        SettingsError: `kind` is neither a corruption nor a text of faults, or `agents` names no agents.
    """
    if kind in (CLEAN, *CORRUPTIONS):
        return Condition.of(kind, severity, family, agents, settings)
    return frame_condition(kind, "condition")
