"""Encounter of an episode: the class of its conflict actor, and whether the ego met it."""

from collections.abc import Sequence

import numpy as np

from dsrc.closed_loop.types import Tick
from sim.encounters import encounter_of
from sim.scenario import Scenario
from sim.traffic.script import actor_ids

LATE_S = 1.0
"""Difference of arrival at the conflict, when its actor no longer waits, from which on an encounter is lost, s."""

_SAME_PLACE_M = 3.0
_CLOSE_S = 2.0
_TRACKED_M = 2.5


def conflict_class(scenario: Scenario, seed: int) -> str:
    """Return the class of the conflict actor of a scenario with its proven encounter; "" without one."""
    if scenario.conflict is None:
        return ""
    actors = encounter_of(scenario, seed).layout.actors
    return next((one.kind.label for one in actors if "conflict" in one.roles), "")


def encounter_agents(scenario: Scenario, seed: int) -> tuple[int, ...]:
    """Return the ids of the agents of a scenario with its proven encounter: vehicles, ego first, and roadside units."""
    ids = actor_ids(encounter_of(scenario, seed).layout.actors)
    rule = scenario.agents
    return (*(ids[name] for name in rule.named if name in ids), *range(-1, -len(rule.roadside) - 1, -1))


def lost_encounter(ticks: Sequence[Tick], ego_id: int, conflict_id: int, gap_s: float) -> bool:
    """Return whether an ego that did not crash never met its encounter.

    A crash that never threatened says nothing about a perception. It did not meet it if it came too late for the
    conflict actor, or if it was not where the actor was within `_CLOSE_S` without ever having tracked it: it stood for
    something else.

    Args:
        ego_id: object id of the ego.
        conflict_id: object id of the conflict actor.
        gap_s: see `DrivableTraffic.encounter_gap_s`.
    """
    if abs(gap_s) > LATE_S:
        return True
    places: dict[int, list[tuple[float, float, float]]] = {ego_id: [], conflict_id: []}
    for tick in ticks:
        center, ids = tick.actors.boxes.center, tick.actors.boxes.object_id
        for object_id, known in places.items():
            for row in np.flatnonzero(ids == object_id):
                known.append((tick.actors.time_s, float(center[row, 0]), float(center[row, 1])))
                if object_id == conflict_id and len(tick.tracks):
                    away = np.linalg.norm(tick.tracks.boxes.center[:, :2] - center[row, :2], axis=1)
                    if away.min() < _TRACKED_M:
                        return False
    ego, other = (np.array(known).reshape(-1, 3) for known in places.values())
    apart = np.linalg.norm(ego[:, None, 1:] - other[None, :, 1:], axis=2)
    between = np.abs(ego[:, None, 0] - other[None, :, 0])
    return not bool(((apart < _SAME_PLACE_M) & (between < _CLOSE_S)).any())
