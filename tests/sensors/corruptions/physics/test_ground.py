"""Ground: by material, else the plane below the sensor; never above it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sensors.corruptions.physics.ground import find_ground
from sensors.sweep import Sweep, make_sweep
from tests.sensors.corruptions.drives import MATERIAL, street_drive
from tests.sensors.corruptions.street import spinning, street


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def field(height: float, pitch: float, roll: float, seed: int = 1) -> tuple[Sweep, np.ndarray]:
    """A plane of some slope below a sensor, with walls, roofs and clutter; which points are on the plane."""
    draw = rng(seed)
    xy = draw.normal(0.0, 15.0, (3000, 2))
    plane = np.column_stack([xy, xy @ [np.tan(pitch), np.tan(roll)] - height + draw.normal(0.0, 0.02, 3000)])
    wall = np.column_stack([draw.uniform(-30, 30, 1500), np.full(1500, 8.0), draw.uniform(-1.0, 6.0, 1500)])
    roof = np.column_stack([draw.uniform(-20, 20, (800, 2)), np.full(800, 4.0)])
    clutter = draw.uniform([-25, -25, 0.3 - height], [25, 25, 3.0], (400, 3))
    points = np.concatenate([plane, wall, roof, clutter])
    return make_sweep(points), np.arange(len(points)) < 3000


@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
@given(height=st.floats(0.6, 8.0), pitch=st.floats(-0.12, 0.12), roll=st.floats(-0.12, 0.12), seed=st.integers(0, 99))
def test_a_sloping_road_is_found_below_any_sensor(height: float, pitch: float, roll: float, seed: int) -> None:
    sweep, on = field(height, pitch, roll, seed)
    found = np.zeros(len(sweep), bool)
    ground = find_ground(sweep)
    found[ground.rows] = True
    assert found[on].mean() > 0.95 and found[~on].mean() < 0.12
    normal = np.array([-np.tan(pitch), -np.tan(roll), 1.0])
    true = np.abs(sweep.points @ (normal / np.linalg.norm(normal))) / sweep.range
    assert np.allclose(ground.cosine[found[ground.rows]], true[ground.rows], atol=0.03)


def test_ground_is_never_sought_above_the_sensor() -> None:
    sweep, on = field(1.9, 0.0, 0.0)
    above = sweep[~on & (sweep.points[:, 2] > 0.0)]
    assert len(find_ground(above).rows) == 0
    upside_down = replace(sweep, points=sweep.points * np.float32([1, 1, -1]))
    assert (upside_down.points[find_ground(upside_down).rows, 2] < 0).all()


def test_a_wall_is_no_ground() -> None:
    wall = make_sweep(
        np.column_stack([rng().uniform(-20, 20, 2000), np.full(2000, 5.0), rng(2).uniform(-1.5, 6, 2000)])
    )
    assert len(find_ground(wall).rows) == 0


@pytest.mark.parametrize("rings", [16, 64, 300])
def test_the_road_of_a_street(rings: int) -> None:
    sweep = street(spinning(rings, columns=90))
    road = np.abs(sweep.points[:, 2] + 1.9) < 1e-3
    found = np.zeros(len(sweep), bool)
    found[find_ground(sweep).rows] = True
    assert found[road].mean() > 0.99
    assert np.abs(sweep.points[found & ~road, 2] + 1.9).max() < 1.0


def test_ground_is_found_by_material() -> None:
    sweep = street_drive()[1].agents[0].sweep
    ground = find_ground(sweep)
    assert (ground.rows == np.flatnonzero(sweep.material == MATERIAL["asphalt"])).all()
    assert (ground.cosine == sweep.cosine[ground.rows]).all()
    # Without incidence the plane of these points gives it, seen from where the sensor is at the reference time.
    bare = find_ground(replace(sweep, cosine=np.zeros(len(sweep), np.float32)))
    assert np.allclose(bare.cosine, ground.cosine, atol=0.08)


def test_objects_on_the_road_are_no_ground() -> None:
    sweep, _ = field(1.9, 0.0, 0.0)
    car = np.where(np.abs(sweep.points[:, 0]) < 2.0, 1000, -1).astype(np.int32)
    rows = find_ground(replace(sweep, object_id=car)).rows
    assert (car[rows] == -1).all() and len(rows) > 1000


@pytest.mark.parametrize("count", [0, 1, 20])
def test_hardly_any_points_have_no_ground(count: int) -> None:
    assert len(find_ground(field(1.9, 0.0, 0.0)[0][:count]).rows) == 0
