"""Safe speed of an encounter: from how fast an ego stops before the conflict actor that sees with its own LiDAR alone.

The rollout without a reaction is slowed down for the ego, while all others keep their time to the collision: ego and
conflict actor meet at every speed, which is the worst that the conflict actor could do. Where the conflict actor drives
ahead of the ego, or the ego overtakes, the gap decides and not the speed: there is no safe speed.
"""

from dataclasses import dataclass, replace

import msgspec
import numpy as np

from sensors.recording.encounter_check import (
    BRAKING_MPS2,
    CONFLICT_ID,
    EGO_ID,
    LATENCY_S,
    UNSEEN_POINTS,
    PointCounter,
    last_chance,
    roll_out,
)
from sensors.recording.static_scene import static_scene
from sensors.scan.scene import RayScene
from sim.boxes import Boxes
from sim.collisions import overlap
from sim.encounters import encounter_of, with_encounter
from sim.geometry import Array
from sim.scenario import Scenario
from sim.traffic.base import Actors

_SLOWS_MPS2, _GAINS_MPS2 = 2.5, 2.0
"""Comfortable braking and acceleration: those of the drivers."""
_EXACT_MPS = 0.25
_ONWARD_M = 8.0
"""Way of the conflict actor beyond the collision that counts as its, m: past the body of the ego."""
_ALIKE, _STANDS_MPS = 0.8, 1.0
"""Cosine between two headings from which on they drive along, and speed up to which an actor stands."""


class SafeSpeed(msgspec.Struct, frozen=True, kw_only=True):
    """Safe speed of an encounter.

    Attributes:
        comes_mps: speed of the ego in the encounter when it could stop for the last time.
        safe_mps: highest speed from which it stops before the way of the conflict actor with `BRAKING_MPS2`,
            `LATENCY_S` after its own LiDAR has `UNSEEN_POINTS` points on it.
        costs_s: time that it loses if it slows down to that speed with 2.5 m/s2 and gains speed again with 2 m/s2.
    """

    comes_mps: float
    safe_mps: float
    costs_s: float


def safe_speed(scenario: Scenario, seed: int) -> SafeSpeed | None:
    """Return the safe speed of an encounter; None where the gap decides and not the speed.

    Args:
        scenario: with the draw that is to be examined, see `find_encounter`.

    Raises:
        ScenarioError: it has no encounter, or a value is out of its range.
    """
    layout = encounter_of(scenario, seed).layout
    scenario = with_encounter(scenario, seed)
    drive = roll_out(scenario, seed)
    if drive.hit != "conflict" or layout.actors[0].overtaking is not None:
        return None
    _, _, limit = last_chance(drive, scenario.step_s)
    assert drive.hit_s is not None
    steps = drive.steps[: round(drive.hit_s / scenario.step_s) + 1]
    way, last = _Way.of(steps), steps[-1]
    turned = np.subtract(*last.boxes.yaw[[last.row(EGO_ID), last.row(CONFLICT_ID)]])
    moves = any(np.hypot(*one.velocity[one.row(CONFLICT_ID)]) > _STANDS_MPS for one in steps if _is_in(one))
    if moves and np.cos(turned) > _ALIKE:
        return None
    scene, entry_m = static_scene(scenario, seed), way.entry_m(steps)
    came, low = float(way.speed[limit]), 0.0
    high = came
    while high - low > _EXACT_MPS:
        middle = 0.5 * (low + high)
        seen_m, seen_mps = _first_sight(scene, scenario, seed, steps, way, middle)
        stops = entry_m - seen_m >= seen_mps * LATENCY_S + 0.5 * seen_mps**2 / BRAKING_MPS2
        low, high = (middle, high) if stops else (low, middle)
    costs_s = 0.5 * (came - low) ** 2 / came * (1.0 / _SLOWS_MPS2 + 1.0 / _GAINS_MPS2)
    return SafeSpeed(comes_mps=round(came, 2), safe_mps=round(low, 2), costs_s=round(costs_s, 2))


