"""What full braking would have done in an episode that ended in a crash: the last moment at which it helps."""

import math

import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.types import EgoState
from sim.boxes import Boxes
from sim.collisions import overlap

_AFTER_S = 3.0
"""Time after the crash, or after the ego stands, within which the other must not come upon it, s."""
_FINE = 2
"""Places looked at in a step of the traffic: half a metre at 40 km/h."""


def last_chance(log: EpisodeLog) -> int | None:
    """Return the last step from which full braking avoids the crash with the other road user; None for none.

    The ego brakes along its route with the deceleration of its vehicle's full brake, without a reaction time. The other
    moves as it did, after the crash at its last velocity: in the last seconds before a crash an encounter's conflict
    actor does not react.

    Args:
        log: of a crash with a road user.

    Raises:
        ValueError: the episode has no contact with a road user.
    """
    contact = log.contact
    if contact is None or contact.other_id < 0:
        raise ValueError("expected an episode with a crash into a road user, found none")
    times, boxes = _motion(log, contact.other_id)
    until_s = log.ticks[-1].actors.time_s + _AFTER_S
    even = log.settings.scenario.conflict is not None  # the script of an encounter moves its actors so
    for step in range(len(log) - 2, -1, -1):
        if not _meets(braked_way(log.ticks[step].ego, log.actors.step_s, until_s, even), times, boxes):
            return step
    return None


def braked_way(ego: EgoState, step_s: float, until_s: float, even: bool) -> tuple[NDArray[np.float64], Boxes]:
    """Return the (K,) times and the K boxes of an ego that brakes fully along its route until it stands, and after.

    Args:
        step_s: step of the traffic, s.
        until_s: time of the last box, s, later where the ego stands later.
        even: the speed falls evenly within a step; else at its beginning, as in SUMO.
    """
    brake = max(ego.limits.deceleration_mps2, 1e-3)
    stand_s = ego.time_s + ego.speed_mps / brake
    count = max(math.ceil((max(until_s, stand_s + _AFTER_S) - ego.time_s) / step_s), 1)
    speed = np.maximum(ego.speed_mps - brake * step_s * np.arange(count + 1), 0.0)
    driven = np.concatenate([[0.0], np.cumsum((0.5 * (speed[:-1] + speed[1:]) if even else speed[1:]) * step_s)])
    fine = np.arange(count * _FINE + 1) / _FINE
    way = np.interp(fine, np.arange(count + 1), driven)
    straight = ego.box.center[:1, :2] + np.array([[0.0, 0.0], _ahead(ego)])
    route = ego.route if np.ptp(ego.route, axis=0).any() else straight
    legs = np.diff(route, axis=0)
    legs = legs[np.linalg.norm(legs, axis=1) > 0.0]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(legs, axis=1))])
    # Beyond the end of the known route the ego goes straight on.
    leg = np.clip(np.searchsorted(along, way, side="right") - 1, 0, len(legs) - 1)
    heading = np.arctan2(legs[leg, 1], legs[leg, 0])
    beyond = (way - along[leg])[:, None]
    starts = route[0] + np.concatenate([np.zeros((1, 2)), np.cumsum(legs, axis=0)])
    place = starts[leg] + beyond * np.column_stack([np.cos(heading), np.sin(heading)])
    centre = np.column_stack([place, np.full(len(way), ego.box.center[0, 2])])
    many = np.zeros(len(way), np.int64)
    return ego.time_s + step_s * fine, Boxes(
        centre, ego.box.size[many], np.where(way > 0.0, heading, ego.box.yaw[0]), ego.box.label[many], many
    )


def _ahead(ego: EgoState) -> NDArray[np.float64]:
    return np.array([math.cos(ego.box.yaw[0]), math.sin(ego.box.yaw[0])])


def _motion(log: EpisodeLog, object_id: int) -> tuple[NDArray[np.float64], list[tuple[Boxes, NDArray[np.float64]]]]:
    """Return times, s, and box and velocity of a road user at each of its steps."""
    found = [(tick.actors.time_s, tick.actors) for tick in log.ticks if object_id in tick.actors.boxes.object_id]
    rows = [(actors, actors.row(object_id)) for _, actors in found]
    return np.array([time_s for time_s, _ in found]), [
        (actors.boxes[row : row + 1], actors.velocity[row]) for actors, row in rows
    ]


def _meets(
    way: tuple[NDArray[np.float64], Boxes],
    times: NDArray[np.float64],
    motion: list[tuple[Boxes, NDArray[np.float64]]],
) -> bool:
    """Return whether an ego on its braked way touches the other."""
    when, own = way
    size = motion[-1][0].size
    centre = np.array([box.center[0, :2] for box, _ in motion])
    yaw = np.unwrap([float(box.yaw[0]) for box, _ in motion])
    beyond = np.maximum(when - times[-1], 0.0)[:, None] * motion[-1][1]
    place = np.column_stack([np.interp(when, times, centre[:, axis]) for axis in (0, 1)]) + beyond
    n = len(when)
    there = when >= times[0]
    other = Boxes(
        np.column_stack([place, np.zeros(n)]),
        np.repeat(size, n, axis=0),
        np.interp(when, times, yaw),
        np.zeros(n, np.int64),
        np.zeros(n, np.int64),
    )
    return bool((overlap(own.bev_polygons(), other.bev_polygons()) & there).any())
