"""Senses: sweeps of the ego and its helpers at every percept of an episode, with the faults of their sensors.

Frames are those of `sensors.recording.rig`, as in a recorded drive of the same traffic; the half of a sweep after an
instant is extrapolated. Helpers are chosen once, at the start (`Rig.carriers`), beside the scenario's roadside units;
one that leaves is not replaced.
"""

from collections import deque
from collections.abc import Mapping

from dsrc.closed_loop.kept import world_scene
from dsrc.closed_loop.perception.liars import false_actors
from dsrc.faults.fault import Fault, Faults, require_apart
from dsrc.faults.sweeps import SensorFaults
from sensors.corruptions import CLEAN, Condition
from sensors.frame import Frame
from sensors.recording.rig import Rig
from sim.errors import SettingsError, complaint
from sim.scenario import Scenario
from sim.traffic.base import Actors

_TURN_S = 0.1
"""Time of a rotation of most LiDARs, s."""


def sensed_every_s(interval_s: float, *, at_once: bool) -> float:
    """Return the time between sweeps of a perception, s: that between percepts, or a rotation where messages take time.

    Else a message of 50 ms would be as old as the time between two percepts.

    Args:
        interval_s: time between percepts, s; what is no multiple of a rotation stays.
        at_once: whether messages arrive when they are sent, or there are none.
    """
    turns = interval_s / _TURN_S
    return _TURN_S if not at_once and turns > 1.0 and abs(turns - round(turns)) < 1e-6 else interval_s


class Senses:
    """LiDARs of the ego and its helpers over an episode.

    Attributes:
        agents: ids, ego first; known from the first frame on.
        index: number of the newest frame, 0 before the first.

    Args:
        condition: of the sweeps all the time, the first of the faults.
        cooperative: False leaves the ego alone.
        faults: of the sensors, each acting on what those before it left; others do not matter.
    """

    def __init__(self, condition: Condition, cooperative: bool, faults: Faults = ()) -> None:
        self.condition, self.cooperative = condition, cooperative
        first = () if condition.kind == CLEAN else (Fault.of(condition),)
        self._faults = (*first, *faults)
        self._named = faults
        self.agents: tuple[int, ...] = ()
        self.index = 0
        self._rig: Rig | None = None

    def reset(self, scenario: Scenario, ego_id: int, seed: int) -> None:
        """Begin an episode."""
        self._rig = Rig(scenario, world_scene(scenario, seed), seed, visibility=False)
        self._sensor_faults = SensorFaults(self._faults, seed)
        self._ego_id, self.agents, self.index = ego_id, (), 0
        self._steps: deque[Actors] = deque(maxlen=self._rig.margin(scenario.step_s) + 1)

    def frame(self, before: Actors, now: Actors, claims: Mapping[str, Actors]) -> Frame:
        """Return the corrupted sweeps at `now`.

        Args:
            before: actors one traffic step ago.
            claims: false objects that helpers report, by the name of the helper.

        Raises:
            RuntimeError: no episode has begun.
            SettingsError: a corrupted agent's id is no agent.
            DataError: a sweep lacks what the corruption needs.
        """
        rig = self.pass_over(before, now)
        oldest = self._steps[0] if len(self._steps) == self._steps.maxlen else before
        present = [agent for agent in self.agents if agent < 0 or agent in now.boxes.object_id]
        lies = false_actors(claims, now, present[1:])
        frame = rig.frame(self.index, present, now, oldest, only_for=lies)
        return self._sensor_faults.apply(frame, self._ego_id, now.time_s - self._start_s)

    def pass_over(self, before: Actors, now: Actors) -> Rig:
        """Take an instant without its sweeps: later ones are the same but for a sensor that froze at it.

        Arguments and errors as of `frame`.

        Returns:
            The LiDARs of the agents.
        """
        if self._rig is None:
            raise RuntimeError("Senses.frame before reset")
        if not self.index:
            self._steps.append(before)
            carriers = self._rig.carriers(before, self._ego_id)
            self.agents = (*carriers, *self._rig.roadside) if self.cooperative else (self._ego_id,)
            self._start_s = now.time_s
            self._check_agents()
        self._steps.append(now)
        self.index += 1
        return self._rig

    def _check_agents(self) -> None:
        """Raise SettingsError for an id that is no agent, or faults of one kind on one agent at once."""
        fields = {f"fault '{one.text}'": one.agents for one in self._named} if self.cooperative else {}
        if self.cooperative:
            # A fault that is there all the time may be said as the condition.
            fields |= {f"fault '{Fault.of(self.condition).text}'": self.condition.agents}
        expected = f"ids among the agents {list(self.agents)}"
        for field, named in fields.items():
            for unknown in () if isinstance(named, str) else (one for one in named if one not in self.agents):
                raise SettingsError(complaint("perception", field, expected, unknown))
        require_apart(self._named, "perception", self._ego_id)
