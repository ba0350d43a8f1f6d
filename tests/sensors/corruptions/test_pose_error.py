"""Pose error: wrong reported poses, true measurements."""

import itertools

import numpy as np
import pytest

from sensors.corruptions import corrupt_frame, corruption_rng
from sensors.corruptions.pose_error import PoseError, in_frame, pose_errors
from sensors.frame import Frame
from sim.errors import SettingsError
from sim.geometry import invert
from tests.sensors.corruptions.frames import frame
from tests.sensors.corruptions.street import same


def at(time_s: float, agents: int, settings: PoseError | None = None) -> np.ndarray:
    """Errors (agents, 3) at a time."""
    settings = settings or PoseError()
    return np.array(
        [pose_errors(settings, time_s, corruption_rng(1, "pose_error", 0, agent)) for agent in range(agents)]
    )


def offset(clean: Frame, out: Frame, row: int) -> np.ndarray:
    """Reported pose of the agent in a row, in its true body frame."""
    body = clean.agents[row].world_from_body
    moved = out.agents[row].sweep.world_from_lidar @ invert(clean.agents[row].sweep.world_from_lidar)
    return invert(body) @ moved @ body


def test_errors_have_their_deviation_and_no_bias() -> None:
    settings = PoseError(longitudinal_m=0.3, lateral_m=0.2, heading_deg=0.1)
    sample = at(12.0, 2000, settings) / [0.3, 0.2, np.radians(0.1)]
    assert np.abs(sample.mean(axis=0)).max() < 4 / np.sqrt(2000)
    assert np.allclose(sample.std(axis=0), 1.0, atol=0.06)
    assert np.abs(np.corrcoef(sample.T) - np.eye(3)).max() < 0.08


@pytest.mark.parametrize(("apart_s", "expected"), [(0.1, 0.997), (3.0, 0.905), (30.0, 0.368), (150.0, 0.007)])
def test_errors_have_the_correlation_of_the_process(apart_s: float, expected: float) -> None:
    now, later = (at(t, 2000) for t in (7.0, 7.0 + apart_s))
    for column in range(3):
        assert abs(np.corrcoef(now[:, column], later[:, column])[0, 1] - expected) < 0.06


def test_an_error_is_a_function_of_the_time() -> None:
    settings, key = PoseError(), (1, "pose_error", 0, 5)
    assert (pose_errors(settings, 3.0, corruption_rng(*key)) == pose_errors(settings, 3.0, corruption_rng(*key))).all()


def test_a_higher_severity_is_farther_off_in_the_same_direction() -> None:
    clean = frame(30)
    off = np.array([offset(clean, corrupt_frame(clean, "pose_error", level, 4), 1)[:2, 3] for level in range(1, 6)])
    assert all(a < b for a, b in itertools.pairwise(np.linalg.norm(off, axis=1)))
    assert np.allclose(off[:-1] * 2.0, off[1:])


def test_points_truth_body_and_path_stay_true() -> None:
    clean = frame(3)
    out = corrupt_frame(clean, "pose_error", 5, 4)
    for before, after in zip(clean.agents, out.agents, strict=True):
        assert same(before.sweep, after.sweep)
        assert after.world_from_body is before.world_from_body and after.sweep.path is before.sweep.path
        assert after.sweep.lost == 0
    assert out.truth is clean.truth


def test_any_ego_has_no_pose_error() -> None:
    clean = frame(3)
    for ego_id, ego_row in ((None, 0), (1000, 0), (1003, 1), (-1, 2)):
        out = corrupt_frame(clean, "pose_error", 5, 4, ego_id=ego_id)
        wrong = [not np.array_equal(offset(clean, out, row), np.eye(4)) for row in range(3)]
        exact = [out.agents[r].sweep.world_from_lidar is clean.agents[r].sweep.world_from_lidar for r in range(3)]
        assert exact == [row == ego_row for row in range(3)] and sum(wrong) >= 2


def test_helpers_err_independently_and_a_mast_always_alike() -> None:
    off = [[offset(f, corrupt_frame(f, "pose_error", 4, 4), row) for row in (1, 2)] for f in (frame(0), frame(300))]
    assert not np.allclose(off[0][0], off[0][1], atol=0.01)
    assert not np.allclose(off[0][0], off[1][0], atol=0.01)
    assert np.allclose(off[0][1], off[1][1])


def test_error_to_the_side_is_to_the_side_of_the_body() -> None:
    clean = frame(3)
    body = clean.agents[1].world_from_body
    out = in_frame(clean, 1, PoseError(longitudinal_m=0.0, lateral_m=1.0, heading_deg=0.0), np.random.default_rng(3))
    moved = out.world_from_lidar[:3, 3] - clean.agents[1].sweep.world_from_lidar[:3, 3]
    assert abs(moved @ body[:3, 0]) < 1e-12 < abs(moved @ body[:3, 1])


def test_no_error_is_the_identity() -> None:
    clean = frame()
    none = PoseError(longitudinal_m=0.0, lateral_m=0.0, heading_deg=0.0)
    assert in_frame(clean, 1, none, np.random.default_rng(0)) is clean.agents[1].sweep


@pytest.mark.parametrize("wrong", [{"lateral_m": -1.0}, {"heading_deg": 181.0}, {"correlation_s": 0.0}])
def test_settings_out_of_range_are_named(wrong: dict) -> None:
    with pytest.raises(SettingsError, match=next(iter(wrong))):
        PoseError(**wrong)
