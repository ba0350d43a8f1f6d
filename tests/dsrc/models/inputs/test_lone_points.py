"""Lone points are those with few neighbours for their range: flakes are, surfaces are not."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from dsrc.data.sample import make_sample
from dsrc.detectors.open import open_detector
from dsrc.evaluation.evaluate import plan_of_evaluation
from dsrc.models.inputs.lone_points import LEAST_M, NEIGHBOURS, STEP_RAD, STEPS, lone_points, without_lone_points
from dsrc.models.inputs.trained_frame import prepared
from dsrc.models.teams import team_detections
from dsrc.options.detection import Evaluation
from sensors.corruptions import corrupt
from sensors.sweep import SCATTERED
from sim.errors import SettingsError
from tests.dsrc.evaluation.small import write_detector, write_drives
from tests.dsrc.models.test_detector import GRID, talkative
from tests.dsrc.training.drive import frame
from tests.sensors.corruptions.street import spinning, street


def by_hand(cloud: NDArray[np.float32], origin: NDArray[np.float64]) -> NDArray[np.bool_]:
    place = cloud[:, :3].astype(np.float64)
    radius = np.maximum(LEAST_M, STEPS * STEP_RAD * np.linalg.norm(place - origin, axis=1))
    apart = np.linalg.norm(place[:, None] - place, axis=2)
    return (apart <= radius[:, None]).sum(axis=1) - 1 < NEIGHBOURS


@pytest.mark.parametrize("count", [0, 1, 3, 4, 1200])
def test_lone_points_are_those_of_the_definition(count: int) -> None:
    rng = np.random.default_rng(count)
    at = rng.normal(size=(count, 3)) * rng.choice([0.02, 1.0, 200.0], (count, 1))
    cloud = np.column_stack([at, np.zeros(count)]).astype(np.float32)
    origin = np.array([3.0, -2.0, 1.0])
    expected = by_hand(cloud, origin)
    for order in (np.arange(count), np.argsort(cloud[:, 0])):  # neighbours apart in the cloud, and side by side
        assert np.array_equal(lone_points(cloud[order], origin), expected[order])
    assert count < 1200 or 0.1 < expected.mean() < 0.9


def test_flakes_are_lone_and_a_street_is_not() -> None:
    snowy = corrupt(street(spinning(columns=1800)), "snow", 3, np.random.default_rng(0))
    flakes = snowy.fate == SCATTERED
    lone = lone_points(snowy.points, np.zeros(3))
    assert flakes.sum() > 200
    assert lone[flakes].mean() > 0.9 and lone[~flakes].mean() < 0.2


def test_a_network_that_drops_them_sees_each_cloud_without_and_only_once() -> None:
    sample = make_sample(frame(0, ground=300, per_car=60), 1000, GRID)
    detector = talkative(fusion="attention", drop_lone_points=True)
    without = without_lone_points(sample)
    for before, after, pose in zip(sample.clouds, without.clouds, sample.ego_from_agent, strict=True):
        assert 0 < len(after) < len(before)
        assert np.array_equal(after, before[~lone_points(before, pose[:3, 3])])
    assert any(lone_points(c, p[:3, 3]).any() for c, p in zip(without.clouds, sample.ego_from_agent, strict=True))
    expected = talkative(fusion="attention").detect(without)
    found = detector.detect(sample)
    assert len(expected) > 3 and np.array_equal(found.boxes.array, expected.boxes.array)
    whole = team_detections(detector, sample)[-1]
    np.testing.assert_allclose(whole.score, found.score, atol=1e-4)
    assert prepared(sample, talkative().settings) is sample


def test_the_option_of_an_evaluation_reaches_every_method(tmp_path: Path) -> None:
    drives, detector = write_drives(tmp_path / "test", drives=1), write_detector(tmp_path / "a.pt", "attfuse")
    config = Evaluation(checkpoint=(str(detector),), data=drives, out=tmp_path / "out", drop_lone_points=True)
    methods = plan_of_evaluation(config).methods
    assert len(methods) == 2 and all(method.use == {"drop_lone_points": True} for method in methods)
    assert open_detector(detector, use=methods[0].use).settings.drop_lone_points
    with pytest.raises(SettingsError, match=r"a.B: use: expected none beside a detector of one's own, found drop_lone"):
        open_detector("a:B", use=methods[0].use)
