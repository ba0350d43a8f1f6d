"""A driver that expects somebody wherever it cannot see, and nobody where it can."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from dsrc.closed_loop.driving.anticipating import AnticipatingDriver, AnticipatingSettings
from dsrc.closed_loop.driving.planner import PlanningDriver
from dsrc.closed_loop.loop import ClosedLoop, LoopSettings
from dsrc.closed_loop.perception.open import open_perception
from dsrc.closed_loop.types import ConflictLane, Decision, EgoState, LaneMap, Outcome, Tracks
from dsrc.messages.seen_space import SeenSpace
from sim.geometry import Array
from tests.dsrc.closed_loop.driving.world import CAR, Other, Run, run

SETTINGS = AnticipatingSettings()
CROSSES_M = 60.0
"""Where a lane from the right crosses the way of the ego, which drives east along y = 0."""


class Shadow(SeenSpace):
    """All that a function does not hide, seen at a time."""

    def __init__(self, hides: Callable[[Array], NDArray[np.bool_]], time_s: float) -> None:
        super().__init__(())
        self._hides, self._time_s = hides, time_s

    def seen_s(self, xy: Array) -> Array:
        return np.where(self._hides(xy), -np.inf, self._time_s)


class Crossing:
    """Map of one lane from the south."""

    def __init__(self, speed_mps: float = 14.0) -> None:
        y = np.arange(-150.0, 30.0)
        line = np.column_stack([np.full(len(y), CROSSES_M), y, np.full(len(y), 0.5 * np.pi)])
        self.lane = ConflictLane(line, np.full(len(y), speed_mps), int((y < -1.6).sum()), False, False)

    def ahead(self, pose: Array, length_m: Array) -> list[tuple[Array, ...]]:
        return [()] * len(pose)

    def conflicts(self, path: Array) -> tuple[ConflictLane, ...]:
        return (self.lane,) if path[0, 0] < CROSSES_M else ()


class Looking(AnticipatingDriver):
    """The driver, which looks at shadows that a function of the ego's place throws."""

    def __init__(self, hides: Callable[[float], Callable[[Array], NDArray[np.bool_]]], lanes: LaneMap | None) -> None:
        self._hides, self._map = hides, lanes
        super().__init__()

    def reset(self, lanes: LaneMap | None = None) -> None:
        super().reset(self._map)

    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        self.see(Shadow(self._hides(float(ego.box.center[0, 0])), ego.time_s))
        return super().decide(ego, tracks)


def corner(edge_y: float) -> Callable[[float], Callable[[Array], NDArray[np.bool_]]]:
    """A house whose corner stands 4 m before the lane and |edge_y| m right of the ego's way."""

    def from_ego(x: float) -> Callable[[Array], NDArray[np.bool_]]:
        def hides(xy: Array) -> NDArray[np.bool_]:
            right = xy[:, 1] < edge_y
            to_corner = CROSSES_M - 4.0 - x
            if to_corner <= 0.0:
                return np.zeros(len(xy), bool)
            return np.asarray(right & (xy[:, 1] * to_corner < edge_y * (xy[:, 0] - x)))

        return hides

    return from_ego


def nothing(x: float) -> Callable[[Array], NDArray[np.bool_]]:
    return lambda xy: np.zeros(len(xy), bool)


def decisions(driver: AnticipatingDriver | PlanningDriver, others: Sequence[Other] = ()) -> Run:
    return run(driver, others, speed=12.0, seconds=10.0)


CASES: tuple[tuple[Other, ...], ...] = ((), (Other(50.0, 0.0, 6.0, 0.0),), (Other(CROSSES_M, -50.0, 0.0, 10.0),))


@pytest.mark.parametrize("others", CASES)
def test_who_sees_everything_or_has_no_seen_space_drives_as_the_planner_does(others: tuple[Other, ...]) -> None:
    planned = decisions(PlanningDriver(), others).decisions
    assert decisions(AnticipatingDriver(), others).decisions == planned
    assert decisions(Looking(nothing, None), others).decisions == planned


def test_where_its_own_lane_is_hidden_it_could_stop_before_at_any_time() -> None:
    wall_m = 70.0
    out = decisions(Looking(lambda x: lambda xy: xy[:, 0] > wall_m, None))
    left = np.maximum(wall_m + 0.5 - 0.5 * CAR[0] - np.array(out.x), 0.0)  # its path has steps of half a metre
    stops = np.maximum(np.sqrt(2.0 * SETTINGS.brakes_mps2 * left), SETTINGS.creeps_mps)
    assert (np.array(out.speed) <= stops + 0.2).all()
    assert out.speed[0] > 10.0 and out.hardest < SETTINGS.brakes_mps2 + 1.0
    assert {decision.reason for decision in out.decisions[45:80]} == {"hidden"}


def test_where_it_sees_too_little_it_creeps_on() -> None:
    out = decisions(Looking(lambda x: lambda xy: xy[:, 0] > 40.0, None))
    later = np.array(out.speed[-20:])
    assert out.x[-1] > 40.0
    assert later == pytest.approx(np.full(20, SETTINGS.creeps_mps), abs=0.2)


