"""Agents that are not where they believe find back by the objects that they share."""

from dataclasses import replace

import numpy as np
import pytest
from msgspec.structs import replace as changed

from dsrc.data.sample import make_sample
from dsrc.models.detector import Detector
from dsrc.models.pose_graph import aligned, corrections
from dsrc.ops.detections import Detections
from dsrc.training.recipes import debug
from sim.boxes import Boxes
from sim.geometry import invert, pose_matrix, transform_points
from tests.dsrc.training.drive import frame

PLACE = np.array([[0.0, 0.0], [25.0, 10.0], [-15.0, -20.0]])
ERRORS = np.stack([np.eye(4), pose_matrix([0.6, -0.4, 0.0], 0.03), pose_matrix([-0.3, 0.5, 0.0], -0.02)])
"""What a believed place is off by, about the agent's own."""


def believed_from_true() -> np.ndarray:
    to = np.stack([pose_matrix([*p, 0.0]) for p in PLACE])
    return to @ ERRORS @ np.stack([invert(m) for m in to])


def seen(objects: int, noise_m: float = 0.03, seed: int = 0) -> list[Detections]:
    """Boxes of each of three agents, as they believe them to be in the ego's frame."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-30, 30, 4), np.linspace(-20, 20, 4))
    center = np.column_stack([x.ravel(), y.ravel(), np.zeros(16)])[rng.permutation(16)[:objects]]
    yaw = rng.uniform(-np.pi, np.pi, objects)
    parts = []
    for move in believed_from_true():
        place = transform_points(move, center) + rng.normal(0, noise_m, (objects, 3)) * [1, 1, 0]
        # Which end is the front, no detector knows.
        turned = (
            yaw
            + np.arctan2(move[1, 0], move[0, 0])
            + rng.normal(0, 0.01, objects)
            + np.pi * rng.integers(0, 2, objects)
        )
        boxes = Boxes.from_array(np.column_stack([place, np.tile([4.0, 2.0, 1.5], (objects, 1)), turned]))
        parts.append(Detections(boxes, np.linspace(0.9, 0.5, objects, dtype=np.float32)))
    return parts


def test_places_and_headings_are_found_back() -> None:
    true_from_believed = corrections(seen(10), PLACE)
    left = true_from_believed @ believed_from_true()
    for move, place in zip(left, PLACE, strict=True):
        off = transform_points(move, np.array([[*place, 0.0]]))[0, :2] - place
        assert np.linalg.norm(off) < 0.08
        assert abs(np.arctan2(move[1, 0], move[0, 0])) < 0.005
    np.testing.assert_array_equal(true_from_believed[0], np.eye(4))


def test_one_wrong_box_does_not_pull_the_others() -> None:
    parts = seen(10)
    wrong = parts[1].boxes.array.copy()
    wrong[0, :2] += [0.9, 0.3]
    parts[1] = Detections(Boxes.from_array(wrong), parts[1].score)
    left = corrections(parts, PLACE) @ believed_from_true()
    off = transform_points(left[1], np.array([[*PLACE[1], 0.0]]))[0, :2] - PLACE[1]
    assert np.linalg.norm(off) < 0.15


@pytest.mark.parametrize("objects", [0, 3])
def test_with_too_few_objects_everybody_stays(objects: int) -> None:
    np.testing.assert_array_equal(corrections(seen(objects), PLACE), np.tile(np.eye(4), (3, 1, 1)))


def test_clouds_go_where_their_objects_say() -> None:
    grid = debug().model.grid
    sample = make_sample(frame(0), 1000, grid)
    place = sample.ego_from_agent[1, :2, 3]
    about = pose_matrix([*place, 0.0])
    error = about @ pose_matrix([0.5, 0.3, 0.0], 0.02) @ invert(about)
    cloud = sample.clouds[1].copy()
    cloud[:, :3] = transform_points(error, cloud[:, :3])
    poses = sample.ego_from_agent.copy()
    poses[1] = error @ poses[1]
    misplaced = replace(sample, clouds=(sample.clouds[0], cloud, sample.clouds[2]), ego_from_agent=poses)
    truth = frame(0).truth.transform(invert(frame(0).agents[0].sweep.world_from_lidar))
    score = np.linspace(0.9, 0.8, len(truth), dtype=np.float32)
    moved = truth.transform(error)
    found = aligned(misplaced, [Detections(b, score) for b in (truth, moved, truth)], grid)
    np.testing.assert_allclose(found.ego_from_agent, sample.ego_from_agent, atol=0.02)
    assert len(found.clouds[1]) >= 0.98 * len(sample.clouds[1])
    assert np.abs(found.clouds[2][:50] - sample.clouds[2][:50]).max() < 0.01


def test_a_detector_may_align_before_it_detects() -> None:
    detector = Detector(changed(debug().model, align_poses=True, fusion="coalign")).eval()
    sample = make_sample(frame(0), 1000, detector.settings.grid)
    assert len(detector._single_agent_detections(sample)) == 3
    detector.detect(sample)
