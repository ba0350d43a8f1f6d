"""Detection on uneven ground: clouds are put on the flat ground that a detector was trained on, and its boxes back.

Real ground slopes, and sensors stand at other heights than ours: boxes of one height above a flat ground are missed and
made up (the ground of `dsrc.ops.ground` found 64 % where 49 % of real vehicles were found without it).
"""

from dataclasses import replace
from typing import Any, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.data.sample import DetectorSettings, Sample, SampleDetector
from dsrc.models.settings import ModelSettings
from dsrc.ops.detections import Detections
from dsrc.ops.grid import GridSpec
from dsrc.ops.ground import fit_ground
from sim.boxes import VEHICLES
from sim.errors import SettingsError, complaint

AUTO = "auto"
RECORDED = "recorded"
SENSOR_M = 1.9
"""Height of the LiDAR above the ground for which our detectors are trained; of one's own `sensor_m` says it."""
_BEYOND_M = 12.0
"""Height by which the range of a levelled detector grows up and down."""


class _Surface(Protocol):
    def at(self, xy: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return (P,) heights at (P, 2) places, m."""
        ...


class LevelledDetector:
    """Detector whose samples are put on flat ground, and whose boxes are put back.

    Args:
        detector: the detector.
        height: see `check_height`; not `recorded`.

    Attributes:
        settings: the detector's, with a range that grows by 12 m up and down: what counts lies on any ground.
        classes: of what it detects.
    """

    def __init__(self, detector: SampleDetector, height: str) -> None:
        self.inner, self.height = detector, height
        self.classes: tuple[str, ...] = getattr(detector, "classes", VEHICLES)
        self.settings = _taller(detector.settings)
        self._sensor_m = float(getattr(detector, "sensor_m", SENSOR_M))

    def detect(self, sample: Sample) -> Detections:
        """Detect in one sample, best first, in its frame."""
        every = np.concatenate(sample.clouds)
        surface: _Surface = fit_ground(every) if self.height == AUTO else _Flat(-float(self.height))
        grid = self.inner.settings.grid
        clouds = tuple(self._levelled(cloud, surface, grid) for cloud in sample.clouds)
        found = self.inner.detect(replace(sample, clouds=clouds))
        center = found.boxes.center.copy()
        center[:, 2] += surface.at(center[:, :2]) + self._sensor_m
        return Detections(replace(found.boxes, center=center), found.score)

    def _levelled(self, cloud: NDArray[np.float32], surface: _Surface, grid: GridSpec) -> NDArray[np.float32]:
        height = cloud[:, 2] - (surface.at(cloud[:, :2]) + self._sensor_m).astype(np.float32)
        inside = (height > np.float32(grid.range_m[2])) & (height < np.float32(grid.range_m[5]))
        return np.column_stack([cloud[inside, :2], height[inside], cloud[inside, 3]])


class _Flat:
    """Ground at one height."""

    def __init__(self, height_m: float) -> None:
        self.height_m = height_m

    def at(self, xy: NDArray[np.floating]) -> NDArray[np.float64]:
        return np.full(len(xy), self.height_m)


def levelled(detector: SampleDetector, height: str) -> SampleDetector:
    """Return a detector on levelled ground; itself for `recorded`."""
    return detector if height == RECORDED else LevelledDetector(detector, height)


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
    def taller(grid: GridSpec) -> GridSpec:
        x0, y0, z0, x1, y1, z1 = grid.range_m
        return msgspec.structs.replace(grid, range_m=(x0, y0, z0 - _BEYOND_M, x1, y1, z1 + _BEYOND_M))

    if isinstance(settings, ModelSettings):
        return msgspec.structs.replace(settings, grid=taller(settings.grid))
    request: Any = settings.request
    return replace(request, grid=taller(request.grid))
