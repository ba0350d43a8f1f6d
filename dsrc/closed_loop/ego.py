"""Ego of an episode: choice of the vehicle, and its state as it knows itself."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.types import EgoState, Percept
from sim.boxes import CLASSES
from sim.errors import TrafficError
from sim.scenario import Scenario
from sim.traffic.base import Actors, DrivableTraffic

LOOK_AHEAD_M = 120.0
"""Length of the known route ahead: the stopping distance from 40 m/s at 7.5 m/s2, m."""


def choose_ego(traffic: DrivableTraffic, scenario: Scenario) -> int:
    """Return the first vehicle that the scenario names, else the car or van with the longest way left inside its area.

    Of cars and vans one that moves is taken, if there is one; a parked car goes nowhere.

    Raises:
        TrafficError: when there is none.
    """
    actors = traffic.actors
    if scenario.agents.named:
        return _named(actors, scenario)
    moving = np.linalg.norm(actors.velocity, axis=1) > 2.0
    way_left = _ways_left(traffic, scenario)
    rows = list(way_left)
    if not rows:
        raise TrafficError(f"{scenario.name}: expected a car or van inside the area after the warm-up, found none")
    return int(actors.boxes.object_id[max(rows, key=lambda row: (moving[row], way_left[row]))])


def choose_egos(traffic: DrivableTraffic, scenario: Scenario, count: int) -> tuple[int, ...]:
    """Return several vehicles: the ego of `choose_ego`, then those that the scenario names, or else the nearest to it.

    Of the nearest, cars and vans with a way left inside its area that move, and then those that stand, see
    `choose_ego`.

    Raises:
        TrafficError: there are fewer.
    """
    actors, first = traffic.actors, choose_ego(traffic, scenario)
    if scenario.agents.named:
        known = dict(zip(actors.name, actors.boxes.object_id.tolist(), strict=True))
        found = [known[name] for name in scenario.agents.named if name in known]
    else:
        away = np.linalg.norm(actors.boxes.center[:, :2] - actors.boxes.center[actors.row(first), :2], axis=1)
        stands = np.linalg.norm(actors.velocity, axis=1) <= 2.0
        rows = sorted(_ways_left(traffic, scenario), key=lambda row: (stands[row], away[row]))
        found = [first, *(one for one in actors.boxes.object_id[rows].tolist() if one != first)]
    if len(found) < count:
        expected = f"{count} cars or vans to drive inside the area after the warm-up"
        raise TrafficError(f"{scenario.name}: expected {expected}, found {len(found)}")
    return tuple(found[:count])


def ego_state(traffic: DrivableTraffic, ego_id: int, before: EgoState | None) -> EgoState:
    """Return the ego's state now.

    Args:
        traffic: with the ego on the road.
        ego_id: object id of the ego.
        before: its state one step ago; None at the start.
    """
    actors = traffic.actors
    row = actors.row(ego_id)
    box, speed = actors.boxes[row : row + 1], traffic.speed(ego_id)
    gained, driven = 0.0, 0.0
    if before is not None:
        gained = (speed - before.speed_mps) / traffic.step_s
        moved = box.center[0, :2] - before.box.center[0, :2]
        ahead = moved @ [np.cos(box.yaw[0]), np.sin(box.yaw[0])]
        driven = before.progress_m + float(np.copysign(np.linalg.norm(moved), ahead))
    return EgoState(
        time_s=actors.time_s,
        box=box,
        speed_mps=speed,
        acceleration_mps2=gained,
        route=traffic.route(ego_id, LOOK_AHEAD_M),
        limits=traffic.limits(ego_id),
        lights=traffic.signals(ego_id),
        progress_m=driven,
    )


def without_ego(percept: Percept, ego: EgoState) -> Percept:
    """Return a percept without the boxes on the ego itself, which its helpers see too.

    Args:
        percept: world frame.
        ego: the ego at the instant of the measurement.
    """
    yaw = float(ego.box.yaw[0])
    offset = percept.boxes.center[:, :2] - ego.box.center[0, :2]
    local = np.abs(offset @ np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]))
    other = (local > 0.5 * ego.box.size[0, :2]).any(axis=1)
    if other.all():
        return percept
    return replace(percept, boxes=percept.boxes[other], score=percept.score[other], velocity=percept.velocity[other])


def _named(actors: Actors, scenario: Scenario) -> int:
    name = scenario.agents.named[0]
    if name not in actors.name:
        raise TrafficError(f"{scenario.name}: expected the ego '{name}' on the road at the start, found it nowhere")
    return int(actors.boxes.object_id[actors.name.index(name)])


def _ways_left(traffic: DrivableTraffic, scenario: Scenario) -> dict[int, float]:
    """Return the way left inside the area, m, of the cars and vans that have some, by their rows."""
    actors = traffic.actors
    fit = np.isin(actors.boxes.label, [CLASSES.index("car"), CLASSES.index("van")]) & ~actors.parked()
    found = {
        int(row): _way_left(traffic.route(int(actors.boxes.object_id[row]), 300.0), scenario)
        for row in np.flatnonzero(fit)
    }
    return {row: way for row, way in found.items() if way > 0.0}


def _way_left(path: NDArray[np.float64], scenario: Scenario) -> float:
    """Return how much of a route lies inside the scenario's area before it first leaves it, m."""
    if scenario.network.area_m is not None:
        low, high = np.array(scenario.network.area_m).reshape(2, 2)
        inside = ((path >= low) & (path <= high)).all(axis=1)
        path = path[: len(path) if inside.all() else int(np.argmin(inside))]
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
