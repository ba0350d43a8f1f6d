"""Careful and competent human driver of UN Regulation No. 157: the yardstick of an avoidable crash.

UN R157 (Automated Lane Keeping Systems), guidance on traffic disturbance critical scenarios (Annex 3, in the first
version Annex 4, Appendix 3), Table 1, performance model of a careful and competent driver: the risk is evaluated for
0.4 s, braking begins 0.75 s after that, and grows to 0.774 g within 0.6 s. Where this driver, with the same view, does
not crash, the crash was avoidable.

The regulation's model is for cut-in, cut-out and braking ahead on motorways, and knows full braking alone; routine
braking and all other conflicts are added here.
"""

import math

import msgspec
import numpy as np

from dsrc.closed_loop.driving.planner import PlannerSettings, PlanningDriver
from dsrc.closed_loop.types import Decision, EgoState, LaneMap, Tracks

G_MPS2 = 9.80665


class CarefulSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of the reference driver.

    Attributes:
        perception_s: evaluation of a risk: time from the first sight of a road user until the driver knows of it.
        reaction_s: from the end of that until braking begins.
        ramp_s: from then until full braking.
        full_g: full braking, in g.
        routine_mps2: braking that is no reaction to a risk, as in following, and comes at once.
        calm_s: time without a risk after which the next one is a new one.
    """

    perception_s: float = 0.4
    reaction_s: float = 0.75
    ramp_s: float = 0.6
    full_g: float = 0.774
    routine_mps2: float = 1.5
    calm_s: float = 1.0


class CarefulDriver:
    """Reference driver: plans as `PlanningDriver` does, but perceives and reacts as late as the regulation's driver.

    Args:
        settings: default: `CarefulSettings()`.
    """

    def __init__(self, settings: CarefulSettings | None = None, planning: PlannerSettings | None = None) -> None:
        self.settings = settings or CarefulSettings()
        self._planner = PlanningDriver(planning)
        self.reset()

    def reset(self, lanes: LaneMap | None = None) -> None:
        """Begin an episode, see `PlanningDriver.reset`."""
        self._planner.reset(lanes)
        self._since: dict[int, float] = {}
        self._begun = False
        self._risk_s = self._last_s = -math.inf
        self._routine_mps2 = 0.0

    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        """Return the acceleration for the next step."""
        s, now = self.settings, ego.time_s
        numbers = tracks.boxes.object_id.tolist()
        # Whoever is there at the start is known: the driver has been driving.
        first = now if self._begun else -math.inf
        self._begun, self._since = True, {number: self._since.get(number, first) for number in numbers}
        known = np.array([now - self._since[number] >= s.perception_s - 1e-6 for number in numbers], bool)
        plan = self._planner.decide(ego, tracks[known])
        risky = plan.acceleration_mps2 < -s.routine_mps2 and plan.reason not in ("free", "signal")
        if not risky:
            self._routine_mps2 = min(max(-plan.acceleration_mps2, 0.0), s.routine_mps2)
            return plan
        if now - self._last_s > s.calm_s:
            self._risk_s = now
        self._last_s = now
        braking_s = now - self._risk_s - s.reaction_s
        full = s.full_g * G_MPS2
        # Braking that has begun goes on while the driver reacts to a harder need.
        strongest = max(self._routine_mps2, full * min(max(braking_s / s.ramp_s, 0.0), 1.0))
        wanted = full if plan.reason == "emergency" else -plan.acceleration_mps2
        return Decision(-min(wanted, strongest), plan.reason, plan.track)
