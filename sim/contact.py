"""First contact of a moving body with others: instant, closing speed, change of velocity, side and fault."""

from dataclasses import dataclass
from typing import Literal

Side = Literal["front", "left", "right", "rear"]


@dataclass(frozen=True, slots=True)
class Contact:
    """First contact of the ego.

    Attributes:
        time_s: instant of the contact, s.
        other_id: object id of the other road user; -1 for the static world.
        other: its name; `world` for the static world.
        ego_speed_mps: speed of the ego just before, m/s.
        closing_mps: speed at which the bodies approached along the contact's normal, m/s.
        delta_v_mps: change of the ego's velocity in a plastic impact, m/s.
        side: side of the ego that was touched.
        at_fault: the ego is at fault by nuPlan's rule: it moved, and was not hit from behind.
    """

    time_s: float
    other_id: int
    other: str
    ego_speed_mps: float
    closing_mps: float
    delta_v_mps: float
    side: Side
    at_fault: bool
