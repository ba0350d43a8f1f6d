"""The rig mounts the sensors of a scenario and measures frames alike in recordings and live."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from sensors.frame import Frame
from sensors.recording.agent_selection import nearest_agents
from sensors.recording.record import record
from sensors.recording.rig import Rig
from sensors.sweep import POINT_FIELDS
from sim.boxes import CLASSES
from sim.scenario import NetworkSpec, RoadsideUnit
from sim.traffic.base import PARKED, Actors
from tests.sensors.fakes import StraightTraffic, box_body, cars, ground, rows_of, scene_of, toy_scenario

UNIT = RoadsideUnit(xyz_m=(20.0, 8.0, 5.0), yaw_deg=-90.0, pitch_deg=15.0, lidar="debug-16")
ROWS = [[0, 0, 0], [12, 3.5, 0], [-15, -3.5, 0.5], [30, 0, 0], [50, 0, 0]]


def same_sweeps(first: Frame, second: Frame) -> bool:
    return all(
        getattr(a.sweep, name).tobytes() == getattr(b.sweep, name).tobytes()
        for a, b in zip(first.agents, second.agents, strict=True)
        for name in POINT_FIELDS
    )


def test_a_live_frame_of_straight_traffic_equals_the_recorded_one_bit_for_bit() -> None:
    scenario = toy_scenario(vehicles=3, roadside=(UNIT,), mount_xyz_m=(0.5, 0.0, 2.1), mount_pitch_deg=2.0)
    rows = [[*row[:2], 0.0] for row in ROWS]
    recording = record(
        StraightTraffic(cars(rows, speed=10.0)), ground(1000.0), scenario, 1, 4, body_mesh=box_body, visibility=False
    )
    traffic = StraightTraffic(cars(rows, speed=10.0))
    steps = [traffic.actors, *(traffic.step() for _ in range(3))]
    live = Rig(scenario, scene_of(ground(1000.0)), 1, visibility=False)
    for index in (1, 2, 3):
        frame = live.frame(index, recording.agent_ids, steps[index], steps[index - 1])
        assert same_sweeps(frame, recording.frame(index))


def test_actors_are_rounded_as_in_a_log() -> None:
    actors = cars([[0.123456, 0, 0.1], [12.00049, 3.5, 0]], speed=7.77777)
    rig = Rig(toy_scenario(), scene_of(ground()), 0)
    assert same_sweeps(rig.frame(0, [1000], actors), rig.frame(0, [1000], actors.rounded()))
    assert rig.frame(0, [1000], actors).truth.center[0, 0] == actors.rounded().boxes.center[0, 0]


def test_the_sensor_sits_where_the_scenario_says() -> None:
    rig = Rig(toy_scenario(mount_xyz_m=(1.0, 0.2, 2.5)), scene_of(ground()), 0)
    pose = rig.frame(0, [1000], cars(ROWS)).agents[0].sweep.world_from_lidar
    np.testing.assert_allclose(pose[:3, 3], [1.0, 0.2, 2.5], atol=1e-3)


@pytest.mark.parametrize(("step_s", "steps"), [(0.1, 1), (0.05, 1), (0.02, 3), (0.01, 5)])
def test_the_margin_covers_half_a_sweep(step_s: float, steps: int) -> None:
    assert Rig(toy_scenario(), scene_of(), 0).margin(step_s) == steps


def test_helpers_of_a_live_drive_are_the_nearest_cars_on_the_road() -> None:
    actors = cars(ROWS, speed=[0.0, 5.0, 5.0, 5.0, 5.0])
    scenario = toy_scenario(vehicles=3, within_m=40.0)
    assert nearest_agents(actors, scenario, 1000) == [1000, 1001, 1002]
    assert nearest_agents(parked(actors, 1), scenario, 1000) == [1000, 1002, 1003]
    actors.boxes.label[2] = CLASSES.index("truck")
    assert nearest_agents(actors, scenario, 1000) == [1000, 1001, 1003]
    left = msgspec.structs.replace(scenario, network=NetworkSpec(area_m=(-20.0, -20.0, 20.0, 20.0)))
    assert nearest_agents(actors, left, 1000) == [1000, 1001]


def test_helpers_of_a_live_drive_are_those_that_the_scenario_names() -> None:
    actors = replace(cars(ROWS), name=("ego", "a", "b", "c", "d"))
    assert nearest_agents(actors, toy_scenario(named=("ego", "d", "gone", "a")), 1000) == [1000, 1004, 1001]


def test_a_false_actor_is_measured_by_one_agent_alone() -> None:
    rig = Rig(toy_scenario(), scene_of(ground()), 0)
    now = cars([[0, 0, 0], [0, 40, 0]])
    false = cars([[12, 20, 0.3]], first_id=1000)
    plain = rig.frame(3, [1000, 1001], now)
    lied = rig.frame(3, [1000, 1001], now, only_for={1001: false})
    assert same_sweeps(plain.of_agents([0]), lied.of_agents([0]))
    before, after = plain.agents[1].sweep, lied.agents[1].sweep
    (inside,) = false.boxes.contains(after.world_points, margin=0.1)
    assert (
        inside.sum() >= 10 > 0 == false.boxes.contains(before.world_points, margin=0.1)[:, before.object_id >= 0].sum()
    )
    assert not np.isin(after.object_id[inside & (after.object_id >= 0)], now.boxes.object_id).any()
    np.testing.assert_array_equal(lied.truth.object_id, plain.truth.object_id)
    np.testing.assert_array_equal(lied.points_on[:, :1], plain.points_on[:, :1])


def test_a_false_actor_gives_the_points_that_a_real_one_would() -> None:
    rig = Rig(toy_scenario(), scene_of(ground()), 0)
    traffic = StraightTraffic(cars([[0, 0, 0], [0, 40, 0], [12, 20, 0.0]], speed=[0.0, 5.0, 20.0]))
    before, now = traffic.actors, traffic.step()
    real = rig.frame(1, [1001], now, before)
    false = {1001: rows_of(now, [2])}
    lied = rig.frame(1, [1001], rows_of(now, [0, 1]), rows_of(before, [0, 1]), only_for=false)
    assert real.points_on[0, 2] >= 10
    assert same_sweeps(lied, real)


def parked(actors: Actors, row: int) -> Actors:
    name = list(actors.name)
    name[row] = f"{PARKED}0"
    return replace(actors, name=tuple(name))
