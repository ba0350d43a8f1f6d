"""A driven ego that gives up overtaking and goes back behind the vehicle ahead."""

import numpy as np

from sim.encounters.paths import ReferencePath
from sim.encounters.types import Overtaking
from sim.traffic.scripted.mover import Mover

_BRAKES_MPS2 = 3.0
_SLOWER_MPS = 1.0
_FAR_M = 40.0
_BACK_S, _LEAST_BACK_M = 1.6, 12.0


def gives_up(ego: Mover, plan: Overtaking, ahead: Mover | None) -> bool:
    """Return whether a driver on the way out stays behind the vehicle ahead, or goes back there.

    That is so while it is behind that vehicle and brakes hard or is slower; and where it has nothing to overtake, since
    the vehicle is far away. Without that vehicle, as in the control `no_occluder`, it goes back when it brakes hard.

    Args:
        ahead: the vehicle to overtake; None without it.
    """
    if ego.at_m < plan.start_m:
        return False
    brakes = ego.gained_mps2 < -_BRAKES_MPS2
    if ahead is None:
        return brakes
    place = plan.lane.nearest(ego.actor.path.at(ego.at_m)[0][:2])
    lead = plan.lane.nearest(ahead.actor.path.at(ahead.at_m)[0][:2])
    gap = lead - place - 0.5 * (ego.actor.kind.size[0] + ahead.actor.kind.size[0])
    return gap > _FAR_M or (gap > 0.0 and (brakes or ego.speed < ahead.speed - _SLOWER_MPS))


def way_back(ego: Mover, lane: ReferencePath) -> tuple[ReferencePath, float]:
    """Return the path from the ego's place back to a lane, and the distance of that place along it, m."""
    old, reach = ego.actor.path, max(_BACK_S * ego.speed, _LEAST_BACK_M)
    # Distance to the left of the lane now, one metre and two metres before: value, slope and bend of the way out.
    places = old.at(ego.at_m - np.array([0.0, 1.0, 2.0]))[0][:, :2]
    start = lane.nearest(places[0])
    left = np.array([_left_of(lane, place) for place in places])
    slope, bend = 1.5 * left[0] - 2.0 * left[1] + 0.5 * left[2], left[0] - 2.0 * left[1] + left[2]
    onward = lane.along[lane.along > start + 0.2]
    share = np.clip((onward - start) / reach, 0.0, 1.0)
    offset = _ease(share, float(left[0]), float(slope) * reach, float(bend) * reach**2)
    points, heading, _ = lane.at(onward)
    normal = np.column_stack([-np.sin(heading), np.cos(heading)])
    before = old.points[old.along < ego.at_m, :2]
    path = ReferencePath.through(np.concatenate([before, places[:1], points[:, :2] + offset[:, None] * normal]), 0.0)
    return path, path.nearest(places[0])


def _left_of(lane: ReferencePath, place: np.ndarray) -> float:
    foot, heading, _ = lane.at(lane.nearest(place))
    return float((place - foot[:2]) @ [-np.sin(heading), np.cos(heading)])


def _ease(share: np.ndarray, value: float, slope: float, bend: float) -> np.ndarray:
    """Return the quintic of `share` in [0, 1] from a value with its slope and bend to rest at 0."""
    c3 = -10.0 * value - 6.0 * slope - 1.5 * bend
    c4 = 15.0 * value + 8.0 * slope + 1.5 * bend
    c5 = -6.0 * value - 3.0 * slope - 0.5 * bend
    return value + share * (slope + share * (0.5 * bend + share * (c3 + share * (c4 + share * c5))))
