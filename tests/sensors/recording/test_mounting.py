from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sensors.recording.mounting import blocked_share, place_roadside
from sensors.scan.scene import RayScene
from sim.roads.networks import read_network, resolve_network
from sim.scenario import RoadsideUnit
from sim.world.build import build_world
from sim.world.roads.surfaces import GROUND_BELOW_M
from tests.sensors.fakes import box, ground, scene_of
from tests.sim.world.hills import hilly_scenario, lane_points


def unit(x: float, y: float, z: float = 5.0, **changes: Any) -> RoadsideUnit:
    return RoadsideUnit(xyz_m=(x, y, z), lidar="debug-16", **changes)


def test_units_stand_above_the_ground_that_is_there() -> None:
    static = ground() + box((4.0, 4.0, 1.0), (10.0, 0.0, 8.0))
    static.apply_translation([0.0, 0.0, 80.0])
    below_roof, free = place_roadside(scene_of(static), (unit(10.0, 0.0), unit(30.0, 9.0, 6.5)))
    assert (below_roof.agent_id, free.agent_id) == (-1, -2)
    assert below_roof.world_from_lidar[2, 3] == pytest.approx(85.0, abs=1e-3)
    assert free.world_from_lidar[2, 3] == pytest.approx(86.5, abs=1e-3)
    assert free.world_from_body[2, 3] == pytest.approx(80.0, abs=1e-3)


def test_units_of_a_world_without_ground_stand_at_zero() -> None:
    assert place_roadside(scene_of(), (unit(3.0, 4.0),))[0].world_from_lidar[2, 3] == 5.0
    assert place_roadside(scene_of(), ()) == ()


def test_units_far_apart_stand_on_their_own_ground() -> None:
    static, far = ground(100.0), ground(100.0, center=(40_000.0, 300.0))
    far.apply_translation([0.0, 0.0, 123.456])
    near_unit, far_unit = place_roadside(scene_of(static + far), (unit(3.0, 4.0), unit(40_003.0, 304.0)))
    assert near_unit.world_from_lidar[2, 3] == pytest.approx(5.0, abs=1e-4)
    assert far_unit.world_from_lidar[2, 3] == pytest.approx(128.456, abs=1e-4)


def test_units_beside_a_hilly_road_stand_at_its_height(tmp_path: Path) -> None:
    units = tuple(unit(x, y, 4.5) for x, y in ((40.0, 12.0), (95.0, -12.0), (235.0, 40.0), (137.0, 80.0)))
    scenario = hilly_scenario(tmp_path, units)
    scene = RayScene(build_world(scenario, 1))
    lanes = lane_points(read_network(resolve_network(scenario, 1)))
    heights = []
    for placed, given in zip(place_roadside(scene, units), units, strict=True):
        away = np.hypot(*(lanes[:, :2] - given.xyz_m[:2]).T)
        assert 2.0 < away.min() < 12.0
        heights.append(lanes[away.argmin(), 2])
        above_road = placed.world_from_lidar[2, 3] - heights[-1]
        assert above_road == pytest.approx(4.5 - GROUND_BELOW_M, abs=0.3)
        assert blocked_share(scene, placed) < 0.05
    assert np.ptp(heights) > 10.0
