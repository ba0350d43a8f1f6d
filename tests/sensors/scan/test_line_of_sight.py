"""Antennas see each other unless a vehicle or a building is between them."""

from collections.abc import Sequence

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from sensors.frame import Frame
from sensors.recording.rig import Rig
from sensors.scan.line_of_sight import lines_of_sight
from sensors.scan.scene import RayScene
from sim.radio import Obstruction
from tests.sensors.fakes import box, box_body, cars, ground, toy_scenario

WALL = box((1.0, 30.0, 8.0), (0.0, 40.0, 4.0))


def frame_of(
    rows: ArrayLike, agents: Sequence[int], world: trimesh.Trimesh | None = None, tall: Sequence[int] = ()
) -> tuple[Frame, RayScene]:
    scene = RayScene(world if world is not None else ground(), body_mesh=box_body)
    actors = cars(rows)
    for row in tall:
        actors.boxes.size[row, 2], actors.boxes.center[row, 2] = 3.6, 1.8
    rig = Rig(toy_scenario(lidar="vlp-16"), scene, 0)
    return rig.frame(0, [1000 + row for row in agents], actors), scene


def test_an_open_line_is_free_and_a_truck_blocks_it() -> None:
    rows = [(-20, 0, 0), (0, 0, 0), (20, 0, 0)]
    low, _ = frame_of(rows, [0, 2])  # antennas look over a car
    assert low.sight.tolist() == [[0, 0], [0, 0]]
    high, _ = frame_of(rows, [0, 2], tall=[1])
    assert high.sight.tolist() == [[0, Obstruction.VEHICLE], [Obstruction.VEHICLE, 0]]


def test_an_agent_does_not_block_its_own_line() -> None:
    frame, _ = frame_of([(-20, 0, 0), (20, 0, 0)], [0, 1], tall=[0, 1])
    assert (frame.sight == Obstruction.FREE).all()


def test_a_building_takes_precedence_over_a_vehicle() -> None:
    world = trimesh.util.concatenate([ground(), WALL])
    world.face_attributes["material"] = np.zeros(len(world.faces), np.uint8)
    rows = [(-20, 40, 0), (20, 40, 0), (8, 40, 0), (20, 10, 0), (-20, 10, 0)]
    frame, _ = frame_of(rows, [0, 1, 3, 4], world, tall=[2])
    by = {(a, b): frame.sight[a, b] for a in range(4) for b in range(4)}
    assert by[0, 1] == by[1, 0] == Obstruction.BUILDING
    assert by[2, 3] == Obstruction.FREE  # both south of the wall
    assert by[1, 2] == Obstruction.FREE
    np.testing.assert_array_equal(frame.sight, frame.sight.T)


def test_without_a_world_only_vehicles_block() -> None:
    frame, scene = frame_of([(-20, 0, 0), (0, 0, 0), (20, 0, 0)], [0, 2], tall=[1])
    np.testing.assert_array_equal(lines_of_sight(None, frame), lines_of_sight(scene, frame))


def test_a_box_beside_or_beyond_the_line_does_not_block() -> None:
    for place in [(0, 3, 0), (40, 0, 0), (-40, 0, 0), (0, 1.6, 0.0)]:
        frame, _ = frame_of([(-20, 0, 0), place, (20, 0, 0)], [0, 2], tall=[1])
        assert (frame.sight == Obstruction.FREE).all(), place
    turned, _ = frame_of([(-20, 0, 0), (0, 1.6, np.pi / 2), (20, 0, 0)], [0, 2], tall=[1])
    assert turned.sight[0, 1] == Obstruction.VEHICLE
