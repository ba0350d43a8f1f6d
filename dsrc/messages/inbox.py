"""Inbox of an ego: the messages of its helpers as liars write them, and what the ego's defences leave of them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dsrc.faults.fault import Faults
from dsrc.messages.attacks import Attacks
from dsrc.messages.defences import Defence, Defences
from dsrc.messages.message import Message, Told
from dsrc.messages.seen_space import SeenSpace
from sensors.frame import AgentFrame
from sensors.sweep import Sweep
from sim.boxes import Boxes
from sim.errors import SettingsError, complaint


class Mail(NamedTuple):
    """Messages of one instant, the ego's own first.

    Attributes:
        messages: as they arrived.
        kept: for each (N,) the objects that are believed.
        told: what became of each helper's.
        seen: seen space of the ego and of the helpers of whom anything is believed.
    """

    messages: list[Message]
    kept: list[NDArray[np.bool_]]
    told: tuple[Told, ...]
    seen: SeenSpace


class Inbox:
    """Inbox over an episode.

    Args:
        faults: of the episode; its attacks act here.
        defence: names of `dsrc.options.told.DEFENCES`.
    """

    def __init__(self, faults: Faults, defence: Defence) -> None:
        self._given = tuple(one for one in faults if one.attack)
        self._faults, self._defence = faults, defence

    @property
    def active(self) -> bool:
        """Whether anybody attacks or defends."""
        return bool(self._given or self._defence)

    def reset(self, seed: int, ego_id: int, start_s: float | None = None) -> None:
        """Begin an episode.

        Args:
            start_s: its begin, by the times of messages, s; None for when `aim` is first called.
        """
        self._ego_id = ego_id
        self._attacks, self._defences = Attacks(self._faults, seed, ego_id), Defences(self._defence)
        self._start_s, self._aimed = start_s, False

    def aim(self, ego: Boxes, route: NDArray[np.float64], time_s: float) -> None:
        """Tell the attackers where the ego is and goes, before each percept; arguments as `Attacks.aim`."""
        if self._start_s is None:
            self._start_s = time_s
        self._aimed = True
        self._attacks.aim(ego, route, time_s - self._start_s)

    def check(self, helpers: Sequence[int]) -> None:
        """Raise SettingsError for an attack on somebody who is no helper."""
        for fault in self._given:
            for agent in () if isinstance(fault.agents, str) else fault.agents:
                if agent not in helpers:
                    found = f"{agent}, the ego" if agent == self._ego_id else agent
                    expected = f"ids among the helpers {list(helpers)}"
                    raise SettingsError(complaint("perception", f"fault '{fault.text}'", expected, found))

    def measured(self, agent: AgentFrame, truth: Boxes, time_s: float) -> Sweep:
        """Return the sweep that a helper shares of an instant where it tells no boxes, see `Attacks.measured`.

        Nobody lies before `aim`: a computer that misses its first cycles has told nobody where the ego is.
        """
        if not self._aimed:
            return agent.sweep
        return self._attacks.measured(agent, truth, time_s - (self._start_s or 0.0))

    def more_bytes(self, sender: int, seen: Boxes, time_s: float) -> int:
        """Return what a lie adds to the bytes of a message of an instant, see `Attacks.more_bytes`."""
        return self._attacks.more_bytes(sender, seen, time_s - (self._start_s or 0.0))

    def read(self, own: Message, told: Sequence[Message]) -> Mail:
        """Return the messages of an instant.

        Args:
            own: what the ego perceives itself.
            told: the helpers' honest messages.

        Raises:
            RuntimeError: nobody told attackers where the ego is, see `aim`.
        """
        if self._given and not self._aimed:
            raise RuntimeError("Inbox.read before aim")
        sent = [self._attacks.written(one, one.time_s - (self._start_s or 0.0)) for one in told]
        refused = self._defences.refused(own, sent)
        records = tuple(
            Told(one.sender, len(bad), int(one.false.sum()), int(bad.sum()), int((bad & one.false).sum()), one.attacked)
            for one, bad in zip(sent, refused, strict=True)
        )
        believed = [one for one, bad in zip(sent, refused, strict=True) if not len(bad) or not bad.all()]
        seen = SeenSpace([own.view, *(one.view for one in believed)])
        return Mail([own, *sent], [np.ones(len(own.objects), bool), *(~bad for bad in refused)], records, seen)
