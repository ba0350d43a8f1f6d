"""Senses: corrupted sweeps of the ego and its helpers at every percept of an episode.

Frames are those of `sensors.recording.rig`, as in a recorded drive of the same traffic; the half of a sweep after an
instant is extrapolated. Helpers are chosen once, at the start (`Rig.carriers`), beside the scenario's roadside units;
one that leaves is not replaced.
"""

from collections import deque
from collections.abc import Mapping

import msgspec

from dsrc.closed_loop.kept import world_scene
from dsrc.closed_loop.perception.liars import false_actors
from sensors.corruptions import (
    CLEAN,
    DEFAULT_SEVERITY,
    EVERYONE,
    Family,
    Who,
    corrupt_frame,
    require_corruption,
    require_who,
)
from sensors.frame import Frame
from sensors.recording.rig import Rig
from sim.errors import SettingsError, complaint
from sim.scenario import Scenario
from sim.traffic.base import Actors


class Faults(msgspec.Struct, frozen=True, kw_only=True):
    """Corruption of the sweeps of an episode.

    Attributes:
        corruption: kind, or `clean`.
        severity: 1 to 5.
        family: of the corruption's settings.
        who: agents whose sweeps are corrupted.
    """

    corruption: str = CLEAN
    severity: int = DEFAULT_SEVERITY
    family: Family = "physical"
    who: Who = EVERYONE

    def check(self) -> None:
        """Raise SettingsError for an unknown corruption or family, or one that `who` cannot have."""
        if self.corruption != CLEAN:
            require_corruption(self.corruption, self.severity, self.family)
        require_who(self.corruption, self.who)


class Senses:
    """LiDARs of the ego and its helpers over an episode.

    Attributes:
        agents: ids, ego first; known from the first frame on.
        index: number of the newest frame, 0 before the first.

    Args:
        cooperative: False leaves the ego alone.
    """

    def __init__(self, faults: Faults, cooperative: bool) -> None:
        self.faults, self.cooperative = faults, cooperative
        self.agents: tuple[int, ...] = ()
        self.index = 0
        self._rig: Rig | None = None

    def reset(self, scenario: Scenario, ego_id: int, seed: int) -> None:
        """Begin an episode."""
        self._rig = Rig(scenario, world_scene(scenario, seed), seed, visibility=False)
        self._ego_id, self.agents, self.index = ego_id, (), 0
        self._steps: deque[Actors] = deque(maxlen=self._rig.margin(scenario.step_s) + 1)

    def frame(self, before: Actors, now: Actors, claims: Mapping[str, Actors]) -> Frame:
        """Return the corrupted sweeps at `now`.

        Args:
            before: actors one traffic step ago.
            claims: false objects that helpers report, by the name of the helper.

        Raises:
            RuntimeError: no episode has begun.
            SettingsError: an id of `who` is no agent.
            DataError: a sweep lacks what the corruption needs.
        """
        if self._rig is None:
            raise RuntimeError("Senses.frame before reset")
        if not self.index:
            self._steps.append(before)
            carriers = self._rig.carriers(before, self._ego_id)
            self.agents = (*carriers, *self._rig.roadside) if self.cooperative else (self._ego_id,)
            self._check_who()
        self._steps.append(now)
        self.index += 1
        oldest = self._steps[0] if len(self._steps) == self._steps.maxlen else before
        present = [agent for agent in self.agents if agent < 0 or agent in now.boxes.object_id]
        lies = false_actors(claims, now, present[1:])
        frame = self._rig.frame(self.index, present, now, oldest, only_for=lies)
        faults, who = self.faults, self.faults.who
        if not isinstance(who, str):
            who = tuple(agent for agent in who if agent in present)
        if faults.corruption == CLEAN or not who:
            return frame
        return corrupt_frame(
            frame, faults.corruption, faults.severity, self._rig.seed, faults.family, ego_id=self._ego_id, who=who
        )

    def _check_who(self) -> None:
        who = self.faults.who
        unknown = [] if isinstance(who, str) or not self.cooperative else [one for one in who if one not in self.agents]
        if unknown:
            expected = f"ids among the agents {list(self.agents)}"
            raise SettingsError(complaint("perception", "who", expected, unknown[0]))
