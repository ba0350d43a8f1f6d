"""A detector on levelled ground finds on a slope what it finds on a plain, and puts its boxes on the slope."""

from dataclasses import replace

import numpy as np
import pytest

from dsrc.data.sample import Sample, SampleRequest
from dsrc.detectors.levelled import LevelledDetector, check_height, levelled
from dsrc.models.settings import ModelSettings
from dsrc.ops.detections import Detections
from dsrc.ops.grid import GridSpec
from sim.boxes import Boxes
from sim.errors import SettingsError

GRID = GridSpec((-51.2, -25.6, -3.0, 51.2, 25.6, 1.0))


class Tops:
    """Puts a box below the highest point of each block of 8 m, and keeps what it was given."""

    settings = SampleRequest(GRID)

    def detect(self, sample: Sample) -> Detections:
        self.given = sample.clouds
        points = np.concatenate(sample.clouds)[:, :3].astype(np.float64)
        blocks = np.unique(np.floor(points[:, :2] / 8.0), axis=0, return_inverse=True)[1].ravel()
        tops = [points[blocks == k][np.argmax(points[blocks == k, 2])] for k in range(blocks.max() + 1)]
        boxes = [[*top[:2], top[2] - 0.8, 4.0, 1.8, 1.6, 0.0] for top in tops if top[2] > -1.0]
        return Detections(Boxes.from_array(boxes), np.full(len(boxes), 0.5, np.float32))


def street(sensor_m: float = 1.9) -> Sample:
    """Return flat ground around a LiDAR at a height, with two cars of 1.6 m as clouds of points."""
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform((-40, -20), (40, 20), (30_000, 2)), np.full(30_000, -sensor_m)])
    cars = [rng.uniform((x - 2, y - 0.9, 0.3 - sensor_m), (x + 2, y + 0.9, 1.6 - sensor_m), (400, 3)) for x, y in CARS]
    points = np.concatenate([ground, *cars])
    cloud = np.column_stack([points, np.zeros(len(points))]).astype(np.float32)
    return Sample("toy", (1,), (cloud,), np.eye(4)[None], Boxes.zeros(), (Boxes.zeros(),))


CARS = ((12.0, 4.0), (-20.0, -4.0))


def moved(sample: Sample, slope: float) -> Sample:
    cloud = sample.clouds[0].copy()
    cloud[:, 2] += slope * cloud[:, 0]
    return replace(sample, clouds=(cloud,))


@pytest.mark.parametrize("slope", [0.0, 0.03, 0.1, -0.1])
def test_boxes_on_a_slope_are_those_of_the_plain_on_the_slope(slope: float) -> None:
    plain = Tops().detect(street())
    detector = LevelledDetector(Tops(), "auto")
    found = detector.detect(moved(street(), slope))
    assert len(found) == len(plain) == 2
    assert np.allclose(found.boxes.center[:, :2], plain.boxes.center[:, :2], atol=4.0)  # another point of the roof
    above = found.boxes.center[:, 2] - slope * found.boxes.center[:, 0]
    assert np.allclose(above, plain.boxes.center[:, 2], atol=0.15)
    ground = detector.inner.given[0]
    # The lowest twentieth of a cell of 2 m lies that much below its centre.
    assert abs(np.median(ground[:, 2]) + 1.9) < 0.02 + abs(slope) and ground.dtype == np.float32


def test_a_height_in_metres_moves_the_cloud_and_the_boxes() -> None:
    plain, low = Tops().detect(street()), LevelledDetector(Tops(), "1.2").detect(street(1.2))
    assert np.allclose(low.boxes.center[:, 2] - plain.boxes.center[:, 2], 0.7, atol=1e-4)


def test_what_lies_on_a_hill_counts_too() -> None:
    taller = LevelledDetector(Tops(), "auto").settings.request
    assert taller.judged_m == (-51.2, -25.6, -15.0, 51.2, 25.6, 13.0)
    assert (taller.grid.width, taller.grid.height) == (GRID.width, GRID.height)


def test_a_network_keeps_its_settings_but_for_the_range_in_height() -> None:
    class Network(Tops):
        settings = ModelSettings(grid=GRID, comm_range_m=30.0)

    settings = LevelledDetector(Network(), "auto").settings
    assert isinstance(settings, ModelSettings) and settings.comm_range_m == 30.0 and settings.grid.range_m[5] == 13.0


def test_recorded_is_the_detector_itself_and_an_empty_cloud_is_no_error() -> None:
    detector = Tops()
    assert levelled(detector, "recorded") is detector

    class Nothing(Tops):
        def detect(self, sample: Sample) -> Detections:
            return Detections.zeros()

    empty = replace(street(), clouds=(np.zeros((0, 4), np.float32),))
    assert len(LevelledDetector(Nothing(), "auto").detect(empty)) == 0


@pytest.mark.parametrize("height", ["automatic", "0", "-1", "nan", "100", "1,9"])
def test_another_height_is_refused(height: str) -> None:
    with pytest.raises(SettingsError, match="height: expected recorded, auto or metres of the LiDAR above the ground"):
        check_height("detect", height)