@pytest.mark.parametrize("crossing", [Crossing(), None])
def test_who_loses_a_view_for_a_moment_does_not_brake_for_it(crossing: LaneMap | None) -> None:
    """A view of 0.2 s in which a lane is hidden from the middle on, amid others in which it is not."""

    class Blinking(Looking):
        def see(self, seen: SeenSpace) -> None:
            blinks = 1.0 <= seen.seen_s(np.zeros((1, 2)))[0] < 1.15
            super().see(Shadow(blinks_at if blinks else nothing(0.0), float(seen.seen_s(np.zeros((1, 2)))[0])))

    def blinks_at(xy: Array) -> NDArray[np.bool_]:
        return np.asarray((xy[:, 0] > 45.0) & (np.abs(xy[:, 1]) < 30.0) & (np.hypot(*xy.T) > 5.0))

    planned = decisions(PlanningDriver()).decisions
    assert decisions(Blinking(nothing, crossing)).decisions == planned


def test_behind_a_tracked_leader_nobody_is_expected() -> None:
    lorry = Other(40.0, 0.0, 12.0, 0.0)

    def behind(x: float) -> Callable[[Array], NDArray[np.bool_]]:
        return lambda xy: xy[:, 0] > x + 37.0  # its rear

    planned = decisions(PlanningDriver(), [lorry]).speed
    assert decisions(Looking(behind, None), [lorry]).speed[10] == pytest.approx(planned[10], abs=0.5)


def test_before_a_blind_corner_it_slows_down_and_goes_on_when_it_sees_enough() -> None:
    out = run(Looking(corner(-4.0), Crossing()), speed=12.0, seconds=20.0)
    before = np.array(out.x) < CROSSES_M - 3.0
    slowest = np.array(out.speed)[before].min()
    assert slowest < 6.0 and out.hardest < SETTINGS.brakes_mps2 + 1.0
    assert out.x[-1] > CROSSES_M + 30.0


def test_the_wider_the_view_the_less_it_slows_down() -> None:
    slowest = [min(run(Looking(corner(y), Crossing()), speed=12.0, seconds=8.0).speed) for y in (-4.0, -10.0, -30.0)]
    assert slowest == sorted(slowest) and slowest[0] + 1.0 < slowest[-1]


@pytest.mark.parametrize(("speed", "start_y"), [(6.0, -35.0), (10.0, -50.0), (14.0, -72.0), (14.0, -80.0)])
def test_who_comes_out_of_the_shadow_at_up_to_the_limit_is_not_hit(speed: float, start_y: float) -> None:
    """The other is tracked from 0.3 s after it could be seen."""

    class Tracked(Looking):
        def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
            hidden = corner(-4.0)(float(ego.box.center[0, 0]))(tracks.boxes.center[:, :2] - 0.3 * tracks.velocity)
            return super().decide(ego, tracks[~hidden])

    out = run(Tracked(corner(-4.0), Crossing()), [Other(CROSSES_M, start_y, 0.0, speed)], speed=12.0, seconds=11.0)
    assert not out.hit and out.x[-1] > CROSSES_M


def outcome(name: str, seed: int, driver: AnticipatingDriver | PlanningDriver) -> Outcome:
    settings = LoopSettings(duration_s=30.0, detect_every_s=0.2)
    return ClosedLoop(name, open_perception("sight"), driver, settings).run(seed)


@pytest.mark.slow
def test_with_the_same_eyes_it_avoids_a_crash_of_the_planner() -> None:
    assert outcome("lta_truck", 10, PlanningDriver()) is Outcome.CRASHED
    assert outcome("lta_truck", 10, AnticipatingDriver()) is Outcome.ARRIVED


VEHICLES = (
    "ima_building",
    "ima_queue",
    "lta_truck",
    "red_light_runner",
    "dnpw_overtake",
    "eebl_chain",
    "stalled_after_curve",
    "cut_in_merge",
    "roundabout_entry",
)


@pytest.mark.slow
@pytest.mark.parametrize("name", VEHICLES)
def test_with_its_own_sight_it_crashes_in_no_encounter_with_a_vehicle(name: str) -> None:
    assert [outcome(name, seed, AnticipatingDriver()) for seed in range(10, 20)] == [Outcome.ARRIVED] * 10


def taken_s(name: str, driver: AnticipatingDriver | PlanningDriver, eyes: str, seed: int) -> float:
    loop = ClosedLoop(name, open_perception(eyes), driver, LoopSettings(duration_s=30.0, detect_every_s=0.2))
    assert loop.run(seed) is Outcome.ARRIVED
    return loop.tick.actors.time_s - loop.start_s


@pytest.mark.slow
@pytest.mark.parametrize("name", VEHICLES)
@pytest.mark.parametrize("eyes", ["truth", "sight"])
def test_where_nothing_hides_anybody_it_is_at_most_1500_ms_slower_than_the_planner(eyes: str, name: str) -> None:
    for seed in (10, 11, 12):
        planned = taken_s(f"{name}:no_occluder", PlanningDriver(), eyes, seed)
        assert taken_s(f"{name}:no_occluder", AnticipatingDriver(), eyes, seed) <= planned + 1.5


@pytest.mark.slow
def test_behind_corners_with_nobody_it_takes_less_than_2_s_longer_on_average() -> None:
    drivers = (PlanningDriver, AnticipatingDriver)
    took = [[taken_s(f"{name}:no_conflict", one(), "sight", 10) for one in drivers] for name in VEHICLES]
    planned, expecting = np.mean(took, axis=0)
    assert expecting < planned + 2.0