@dataclass(frozen=True, slots=True, eq=False)
class _Way:
    """Way of the ego to the collision: (T,) distances, m, and speeds, m/s, (T, 3) centres and (T,) headings, rad."""

    along: Array
    speed: Array
    center: Array
    yaw: Array

    @classmethod
    def of(cls, steps: tuple[Actors, ...]) -> "_Way":
        rows = [step.row(EGO_ID) for step in steps]
        center = np.array([step.boxes.center[row] for step, row in zip(steps, rows, strict=True)])
        done = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(center[:, :2], axis=0).T))])
        speed = np.array([np.hypot(*step.velocity[row]) for step, row in zip(steps, rows, strict=True)])
        yaw = np.unwrap([step.boxes.yaw[row] for step, row in zip(steps, rows, strict=True)])
        return cls(done, speed, center, yaw)

    def at(self, along_m: Array) -> tuple[Array, Array]:
        """Return (N, 3) centres and (N,) headings after distances."""
        xyz = [np.interp(along_m, self.along, self.center[:, axis]) for axis in range(3)]
        return np.stack(xyz, axis=1), np.interp(along_m, self.along, self.yaw)

    def entry_m(self, steps: tuple[Actors, ...]) -> float:
        """Return the distance at which the ego first touches where the conflict actor drives or stands."""
        bodies = np.concatenate([_outline(step, CONFLICT_ID) for step in steps if _is_in(step)])
        onward = _outline(steps[-1], CONFLICT_ID, _ONWARD_M)
        places = np.arange(0.0, self.along[-1], 0.1)
        center, yaw = self.at(places)
        size = steps[-1].boxes.size[steps[-1].row(EGO_ID)]
        mine = Boxes.from_array(np.column_stack([center, np.tile(size, (len(places), 1)), yaw])).bev_polygons()
        touched = np.zeros(len(places), bool)
        for body in (*bodies, *onward):
            touched |= overlap(mine, body[None])
        return float(places[touched.argmax()]) if touched.any() else float(self.along[-1])


def _is_in(actors: Actors) -> bool:
    """Return whether the conflict actor is there, which may come later."""
    return CONFLICT_ID in actors.boxes.object_id


def _outline(actors: Actors, number: int, ahead_m: float = 0.0) -> Array:
    """Return the (1, 4, 2) corners of an actor, longer to the front if it moves."""
    row = actors.row(number)
    box = actors.boxes[row : row + 1]
    ahead_m = ahead_m if np.hypot(*actors.velocity[row]) > _STANDS_MPS else 0.0
    heading = np.array([np.cos(box.yaw[0]), np.sin(box.yaw[0]), 0.0])
    longer = replace(box, center=box.center + 0.5 * ahead_m * heading, size=box.size + np.array([ahead_m, 0.0, 0.0]))
    return longer.bev_polygons()


def _first_sight(
    scene: RayScene, scenario: Scenario, seed: int, steps: tuple[Actors, ...], way: _Way, most_mps: float
) -> tuple[float, float]:
    """Return distance and speed of an ego no faster than `most_mps` when it comes to see the conflict actor for good.

    Those of the collision, if it never does.
    """
    slowed, places = [], [float(way.along[-1])]
    while places[-1] > 0.0:
        speed = min(most_mps, float(np.interp(places[-1], way.along, way.speed)))
        places.append(places[-1] - max(speed, 0.1) * scenario.step_s)
    center, yaw = way.at(np.array(places))
    for row, (there, turned) in enumerate(zip(center, yaw, strict=True)):
        then = steps[max(len(steps) - 1 - row, 0)]
        boxes = replace(then.boxes, center=then.boxes.center.copy(), yaw=then.boxes.yaw.copy())
        velocity, ego = then.velocity.copy(), then.row(EGO_ID)
        boxes.center[ego], boxes.yaw[ego] = there, turned
        velocity[ego] *= min(1.0, most_mps / max(float(np.hypot(*velocity[ego])), 0.1))
        slowed.append(replace(then, time_s=-row * scenario.step_s, boxes=boxes, velocity=velocity))
    # A scan needs the step after it too; at the collision nobody moves on.
    counter = PointCounter(scene, scenario, seed, [*slowed[::-1], replace(slowed[0], time_s=scenario.step_s)])
    back = 0
    while back + 1 < len(slowed) and counter.points("ego", len(slowed) - 2 - back) >= UNSEEN_POINTS:
        back += 1
    return places[back], min(most_mps, float(np.interp(places[back], way.along, way.speed)))
