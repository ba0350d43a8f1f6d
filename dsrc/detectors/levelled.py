"""Detection on uneven ground: clouds are put on the flat ground that a detector was trained on, and its boxes back.

Real ground slopes, and sensors stand at other heights than ours: boxes of one height above a flat ground are missed and
made up (see `dsrc.data.level`). A network that was trained on levelled clouds levels them itself.
"""

from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from dsrc.data.level import joined, level, level_by, raised, taller
from dsrc.data.sample import DetectorSettings, Sample, SampleDetector
from dsrc.models.settings import ModelSettings
from dsrc.ops.detections import Detections
from dsrc.ops.ground import LIDAR_M, Ground
from sim.boxes import VEHICLES
from sim.errors import SettingsError, complaint

AUTO = "auto"
RECORDED = "recorded"


class LevelledDetector:
    """Detector whose samples are put on flat ground, and whose boxes are put back.

    Args:
        detector: the detector; its `sensor_m`, where it has one, is the height of its LiDAR above the ground, else 1.9.
        height: see `check_height`; not `recorded`.

    Attributes:
        settings: the detector's, with a range that grows by 12 m up and down: what counts lies on any ground.
        classes: of what it detects.
    """

    def __init__(self, detector: SampleDetector, height: str) -> None:
        self.inner, self.height = detector, height
        self.classes: tuple[str, ...] = getattr(detector, "classes", VEHICLES)
        self.settings = _taller(detector.settings)
        self._lidar_m = float(getattr(detector, "sensor_m", LIDAR_M))

    def detect(self, sample: Sample) -> Detections:
        """Detect in one sample, best first, in its frame."""
        grid = self.inner.settings.grid
        if self.height == AUTO:
            seen = level(sample, grid, self._lidar_m)
        else:
            flat = Ground(np.full((2, 2), -float(self.height)), np.ones((2, 2), bool))
            seen = level_by(sample, (flat,) * len(sample.clouds), grid, self._lidar_m)
        found = self.inner.detect(replace(seen, grounds=()))
        return Detections(raised(found.boxes, joined(seen.grounds), lidar_m=self._lidar_m), found.score)


def levelled(detector: SampleDetector, height: str) -> SampleDetector:
    """Return a detector on levelled ground; itself for `recorded`, and for `auto` where it levels samples itself.

    Raises:
        SettingsError: a height in metres of a detector that levels samples itself.
    """
    own = getattr(detector.settings, "height", "sensor") == "ground"
    if own and height not in (AUTO, RECORDED):
        raise SettingsError(
            complaint("detector", "height", "auto: it has learnt heights above a fitted ground", height)
        )
    return detector if own or height == RECORDED else LevelledDetector(detector, height)


def check_height(where: str, height: object) -> str:
    """Return a height: `recorded`, `auto` for a fitted ground, or that of the ego's LiDAR above flat ground, m.

    Raises:
        SettingsError: it is none of these.
    """
    text = str(height)
    if text in (AUTO, RECORDED):
        return text
    try:
        if 0.0 < float(text) < 20.0:
            return f"{float(text):g}"
    except ValueError:
        pass
    raise SettingsError(complaint(where, "height", "recorded, auto or metres of the LiDAR above the ground", text))


def height_in_use(where: str, height: str) -> dict[str, bool | int | float | str]:
    """Return a height as `use` of a detector, none for `recorded`; raises as `check_height`."""
    checked = check_height(where, height)
    return {} if checked == RECORDED else {"height": checked}


def _taller(settings: DetectorSettings) -> DetectorSettings:
    if isinstance(settings, ModelSettings):
        return msgspec.structs.replace(settings, grid=taller(settings.grid))
    request: Any = settings.request
    return replace(request, grid=taller(request.grid))
