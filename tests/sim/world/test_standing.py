"""Road users stand on the ground of their world, whatever moves them."""

from dataclasses import fields, replace

import msgspec
import numpy as np
import pytest

from sim.bodies.choice import body_mesh, models_for
from sim.boxes import CLASSES
from sim.catalog.load import load_scenario
from sim.geometry import Array, invert, transform_points
from sim.scenario import Scenario
from sim.traffic.base import Actors
from sim.traffic.open import open_traffic
from sim.world.ground import streets_of
from sim.world.standing import StandingTraffic, open_standing, stand
from tests.sensors.fakes import cars

SLOPE = 0.08
SIZES = {"car": (4.6, 1.8, 1.5), "van": (5.9, 2.0, 2.5), "truck": (12.0, 2.5, 3.6), "pedestrian": (0.5, 0.6, 1.75)}


def hill(xy: Array) -> Array:
    """Height of a plane that rises by 8 % to the east."""
    return np.asarray(SLOPE * xy[:, 0])


def uneven(name: str) -> Scenario:
    return msgspec.structs.replace(load_scenario(name), world=2, warmup_s=5.0)


def test_on_a_plane_a_body_stands_as_the_plane_does() -> None:
    parked = cars([[0.0, 0.0, 0.0], [10.0, 3.0, np.pi / 2], [-5.0, 0.0, np.pi], [2.0, 2.0, 0.7]])
    actors = stand(parked, hill)
    up = actors.world_from_body()[:, :3, 2]
    normal = np.array([-SLOPE, 0.0, 1.0]) / np.hypot(SLOPE, 1.0)
    np.testing.assert_allclose(up, np.tile(normal, (4, 1)), atol=1e-12)
    bottom = actors.boxes.center[:, 2] - 0.5 * actors.boxes.size[:, 2]
    np.testing.assert_allclose(bottom, hill(parked.boxes.center[:, :2]), atol=1e-12)
    angle = np.arctan(SLOPE)
    np.testing.assert_allclose(actors.pitch[:3], [-angle, 0.0, angle], atol=1e-12)
    np.testing.assert_allclose(actors.roll[:3], [0.0, -angle, 0.0], atol=1e-12)


def test_people_stay_upright_on_a_slope_and_two_wheelers_across_it() -> None:
    users = cars([[0.0, 0.0, 0.0], [10.0, 3.0, np.pi / 2]], size=(1.8, 0.6, 1.7))
    for name, pitch in (("pedestrian", 0.0), ("bicycle", -np.arctan(SLOPE))):
        label = np.full(2, CLASSES.index(name))
        actors = stand(replace(users, boxes=replace(users.boxes, label=label)), hill)
        np.testing.assert_allclose(actors.pitch, [pitch, 0.0], atol=1e-12)
        np.testing.assert_array_equal(actors.roll, [0.0, 0.0])


def test_braking_lowers_the_nose_and_a_left_turn_the_right_side() -> None:
    car = cars([[0.0, 0.0, 0.5]])
    ahead, left = np.array([[np.cos(0.5), np.sin(0.5)]]), np.array([[-np.sin(0.5), np.cos(0.5)]])

    def angles(acceleration: Array) -> tuple[float, float]:
        actors = stand(replace(car, acceleration=acceleration), lambda xy: np.zeros(len(xy)))
        return float(np.degrees(actors.pitch[0])), float(np.degrees(actors.roll[0]))

    nose_down, level = angles(-9.81 * 0.5 * ahead)
    assert 0.5 < nose_down < 1.5 and level == pytest.approx(0.0, abs=1e-12)
    level, right_down = angles(9.81 * 0.3 * left)
    assert right_down == pytest.approx(0.3 * 4.5) and level == pytest.approx(0.0, abs=1e-12)
    # What no tyre carries is a jump of the simulation.
    assert max(map(abs, angles(500.0 * (ahead + left)))) < 4.5


@pytest.mark.parametrize("name", SIZES)
def test_at_8_percent_a_body_is_within_its_tilted_box_and_the_upright_one_but_for_its_tilt(name: str) -> None:
    size = SIZES[name]
    actors = cars([[3.0, 4.0, 0.4]], size=size)
    label = np.array([CLASSES.index(name)])
    actors = stand(replace(actors, boxes=replace(actors.boxes, label=label)), hill)
    points = np.asarray(body_mesh(models_for(name)[0], size).vertices)
    world = transform_points(actors.world_from_body()[0], points)
    again = transform_points(invert(actors.world_from_body()[0]), world)
    assert (np.abs(again[:, :2]) <= 0.5 * np.array(size[:2]) + 1e-6).all()
    assert (again[:, 2] >= -1e-6).all() and (again[:, 2] <= size[2] + 1e-6).all()
    # The upright box of the same size misses a part that the angle and the length bound.
    angle = np.hypot(actors.pitch[0], actors.roll[0])
    grown = replace(
        actors.boxes, size=actors.boxes.size + angle * np.array([[2 * size[2], 2 * size[2], size[0] + size[1]]])
    )
    assert grown.contains(world).all()


@pytest.mark.parametrize("name", ["four_way", "ima_building", "highway_env_merge"])
def test_every_road_user_of_every_backend_stands_within_5_cm_of_the_ground(name: str) -> None:
    scenario = uneven(name)
    with open_standing(scenario, 1) as traffic:
        height = streets_of(scenario, 1).height
        steps = [traffic.actors, *(traffic.step() for _ in range(10))]
    users = 0
    for actors in steps:
        boxes = actors.boxes
        assert np.abs(boxes.center[:, 2] - 0.5 * boxes.size[:, 2] - height(boxes.center[:, :2])).max() <= 0.05
        users += len(actors)
    assert users > 10
    spread = np.concatenate([actors.boxes.center[:, 2] - 0.5 * actors.boxes.size[:, 2] for actors in steps])
    assert np.ptp(spread) > 0.25


def test_on_the_ground_traffic_moves_as_without_and_a_second_run_stands_the_same() -> None:
    scenario = uneven("ima_building")
    with open_standing(scenario, 2) as first, open_standing(scenario, 2) as second, open_traffic(scenario, 2) as flat:
        for _ in range(20):
            here, there, level = first.step(), second.step(), flat.step()
            for field in fields(here):
                values = [getattr(one, field.name) for one in (here, there)]
                if isinstance(values[0], np.ndarray):
                    assert values[0].tobytes() == values[1].tobytes(), field.name
            assert here.boxes.center.tobytes() == there.boxes.center.tobytes()
            np.testing.assert_array_equal(here.boxes.center[:, :2], level.boxes.center[:, :2])
            np.testing.assert_array_equal(here.velocity, level.velocity)


def test_a_level_world_has_its_backend_alone() -> None:
    scenario = load_scenario("ima_building")
    with open_standing(scenario, 1) as traffic:
        assert not isinstance(traffic, StandingTraffic)
        assert not traffic.actors.roll.any()


def test_nobody_stands_anywhere() -> None:
    nobody = cars(np.zeros((0, 3)))
    assert isinstance(stand(nobody, hill), Actors) and len(stand(nobody, hill)) == 0
