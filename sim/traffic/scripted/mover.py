"""State of one scripted actor on its path."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sim.encounters.types import ScriptedActor

ON_SCRIPT_M = 0.25
"""Distance from its scripted place up to which a driven actor counts as on its script, m."""

_TIMES_S = np.arange(-5.0, 40.0, 0.1)


@dataclass(slots=True)
class Mover:
    """State of one actor.

    Attributes:
        actor: its script.
        object_id: id of its box.
        model: body model.
        lanes: ids of the lanes every `LANE_EVERY_M` along its path.
        at_m: distance along its path, m.
        speed: m/s.
        follows: still on its script.
        crashed: stopped by a crash.
        commanded: commanded speed, m/s.
        placed: x, y, m, and heading, rad, in place of those of its path; None on its path.
        gained_mps2: change of its speed in the last step, m/s2.
        history: positions one and two steps ago.
        set_off_s: time of the script at which it set off, of an actor with a start; None before.
    """

    actor: ScriptedActor
    object_id: int
    model: str
    lanes: tuple[str, ...]
    at_m: float
    speed: float
    follows: bool = True
    crashed: bool = False
    commanded: float | None = None
    placed: tuple[float, float, float] | None = None
    gained_mps2: float = 0.0
    history: list[NDArray[np.float64]] = field(default_factory=list)
    set_off_s: float | None = None
    _places_m: NDArray[np.float64] | None = None

    def own_s(self, script_s: float, ego: "Mover") -> float:
        """Return the time of its own script at a time of the common one, s: it waits for its start.

        Args:
            ego: whose place may set it off, already moved.
        """
        start = self.actor.start
        if start is None or start.ego_at_m is None:
            return script_s
        if self.set_off_s is None and ego.at_m >= start.ego_at_m:
            late_s = (ego.at_m - start.ego_at_m) / max(ego.speed, 0.1)
            self.set_off_s = start.script_s if ego.follows else script_s - late_s
        if self.set_off_s is None:
            return min(script_s, start.script_s)
        return script_s - self.set_off_s + start.script_s

    @property
    def on_path(self) -> bool:
        """Whether it has appeared and not yet left."""
        return 0.0 <= self.at_m < self.actor.path.length

    def pose(self) -> tuple[NDArray[np.float64], float, float]:
        """Return its (3,) position at road level, heading and pitch."""
        place, heading, slope = self.actor.path.at(self.at_m)
        if self.placed is None:
            return place, float(heading), float(slope)
        x, y, yaw = self.placed
        return np.array([x, y, place[2]]), yaw, 0.0

    def put(self, x: float, y: float, yaw: float, speed_mps: float) -> None:
        """Put it beside its path or on it: the nearest place of the path becomes its distance along it."""
        self.placed, self.at_m = (x, y, yaw), self.actor.path.nearest((x, y))
        self.speed, self.gained_mps2, self.follows = speed_mps, 0.0, False

    def is_on_script(self, script_s: float) -> bool:
        """Return whether it is where its script has it at a time of the script, s."""
        return self.follows or (not self.crashed and abs(self.at_m - float(self.actor.place(script_s))) <= ON_SCRIPT_M)

    def scripted_speed(self) -> float:
        """Return the scripted speed at its place, m/s."""
        if self._places_m is None:
            self._places_m = self.actor.place(_TIMES_S)
        # A scripted stop is skipped: the last time at a place counts.
        row = int(np.searchsorted(self._places_m, self.at_m, side="right"))
        return float(self.actor.pace.at(_TIMES_S[min(row, len(_TIMES_S) - 1)]))

    def follow_script(self, script_s: float, rate: float) -> None:
        """Move to the place of a time of the script, s, that passes at a rate."""
        self.at_m, self.gained_mps2 = float(self.actor.place(script_s)), 0.0
        self.speed = rate * float(self.actor.pace.at(script_s))

    def drive(self, wanted_mps: float, step_s: float) -> None:
        """Move for a step towards a wanted speed, within the limits of its type."""
        strongest, _, emergency = self.actor.kind.accel_mps2
        low, high = self.speed - emergency * step_s, self.speed + strongest * step_s
        speed = max(0.0, min(max(wanted_mps, low), high))
        self.at_m += 0.5 * (self.speed + speed) * step_s
        self.speed, self.gained_mps2, self.follows = speed, (speed - self.speed) / step_s, False

    def stop(self) -> None:
        """Stop dead, by a crash."""
        self.crashed, self.follows, self.speed, self.gained_mps2 = True, False, 0.0, 0.0

    def turn_onto(self, actor: ScriptedActor, at_m: float, lanes: tuple[str, ...]) -> None:
        """Continue from the same place, which is `at_m` along the path of a changed actor, with the same speeds."""
        self.actor = replace(actor, start_m=actor.start_m + at_m - self.at_m)
        self.at_m, self.lanes, self._places_m = at_m, lanes, None
