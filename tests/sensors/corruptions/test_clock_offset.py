"""Clock offset: delayed sweeps of collaborators."""

from dataclasses import replace

import numpy as np
import pytest

from sensors.corruptions import corrupt_frame
from sensors.corruptions.clock_offset import ClockOffset, extrapolate, in_frame, sensor_path
from sensors.deskew import deskew
from sensors.frame import AgentFrame, Frame
from sensors.motion import Path
from sensors.recording.rig import Rig
from sensors.sweep import KEPT, MOVED, Sweep, make_sweep
from sim.boxes import Boxes
from sim.errors import SettingsError
from sim.geometry import invert, pose_matrix
from tests.sensors.corruptions.frames import frame
from tests.sensors.corruptions.street import same
from tests.sensors.fakes import StraightTraffic, cars, ground, ideal, scene_of, toy_scenario

LATE_S = 0.1


class Exactly:
    """Generator of the mean: the delay is exactly that of the settings."""

    def uniform(self, low: float, high: float) -> float:
        return 0.5 * (low + high)


def late(clean: Frame, row: int, late_s: float = LATE_S) -> Sweep:
    return in_frame(clean, row, ClockOffset(late_ms=1e3 * late_s), Exactly())  # type: ignore[arg-type]


def one_point(speed: float, target_speed: float, turn: float = 0.0) -> Frame:
    """An agent that drives along x and turns; a point on the front of a car 20 m ahead, one on a wall to the left."""
    times = np.array([-0.1, 0.0, 0.1])
    poses = pose_matrix(np.stack([speed * times, 0.0 * times, 0.0 * times], axis=1), turn * times)
    sweep = make_sweep(np.array([[20.0, 0.0, 0.5], [0.0, 10.0, 0.5]]), poses[1], object_id=np.array([1001, -1]))
    sweep = replace(sweep, path=Path.through(times, poses))
    truth = Boxes.from_array([[20.0, 0.0, 0.8, 4.0, 2.0, 1.6, 0.0]], object_id=np.array([1001]))
    agent = AgentFrame(1000, "vehicle", poses[1], speed, sweep)
    return Frame(0, 0.0, (agent,), truth, np.array([[target_speed, 0.0]]), np.ones((1, 1), np.int32))


@pytest.mark.parametrize(
    ("speed", "target_speed", "ahead", "wall"),
    [
        (10.0, 0.0, 21.0, 1.0),  # what stands runs ahead with the agent
        (0.0, 10.0, 19.0, 0.0),  # what drives is where it was
        (10.0, 10.0, 20.0, 1.0),  # what drives along is where it is
        (10.0, -10.0, 22.0, 1.0),  # what comes is off by both ways
    ],
)
def test_points_are_where_they_were_seen_then(speed: float, target_speed: float, ahead: float, wall: float) -> None:
    out = late(one_point(speed, target_speed), 0)
    np.testing.assert_allclose(out.points, [[ahead, 0.0, 0.5], [wall, 10.0, 0.5]], atol=1e-5)


def test_a_turning_agent_sees_the_world_turned() -> None:
    out = late(one_point(0.0, 0.0, turn=0.5), 0)
    angle = 0.5 * LATE_S
    np.testing.assert_allclose(out.points[0], [20 * np.cos(angle), 20 * np.sin(angle), 0.5], atol=1e-4)


@pytest.mark.parametrize("late_s", [0.05, 0.1, 0.3])
def test_it_is_the_sweep_that_was_measured_then(late_s: float) -> None:
    """Against the simulation: a car ahead and the ground, scanned earlier from the earlier pose."""
    traffic = StraightTraffic(cars([[0, 0, 0], [15, 1, 0], [12, -6, 1.2]], speed=[8.0, 3.0, 5.0]), step_s=0.05)
    steps = [traffic.actors, *(traffic.step() for _ in range(9))]
    rig = Rig(toy_scenario(), scene_of(ground()), 0, vehicle_spec=ideal("debug-16"))

    def at(step: int) -> Frame:
        before, now, after = steps[step - 1 : step + 2]
        return rig.frame(step, [1000], now, before, after)

    now, then = at(8), at(8 - round(late_s / 0.05))
    out, true = late(now, 0, late_s), then.agents[0].sweep
    for key in (1001, 1002):
        got, want = (s.points[s.object_id == key] for s in (out, true))
        assert len(got) > 20 and len(want) > 20
        # Which rays hit has changed a little; where the car is seen has not.
        assert np.abs(got.mean(axis=0) - want.mean(axis=0)).max() < 0.2
        assert np.abs(got.min(axis=0) - want.min(axis=0)).max() < 0.35
    clean = now.agents[0].sweep
    away = clean.points[clean.object_id == 1001].mean(axis=0) - true.points[true.object_id == 1001].mean(axis=0)
    assert abs(away[0] + (8.0 - 3.0) * late_s) < 0.2  # without the model it would be off by that much


