"""A driver that steers around somebody where full braking would still hit, and only there."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from dsrc.closed_loop.driving.bicycle import STEERING_RAD_S, bicycle_step, steering_for, wheels_of
from dsrc.closed_loop.driving.evading import EvadingDriver
from dsrc.closed_loop.driving.planner import PlanningDriver
from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.loop import ClosedLoop, LoopSettings
from dsrc.closed_loop.perception.open import open_perception
from dsrc.closed_loop.types import ConflictLane, Decision, Outcome
from dsrc.messages.seen_space import SeenSpace
from sim.boxes import Boxes
from sim.collisions import collide
from sim.geometry import Array
from tests.dsrc.closed_loop.driving.world import CAR, STEP_S, Other, ego_at, tracks_of

LANE_M = 3.5
BRAKES_MPS2, GAINS_MPS2 = 7.5, 2.6


class Street:
    """Straight lanes eastward at some y, and westward at others."""

    def __init__(self, east: Sequence[float], west: Sequence[float] = ()) -> None:
        self._east, self._west = east, west

    def ahead(self, pose: Array, length_m: Array) -> list[tuple[Array, ...]]:
        found = []
        for (x, y, heading), length in zip(pose, length_m, strict=True):
            lanes = self._east if np.cos(heading) > 0.8 else self._west if np.cos(heading) < -0.8 else ()
            way = np.sign(np.cos(heading)) * np.arange(0.0, length + 2.0)
            near = [lane for lane in lanes if abs(y - lane) < 2.6]
            turned = 0.0 if np.cos(heading) > 0 else np.pi
            found.append(
                tuple(np.column_stack([x + way, np.full(len(way), lane), np.full(len(way), turned)]) for lane in near)
            )
        return found

    def conflicts(self, path: Array) -> tuple[ConflictLane, ...]:
        return ()


class Seen(SeenSpace):
    """All that lies nearer than a reach."""

    def __init__(self, reach_m: float) -> None:
        super().__init__(())
        self._reach_m = reach_m

    def seen_s(self, xy: Array) -> Array:
        return np.where(xy[:, 0] < self._reach_m, 0.0, -np.inf)


@dataclass
class Driven:
    """Course of an ego that may steer."""

    y: list[float] = field(default_factory=list)
    speed: list[float] = field(default_factory=list)
    wheels: list[float] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)
    hit: bool = False


def drive(
    driver: EvadingDriver | PlanningDriver,
    street: Street,
    others: Sequence[Other],
    speed: float,
    sees_m: float = np.inf,
) -> Driven:
    """Drive 8 s east from the origin by a bicycle model; without steering the ego is on its route, y = 0."""
    out, pose, wheels = Driven(), np.zeros((1, 3)), np.zeros(1)
    driver.reset(street)
    for step in range(80):
        if isinstance(driver, EvadingDriver):
            driver.see(Seen(sees_m))
        ego = ego_at(float(pose[0, 0]), speed, step * STEP_S, limit=speed)
        box = Boxes.from_array([[pose[0, 0], pose[0, 1], 0.5 * CAR[2], *CAR, pose[0, 2]]])
        line = np.column_stack([pose[0, 0] + np.arange(0.0, 120.0), np.zeros(120)])
        ego = replace(ego, box=box, route=np.concatenate([pose[:, :2], line[1:]]))
        tracks = tracks_of(others, step * STEP_S)
        out.hit |= bool(len(tracks) and collide(box, tracks.boxes).any())
        decision = driver.decide(ego, tracks)
        out.decisions.append(decision)
        out.y.append(float(pose[0, 1]))
        out.speed.append(speed)
        made = np.array([min(max(decision.acceleration_mps2, -BRAKES_MPS2), GAINS_MPS2)])
        if decision.steering_rad is None:
            pose[0, 1:], wheels = 0.0, np.zeros(1)
        steering = np.array([decision.steering_rad or 0.0])
        pose, new, wheels = bicycle_step(pose, np.array([speed]), wheels, made, steering, CAR[0], STEP_S)
        out.wheels.append(float(wheels[0]))
        speed = float(new[0])
    return out


SUDDEN = Other(45.0, 0.9, from_s=0.1)
"""A car that stands 0.9 m left of the middle of the lane, and is seen when the ego at 25 m/s cannot stop any more."""
TWO_LANES = Street((0.0, -LANE_M))


def test_it_steers_around_whom_full_braking_would_hit_and_returns_to_its_lane() -> None:
    assert drive(PlanningDriver(), TWO_LANES, [SUDDEN], 25.0).hit
    out = drive(EvadingDriver(), TWO_LANES, [SUDDEN], 25.0)
    assert not out.hit
    assert min(out.y) < -1.0 and max(out.y) < 0.3
    assert abs(out.y[-1]) < 0.01 and out.decisions[-1].steering_rad is None
    assert "evade" in {decision.reason for decision in out.decisions}


@pytest.mark.parametrize("other", [Other(60.0, 0.0, 12.0, 0.0, brakes=6.0), Other(70.0, 0.0)])
def test_where_braking_suffices_it_drives_as_the_planner_does(other: Other) -> None:
    planned = drive(PlanningDriver(), TWO_LANES, [other], 14.0)
    assert not planned.hit
    assert drive(EvadingDriver(), TWO_LANES, [other], 14.0).decisions == planned.decisions


@pytest.mark.parametrize(
    ("street", "others", "sees_m"),
    [
        (Street((0.0,)), [], np.inf),  # verges on both sides
        (Street((0.0,), (-LANE_M,)), [], 46.0),  # an oncoming lane that is hidden beyond whom it would pass
        # one on which somebody comes
        pytest.param(Street((0.0,), (-LANE_M,)), [Other(100.0, -LANE_M, -20.0, 0.0)], np.inf, marks=pytest.mark.slow),
        pytest.param(
            TWO_LANES,
            [Other(0.0, -LANE_M, 25.0, 0.0, label="bus", size=(40.0, 2.5, 3.0))],
            np.inf,
            marks=pytest.mark.slow,
        ),
    ],
    ids=["verge", "oncoming lane not seen", "oncoming lane with somebody", "lane with a bus"],
)
def test_where_there_is_no_free_lane_to_steer_to_it_brakes(street: Street, others: list[Other], sees_m: float) -> None:
    out = drive(EvadingDriver(), street, [replace(SUDDEN, y=0.0), *others], 25.0, sees_m)
    assert min(out.y) > -0.7
    assert min(decision.acceleration_mps2 for decision in out.decisions) < -6.0


def test_an_oncoming_lane_that_it_sees_empty_serves() -> None:
    out = drive(EvadingDriver(), Street((0.0,), (-LANE_M,)), [SUDDEN], 25.0)
    assert not out.hit and abs(out.y[-1]) < 0.01


@pytest.mark.slow
def test_people_beside_the_lane_are_not_steered_into() -> None:
    people = [Other(x, y, label="pedestrian", size=(0.5, 0.5, 1.7)) for x in (36.0, 40.0, 44.0) for y in (-2.0, -3.0)]
    out = drive(EvadingDriver(), TWO_LANES, [SUDDEN, *people], 25.0)
    assert min(out.y) > -0.7


@pytest.mark.slow
def test_forces_stay_within_the_grip_of_the_tyres() -> None:
    out = drive(EvadingDriver(), TWO_LANES, [SUDDEN], 25.0)
    sideways = np.array(out.speed) ** 2 * np.sin(np.arctan(0.5 * np.tan(out.wheels))) / (0.5 * CAR[0])
    along = [decision.acceleration_mps2 for decision in out.decisions]
    assert np.abs(sideways).max() > 4.0
    assert np.hypot(sideways, along).max() <= BRAKES_MPS2 * 1.01


@pytest.mark.parametrize("speed", [2.0, 10.0, 30.0])
def test_a_bicycle_that_is_steered_for_a_rate_turns_at_it(speed: float) -> None:
    rates: NDArray[np.float64] = np.array([-0.3, 0.0, 0.2])
    speeds = np.full(3, speed)
    wheels = steering_for(rates, speeds, 4.5)
    pose, after, _ = bicycle_step(np.zeros((3, 3)), speeds, wheels, np.full(3, -1.0), wheels, 4.5, 0.1)
    assert pose[:, 2] == pytest.approx(0.1 * rates, abs=1e-9)
    assert after == pytest.approx(speeds - 0.1)
    assert np.hypot(*pose[:, :2].T) == pytest.approx(0.1 * speeds)


def test_wheels_turn_no_faster_than_those_of_a_car_and_are_known_from_how_it_turned() -> None:
    pose, speed, wheels = np.zeros((1, 3)), np.array([8.0]), np.zeros(1)
    states = [ego_at(0.0, 8.0, 0.0)]
    for step, wanted in enumerate([0.3, 0.3, 0.3, -0.3, -0.3], 1):
        before = wheels
        pose, speed, wheels = bicycle_step(pose, speed, before, np.zeros(1), np.array([wanted]), CAR[0], STEP_S)
        assert wheels - before == pytest.approx(np.sign(wanted) * STEERING_RAD_S * STEP_S)
        box = Boxes.from_array([[*pose[0, :2], 0.5 * CAR[2], *CAR, pose[0, 2]]])
        states.append(replace(ego_at(0.0, 8.0, step * STEP_S), box=box))
        assert wheels_of(*states[-2:]) == pytest.approx(wheels)
    assert wheels_of(states[0], states[0]) == 0.0


@pytest.mark.slow
def test_behind_a_bend_it_steers_around_a_car_that_braking_hits(tmp_path: Path) -> None:
    settings = LoopSettings(detect_every_s=0.2)
    scenario = "stalled_after_curve"
    assert ClosedLoop(scenario, open_perception("sight"), PlanningDriver(), settings).run(0) is Outcome.CRASHED
    for name in ("first", "second"):
        loop = ClosedLoop(scenario, open_perception("sight"), EvadingDriver(), settings)
        assert loop.run(0) is Outcome.ARRIVED
        loop.log().save(tmp_path / f"{name}.npz")
    assert (tmp_path / "first.npz").read_bytes() == (tmp_path / "second.npz").read_bytes()
    log = EpisodeLog.load(tmp_path / "first.npz")
    steered = [tick.decision.steering_rad for tick in log.ticks]
    assert any(one is not None for one in steered)
    assert steered == [tick.decision.steering_rad for tick in loop.ticks]


def test_where_steering_does_not_help_either_it_brakes_as_the_planner_does() -> None:
    made = []
    for driver in (PlanningDriver(), EvadingDriver()):
        loop = ClosedLoop("lta_truck", open_perception("sight"), driver, LoopSettings(detect_every_s=0.2))
        assert loop.run(1) is Outcome.CRASHED
        made.append([tick.decision for tick in loop.ticks])
    assert made[0] == made[1]
