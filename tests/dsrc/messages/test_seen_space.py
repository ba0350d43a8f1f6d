"""Seen space: no hidden place is in it, by rays; and nearly all that is in sight is."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from msgspec.structs import replace as changed
from numpy.typing import NDArray

from dsrc.closed_loop.driving.own.checked import CheckedDriver
from dsrc.closed_loop.perception.detector import DetectorPerception
from dsrc.closed_loop.perception.truth import SightPerception, TruthPerception
from dsrc.closed_loop.types import Percept, Perception
from dsrc.messages.seen_space import LOW_M, SeenSpace, View
from sensors.frame import AgentFrame
from sensors.motion import Path
from sensors.presets import get_lidar
from sensors.scan.lidar import Sensor, scan_all
from sim.geometry import Array, pose_matrix
from sim.radio import PRESETS
from tests.dsrc.closed_loop.perception.toy import EGO, HELPER, PLACES, SCENARIO, Knowing, build, instant
from tests.sensors.fakes import box, ground, scene_of

LIDAR = np.array([2.0, 1.0, 1.9])
WALLS = ((1.0, 14.0, 4.0), (20.0, 4.0, 2.0)), ((12.0, 1.0, 3.0), (-12.0, 8.0, 1.5)), ((0.4, 0.4, 4.0), (8.0, -9.0, 2.0))
LOW_CARS = ((4.5, 1.8, 1.5), (12.0, -4.0, 0.75)), ((1.8, 4.5, 1.2), (-6.0, -14.0, 0.6))
WORLD = ground() + sum(box(*one) for one in WALLS[1:] + LOW_CARS) + box(*WALLS[0])
SCENE = scene_of(WORLD)


def agent_at(xyz: Array = LIDAR, yaw: float = 0.4, time_s: float = 0.0, lidar: str = "opv2v-64") -> AgentFrame:
    """An agent in the world of walls and low cars, its LiDAR lossy as it is."""
    pose = pose_matrix(xyz, yaw)
    path = Path.through([time_s - 1.0, time_s + 1.0], np.stack([pose, pose]))
    sensor = Sensor(get_lidar(lidar), path, time_s, np.random.default_rng(0))
    (sweep,) = scan_all(SCENE, [sensor])
    down = np.eye(4)
    down[2, 3] = -xyz[2]
    return AgentFrame(EGO, "vehicle", pose @ down, 0.0, sweep)


def in_sight(xyz: Array, places: Array) -> NDArray[np.bool_]:
    """Whether any height of a road user at (N, 2) places is in the line of sight, by rays."""
    found = np.zeros(len(places), bool)
    for height in np.linspace(0.02, LOW_M, 8):
        way = np.column_stack([places, np.full(len(places), height)]) - xyz
        length = np.linalg.norm(way, axis=1)
        hits = SCENE.cast(np.tile(xyz, (len(places), 1)), way / length[:, None], 200.0)
        found |= (hits.face < 0) | (hits.distance > length - 0.05)
    return found


def places_around(xyz: Array, least_m: float, most_m: float, count: int = 20_000) -> Array:
    rng = np.random.default_rng(1)
    turn, away = rng.uniform(-np.pi, np.pi, count), rng.uniform(least_m, most_m, count)
    return xyz[:2] + np.column_stack([away * np.cos(turn), away * np.sin(turn)])


@pytest.mark.parametrize("lidar", ["opv2v-64", "carla-64", "vlp-16"])
def test_no_hidden_place_is_seen(lidar: str) -> None:
    places = places_around(LIDAR, 4.0, 80.0)
    seen = View.of(agent_at(lidar=lidar)).sees(places)
    free = in_sight(LIDAR, places)
    assert (~free).sum() > 500 and seen.sum() > 2000
    assert not (seen & ~free).any()


def test_nearly_all_that_is_in_sight_nearby_is_seen() -> None:
    places = places_around(LIDAR, 0.0, 50.0)
    seen, free = View.of(agent_at()).sees(places), in_sight(LIDAR, places)
    assert seen[free].mean() > 0.9


def test_over_a_low_car_the_road_behind_it_is_seen_and_behind_a_wall_it_is_not() -> None:
    view = View.of(agent_at())
    behind = np.array([[-16.8, -34.3], [30.0, 5.5]])
    assert in_sight(LIDAR, behind).tolist() == view.sees(behind).tolist() == [True, False]


def test_a_sensor_below_the_height_of_road_users_sees_no_hidden_place_either() -> None:
    low = np.array([2.0, 1.0, 0.7])
    places = places_around(low, 4.0, 60.0)
    seen = View.of(agent_at(low)).sees(places)
    assert seen.sum() > 1000
    assert not (seen & ~in_sight(low, places)).any()


def test_a_view_lies_where_its_sweep_is_believed_to_be_measured() -> None:
    agent, places = agent_at(), places_around(LIDAR, 0.0, 60.0, 2000)
    moved = pose_matrix([5.0, -3.0, 0.0], 0.3)
    there = places @ moved[:2, :2].T + moved[:2, 3]
    believed = View.of(agent, moved @ agent.sweep.world_from_lidar)
    assert believed.sees(there).tolist() == View.of(agent).sees(places).tolist()


def test_the_team_sees_what_any_of_it_sees_each_with_its_own_age() -> None:
    one, other = (View(k, float(k), np.zeros(2), 0.0, np.eye(4, 10, k, dtype=bool)) for k in (0, 1))
    space = SeenSpace([lambda: one, lambda: other])
    first, second, never = [0.4, 0.4], [1.0, 1.0], [50.0, 0.0]
    assert space.seen_s(np.array([first, second, never])).tolist() == [0.0, 1.0, -np.inf]
    assert space.sees(np.array([first, second, never])).tolist() == [True, True, False]


@pytest.fixture
def _toy(monkeypatch: pytest.MonkeyPatch) -> None:
    build(monkeypatch)


def seen_by(perception: Perception, steps: int = 1) -> SeenSpace:
    perception.reset(SCENARIO, EGO, 0)
    for step in range(steps):
        percept = perception.perceive(instant(step), instant(step + 1), {})
    assert percept.seen is not None
    return percept.seen


NEAR, BEHIND = np.array([[12.0, -3.0]]), np.array([PLACES[3][:2]]) - [5.0, 0.0]
"""A place before the wall, and one behind it, which the helper alone sees."""


@pytest.mark.usefixtures("_toy")
def test_truth_sees_behind_walls_and_sight_does_not() -> None:
    for perception, behind in ((TruthPerception(), True), (SightPerception(), False)):
        space = seen_by(perception)
        assert space.sees(NEAR).all() and space.sees(BEHIND).all() == behind
    assert not seen_by(TruthPerception(reach_m=20.0)).sees(np.array([[21.0, 0.0]])).any()


@pytest.mark.usefixtures("_toy")
def test_a_detectors_seen_space_is_of_the_messages_that_arrived_with_their_age() -> None:
    def space(**settings: object) -> SeenSpace:
        return seen_by(DetectorPerception(Knowing(PLACES[2:]), **settings), steps=3)  # type: ignore[arg-type]

    late = changed(PRESETS["ideal"], medium="fixed", delay_s=0.1)
    lost = changed(PRESETS["ideal"], packet_loss=1.0, medium="fixed")
    assert space(cooperative=False).seen_s(BEHIND).tolist() == [-np.inf]
    assert space(channel=lost).seen_s(BEHIND).tolist() == [-np.inf]
    assert space().seen_s(BEHIND) == pytest.approx(0.3)
    assert space(channel=late).seen_s(BEHIND) == pytest.approx(0.2)
    assert space(channel=late).seen_s(NEAR) == pytest.approx(0.3)
    assert [view.agent_id for view in space(channel=late).views] == [EGO, HELPER]


@pytest.mark.usefixtures("_toy")
def test_who_does_not_look_pays_nothing_and_the_episode_keeps_no_sweep() -> None:
    made: list[int] = []

    def make() -> View:
        made.append(1)
        return View.everything(EGO, 0.0, np.zeros(2), 10.0)

    percept: Percept = replace(TruthPercept(), seen=SeenSpace([make]))
    looks = SimpleNamespace(see=lambda seen: seen.sees(NEAR))
    for driver, count in ((SimpleNamespace(), 0), (looks, 1)):
        wheel = CheckedDriver(driver, 60.0)  # type: ignore[arg-type]
        kept = wheel.shown(percept)
        assert not wheel.failure
        assert kept is not None and kept.seen is None and len(made) == count


def TruthPercept() -> Percept:
    perception = TruthPerception()
    perception.reset(SCENARIO, EGO, 0)
    return perception.perceive(instant(0), instant(1), {})