def test_the_stamp_and_the_pose_are_those_of_now() -> None:
    clean = frame(3)
    out = corrupt_frame(clean, "clock_offset", 5, 4)
    for before, after in zip(clean.agents, out.agents, strict=True):
        assert after.sweep.time_s == before.sweep.time_s
        assert after.sweep.world_from_lidar is before.sweep.world_from_lidar
        assert after.world_from_body is before.world_from_body


def test_the_ego_and_a_static_scene_of_a_mast_are_unchanged() -> None:
    clean = frame(3)
    out = corrupt_frame(clean, "clock_offset", 3, 4)
    assert out.agents[0].sweep is clean.agents[0].sweep
    assert same(out.agents[2].sweep, clean.agents[2].sweep)
    moved = out.agents[1].sweep
    assert (moved.fate == MOVED).all() and (clean.agents[1].sweep.fate == KEPT).all()
    ahead = (moved.points - clean.agents[1].sweep.points)[:, 0]
    assert 0.05 * 10 - 1e-3 < ahead.min() and ahead.max() < 0.15 * 10 + 1e-3


def test_a_clock_is_off_by_the_same_all_drive_and_every_agent_has_its_own() -> None:
    def ahead(index: int, row: int) -> float:
        clean = frame(index, agents=(1000, 1003, 1004))
        out = corrupt_frame(clean, "clock_offset", 3, 4)
        return float((out.agents[row].sweep.points - clean.agents[row].sweep.points)[:, 0].mean())

    assert abs(ahead(0, 1) - ahead(50, 1)) < 1e-3
    assert abs(ahead(0, 1) - ahead(0, 2)) > 0.01


def test_raw_points_stay_raw_and_agree_with_compensated_ones() -> None:
    clean = frame(3)
    raw = replace(clean, agents=tuple(replace(a, sweep=deskew(a.sweep, "raw")) for a in clean.agents))
    out = late(raw, 1)
    assert out.motion == "raw"
    np.testing.assert_allclose(deskew(out, "middle").points, late(clean, 1).points, atol=1e-3)


def test_files_without_path_and_ids_use_speed_and_boxes() -> None:
    known = one_point(10.0, 4.0)
    agent = known.agents[0]
    blind = replace(agent.sweep, path=None, object_id=np.full(2, -1, np.int32))
    out = late(replace(known, agents=(replace(agent, sweep=blind),)), 0)
    np.testing.assert_allclose(out.points, late(known, 0).points, atol=1e-4)
    assert out.path is None


def test_a_path_runs_straight_on_beyond_its_ends() -> None:
    path = sensor_path(one_point(10.0, 0.0, turn=0.2).agents[0])
    poses = extrapolate(path, np.array([-0.5, 0.0, 0.5]))
    np.testing.assert_allclose(poses[:, 0, 3], [-5.0, 0.0, 5.0], atol=1e-9)
    np.testing.assert_allclose(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]), [-0.1, 0.0, 0.1], atol=1e-9)


def test_the_path_of_a_late_sweep_is_that_of_its_measurement() -> None:
    clean = one_point(10.0, 0.0)
    out = late(clean, 0)
    assert np.allclose(
        invert(clean.agents[0].sweep.path.at(np.zeros(1)))[0] @ out.path.at(np.zeros(1))[0], pose_matrix([-1, 0, 0])
    )


def test_no_delay_and_no_points_are_left_alone() -> None:
    clean = frame()
    assert late(clean, 1, 0.0) is clean.agents[1].sweep
    empty = replace(clean, agents=tuple(replace(a, sweep=a.sweep[:0]) for a in clean.agents))
    assert len(late(empty, 1)) == 0


def test_a_delay_out_of_range_is_named() -> None:
    with pytest.raises(SettingsError, match="late_ms"):
        ClockOffset(late_ms=-1.0)
