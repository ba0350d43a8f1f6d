"""Detectors joined: several detectors of different road users as one."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dsrc.data.sample import Sample
from dsrc.models.detector import Detector
from dsrc.ops.detections import Detections
from dsrc.ops.grid import GridSpec
from sim.boxes import CLASSES, concatenate
from sim.errors import SettingsError, complaint


class JoinedDetectors:
    """Detectors of different road users as one, each with its own grid; the first one's settings make the samples.

    Attributes:
        settings: those of the first.
        classes: of what any of them detects.

    Raises:
        SettingsError: two detect the same road users, or a grid is not within that of the first.
    """

    def __init__(self, detectors: Sequence[Detector]) -> None:
        self.detectors = tuple(detectors)
        self.settings = detectors[0].settings
        self.classes = tuple(name for detector in detectors for name in detector.classes)
        users = [detector.settings.users for detector in detectors]
        if len(set(users)) < len(users):
            raise SettingsError(complaint("detectors", "users", "different road users", " and ".join(users)))
        whole = self.settings.request.grid
        for detector in detectors[1:]:
            grid = detector.settings.request.grid
            low, high = np.array(grid.range_m[:3]), np.array(grid.range_m[3:])
            if (low < whole.range_m[:3]).any() or (high > whole.range_m[3:]).any():
                raise SettingsError(
                    complaint("detectors", "grid", f"a range within {whole.range_m}, the first one's", grid.range_m)
                )

    def detect(self, sample: Sample) -> Detections:
        """Detect in one sample of the first one's settings, best first, in the ego LiDAR's frame."""
        return _best_first([detector.detect(self._part(sample, detector)) for detector in self.detectors])

    def detect_each(self, sample: Sample) -> list[Detections]:
        """Detect in the cloud of each agent alone, see `Detector.detect_each`."""
        found = [detector.detect_each(self._part(sample, detector)) for detector in self.detectors]
        return [_best_first(parts) for parts in zip(*found, strict=True)]

    def joined(self, parts: list[Detections]) -> Detections:
        """Return the detections of several agents as one, best first: a vehicle suppresses vehicles alone."""
        found = []
        for detector in self.detectors:
            labels = [CLASSES.index(name) for name in detector.classes]
            found.append(detector.joined([part[np.isin(part.boxes.label, labels)] for part in parts]))
        return _best_first(found)

    def _part(self, sample: Sample, detector: Detector) -> Sample:
        """Return the sample of one of the detectors: lost tiles are those of its own grid."""
        lost = tuple(tiles_of(part, self.settings.grid, detector.settings.grid) for part in sample.lost)
        return replace(sample, lost=lost)


def _best_first(parts: Sequence[Detections]) -> Detections:
    score = np.concatenate([part.score for part in parts])
    order = np.argsort(-score, kind="stable")
    return Detections(concatenate([part.boxes for part in parts])[order], score[order])


def tiles_of(lost: NDArray[np.bool_], whole: GridSpec, grid: GridSpec) -> NDArray[np.bool_]:
    """Return the (h, w) lost tiles of a map on another grid: those whose centres lie in a lost tile of the whole.

    Args:
        lost: tiles of the whole; (0, 0) for none, which is returned.
    """
    if not lost.size or grid == whole:
        return lost
    rows, columns = (_tiles_along(axis, lost.shape[1 - axis], whole, grid) for axis in (1, 0))
    return lost[np.ix_(rows, columns)]


def _tiles_along(axis: int, count: int, whole: GridSpec, grid: GridSpec) -> NDArray[np.int64]:
    """Return the tile of the whole, one of `count` along an axis, at the centre of each tile of a grid."""
    cells = (grid.width, grid.height)[axis]
    low, high = grid.range_m[axis], grid.range_m[axis + 3]
    number = (whole.width, whole.height)[axis] // count
    tiles = cells // number
    centres = low + (np.arange(tiles) + 0.5) * (high - low) / tiles
    first, last = whole.range_m[axis], whole.range_m[axis + 3]
    return np.clip(((centres - first) / (last - first) * count).astype(np.int64), 0, count - 1)
