"""Clock of an encounter's script, which waits for an ego that is driven otherwise than scripted."""

import math
from collections.abc import Sequence

import numpy as np

from sim.encounters.types import HIT_S, ScriptedActor

COMMIT_S = 4.0
"""Time of the script before the crash from which on the others no longer wait for the ego, s."""

RATE = (0.5, 1.25)
"""Slowest and fastest rate of the clock."""

_SAME_S = 0.02
"""Difference of arrival up to which the ego is where its script has it, s."""
_FASTEST_PER_S = 1.0
"""Fastest change of the rate, where the actors would allow a faster one, per s."""
_GAIN_PER_S2 = 2.0
"""Change of the rate per second and second of difference."""
_LAG_S = 0.1
"""Lasting difference behind an ego of constant speed; a higher gain keeps it."""
_GRAIN_M = 0.5
_EVERY_S = 0.05


class ScriptClock:
    """Clock of all actors of an encounter but the ego.

    While the ego is where its script has it, the clock is the time. Else it tends to `HIT_S` minus the ego's time to
    the place where the script has it at `HIT_S`, for a reference driver who accelerates as hard as the ego can to the
    scripted speed of each place. Its rate stays within `RATE` and changes no faster than the actors can accelerate and
    brake comfortably. At `HIT_S - COMMIT_S` it commits: it returns to the rate 1 and stays there.

    Attributes:
        offset_s: clock minus time, s.
        rate: of the clock.
        committed: the others no longer wait.
        gap_s: at the commit, how much later than the actors the ego will arrive, s, if it drives as the reference
            driver; infinite before.

    Args:
        step_s: time step, s.
    """

    def __init__(self, ego: ScriptedActor, others: Sequence[ScriptedActor], step_s: float) -> None:
        self.offset_s, self.rate = 0.0, 1.0
        self.committed, self.gap_s = False, math.inf
        self._ego, self._step_s = ego, step_s
        self._hit_m = float(ego.place(HIT_S))
        self._times = np.arange(-2.0, HIT_S + 3.0, _EVERY_S)
        self._places = ego.place(self._times)
        self._others = [other for other in others if float(other.pace.at(self._times).max()) > 0.0]
        fastest = [float(other.pace.at(self._times).max()) for other in self._others]
        limits = [other.kind.accel_mps2 for other in self._others]
        # How fast the rate returns to 1, from below and from above.
        self._up = min([_FASTEST_PER_S, *(a[0] / v for a, v in zip(limits, fastest, strict=True))])
        self._down = min([_FASTEST_PER_S, *(a[1] / v for a, v in zip(limits, fastest, strict=True))])

    def advance(self, time_s: float, ego_at_m: float, ego_mps: float, *, driven: bool) -> None:
        """Move the clock from a time to one step later.

        Args:
            ego_at_m: distance of the ego along its path, m.
            driven: whether the ego has ever been commanded.
        """
        now_s = time_s + self.offset_s
        if not self.committed:
            ahead_s = self.eta(ego_at_m, ego_mps) - self._remaining(now_s)
            if now_s >= HIT_S - COMMIT_S - 1e-9:
                self.committed, self.gap_s = True, ahead_s
            elif driven:
                self._adapt(now_s, ahead_s)
                return
        self._change_rate(now_s, self._towards_one())

    def eta(self, at_m: float, speed_mps: float) -> float:
        """Return the time that the reference driver needs to the place of the ego at `HIT_S`, s; negative beyond it.

        Args:
            at_m: distance of the ego along its path, m.
        """
        scripted_s = HIT_S - float(np.interp(at_m, self._places, self._times))
        if at_m >= self._hit_m:
            return scripted_s
        way = np.linspace(at_m, self._hit_m, max(2, math.ceil((self._hit_m - at_m) / _GRAIN_M) + 1))
        script = self._ego.pace.at(np.interp(way, self._places, self._times))
        strongest, comfortable, _ = self._ego.kind.accel_mps2
        faster = np.sqrt(speed_mps**2 + 2.0 * strongest * (way - at_m))
        slower = np.sqrt(np.maximum(speed_mps**2 - 2.0 * comfortable * (way - at_m), 0.0))
        driven = np.maximum(np.minimum(script, faster), slower)
        return scripted_s + _duration(way, driven) - _duration(way, script)

    def _remaining(self, now_s: float) -> float:
        """Return the time until the clock is `HIT_S`, if its rate returns to 1 as fast as it can, s."""
        missing = 1.0 - self.rate
        return HIT_S - now_s + missing * abs(missing) / (2.0 * (self._up if missing > 0.0 else self._down))

    def _towards_one(self) -> float:
        """Return the change of the rate in a step that brings it back to 1."""
        return min(max(1.0 - self.rate, -self._down * self._step_s), self._up * self._step_s)

    def _adapt(self, now_s: float, ahead_s: float) -> None:
        """Change the rate so that the actors, who would arrive `ahead_s` before the ego, arrive with it."""
        if self.rate == 1.0 and abs(ahead_s) < _SAME_S:
            return
        gain = max(_GAIN_PER_S2, max(self._up, self._down) / _LAG_S)
        self._change_rate(now_s, self._towards_one() - gain * ahead_s * self._step_s)

    def _change_rate(self, now_s: float, change: float) -> None:
        """Change the rate within its bounds and those of all actors' accelerations, and move the clock."""
        low, high = RATE
        for other in self._others:
            speed, onward = (float(v) for v in other.pace.at([now_s, now_s + self.rate * self._step_s]))
            if onward > 0.01:
                strongest, comfortable, _ = other.kind.accel_mps2
                low = max(low, (self.rate * speed - comfortable * self._step_s) / onward)
                high = min(high, (self.rate * speed + strongest * self._step_s) / onward)
        # Where the script itself accelerates harder than that, its rate may at least stay.
        rate = min(max(self.rate + change, min(low, self.rate)), max(high, self.rate))
        self.offset_s += (0.5 * (self.rate + rate) - 1.0) * self._step_s
        self.rate = rate


def _duration(way: np.ndarray, speed: np.ndarray) -> float:
    """Return the time along a way, of constant acceleration between its points, s."""
    return float((2.0 * np.diff(way) / np.maximum(speed[1:] + speed[:-1], 0.1)).sum())
