"""Where road users are predicted to be."""

import numpy as np
import pytest

from dsrc.closed_loop.driving.lanes import NetworkLanes, RouteLanes
from dsrc.closed_loop.driving.path import path_of
from dsrc.closed_loop.driving.prediction import predict
from dsrc.closed_loop.types import ConflictLane, Tracks
from sim.boxes import CLASSES, Boxes
from sim.catalog.load import load_scenario
from sim.roads.networks import read_network, resolve_network


class NoLanes:
    """Nobody is on a lane."""

    def ahead(self, pose: np.ndarray, length_m: np.ndarray) -> list[tuple[np.ndarray, ...]]:
        return [()] * len(pose)

    def conflicts(self, path: np.ndarray) -> tuple[ConflictLane, ...]:
        return ()


def track(
    x: float = 0.0,
    y: float = 0.0,
    heading: float = 0.0,
    speed: float = 10.0,
    rate: float = 0.0,
    label: str = "car",
    sd: float = 0.0,
) -> Tracks:
    boxes = Boxes.from_array([[x, y, 0.8, 4.5, 1.8, 1.6, heading]], [CLASSES.index(label)], [7])
    velocity = speed * np.array([[np.cos(heading), np.sin(heading)]])
    one = np.ones(1)
    return Tracks(0.0, boxes, velocity, rate * one, sd * one, one, 0.0 * one)


ZERO = np.zeros(1)


def test_without_lanes_a_track_goes_on_at_its_speed() -> None:
    ahead = predict(track(), ZERO, NoLanes())
    assert ahead.xy[0, -1] == pytest.approx([50.0, 0.0])
    assert ahead.time_s[-1] == pytest.approx(5.0)


def test_its_turn_rate_decays_to_none() -> None:
    """0.3 rad/s that decay with 3 s turn it by 0.3 * 3 * (1 - exp(-5 / 3)) = 0.73 rad."""
    ahead = predict(track(rate=0.3), ZERO, NoLanes())
    assert ahead.yaw[0, -1] == pytest.approx(0.73, abs=0.01)
    assert ahead.xy[0, 5, 1] > 0.0


def test_at_a_constant_turn_rate_it_drives_the_circle_for_a_second() -> None:
    ahead = predict(track(rate=0.2, speed=8.0), ZERO, NoLanes())
    assert ahead.xy[0, 5] == pytest.approx([40.0 * np.sin(0.2), 40.0 * (1.0 - np.cos(0.2))], abs=0.12)


def test_who_stands_stays_and_a_pedestrian_walks_straight_on() -> None:
    stands = predict(track(speed=0.1), ZERO, NoLanes())
    assert np.ptp(stands.xy[0], axis=0).max() == 0.0
    walks = predict(track(speed=1.5, rate=0.5, label="pedestrian"), ZERO - 1.0, NoLanes())
    assert walks.xy[0, -1] == pytest.approx([7.5, 0.0])


def test_who_brakes_stops_and_does_not_drive_back() -> None:
    ahead = predict(track(speed=5.0), ZERO - 4.0, NoLanes())
    assert ahead.xy[0, -1, 0] == pytest.approx(3.125, abs=0.1)
    assert ahead.speed_mps[0].min() == 0.0


def test_uncertainty_grows_for_those_who_move_only() -> None:
    moves, stands = (predict(track(speed=v, sd=0.1), ZERO, NoLanes()).spread_m[0] for v in (10.0, 0.0))
    assert (np.diff(moves) >= 0.0).all()
    assert moves[-1] > moves[0] == pytest.approx(0.1)
    assert np.ptp(stands) == 0.0


def test_along_the_route_of_the_ego_others_keep_their_distance_in_a_bend() -> None:
    angle = np.linspace(0.0, 1.5, 200)
    route = 60.0 * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])
    lanes = RouteLanes(path_of(route, 0.0, 5.0))
    # Towards the ego, 3.2 m to its left: a smaller circle about the same centre.
    at, radius = 1.0, 60.0 - 3.2
    x, y = radius * np.sin(at), 60.0 - radius * np.cos(at)
    ahead = predict(track(x, y, at + np.pi, 10.0), ZERO, lanes)
    gap = np.hypot(ahead.xy[0, :, 0], ahead.xy[0, :, 1] - 60.0)
    assert gap[:25] == pytest.approx(radius, abs=0.4)


@pytest.fixture(scope="module")
def crossing() -> NetworkLanes:
    scenario = load_scenario("rilsa_1")
    return NetworkLanes(read_network(resolve_network(scenario, 0)))


def test_along_lanes_a_track_follows_the_bend_of_its_lane(crossing: NetworkLanes) -> None:
    """Every lane of the network: a vehicle at its beginning stays within a metre of it."""
    lines = [line for line in crossing.lines if len(line) > 25][:40]
    for line in lines:
        x, y, heading = line[2]
        ahead = predict(track(x, y, heading, 8.0), ZERO, crossing)
        best = int(np.flatnonzero(ahead.likely)[0])
        gap = np.hypot(*(ahead.xy[best, :10, None] - line[None, :, :2]).transpose(2, 0, 1)).min(axis=1)
        assert gap.max() < 1.0


def test_where_a_lane_forks_there_are_several_hypotheses_and_one_is_likely(crossing: NetworkLanes) -> None:
    counts = []
    for line in crossing.lines:
        if len(line) < 30:
            continue
        x, y, heading = line[-20]
        ahead = predict(track(x, y, heading, 8.0), ZERO, crossing)
        counts.append(len(ahead))
        assert ahead.likely.sum() == 1
        assert (ahead.row == 0).all()
    assert max(counts) > 1


def test_who_is_too_fast_for_a_bend_does_not_take_it(crossing: NetworkLanes) -> None:
    slow, fast = 0, 0
    for line in crossing.lines:
        if len(line) < 60:
            continue
        x, y, heading = line[-10]
        slow += len(predict(track(x, y, heading, 6.0), ZERO, crossing))
        fast += len(predict(track(x, y, heading, 22.0), ZERO, crossing))
    assert fast < slow


def test_equivariance_to_rotation_and_translation_without_lanes() -> None:
    here = predict(track(rate=0.2), ZERO - 1.0, NoLanes())
    there = predict(track(3.0, -4.0, 0.7, rate=0.2), ZERO - 1.0, NoLanes())
    c, s = np.cos(0.7), np.sin(0.7)
    assert there.xy[0] == pytest.approx(here.xy[0] @ np.array([[c, s], [-s, c]]) + [3.0, -4.0])


def test_no_tracks_no_predictions() -> None:
    none = Tracks(0.0, Boxes.zeros(), np.zeros((0, 2)), *(np.zeros(0) for _ in range(4)))
    assert len(predict(none, np.zeros(0), NoLanes())) == 0
