"""Corruption as a step of a training pipeline: torch's data loaders, mmdetection3d, OpenPCDet, and plain arrays.

None of these is imported: tensors and their wrappers are known by what they can do.
"""

import copy
import zlib
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.data.clouds.columns import parse_columns
from dsrc.data.clouds.corrupt import array_of, cloud_of, corrupt_sweep
from dsrc.data.clouds.intensity import Scale, parse_scale
from sensors.corruptions import CLEAN, SEVERITIES, Condition, Family, require_corruption
from sensors.presets import get_lidar
from sim.errors import DataError, SettingsError, complaint
from sim.streams import Stream, random_generator

_PER_POINT = ("pts_semantic_mask", "pts_instance_mask", "point_labels")
"""Columns of dictionaries with one value per point, which stay in step; 0 for added points."""
_NUMBERS = ("sample_idx", "frame_id", "index")
"""Names of the sample in dictionaries."""
_PEOPLE = ("pedestrian", "person", "walker")


class CorruptTransform(msgspec.Struct, frozen=True, kw_only=True):
    """Random corruption of samples: a function of an array, a tensor or a dictionary with `points`.

    The draws depend on the seed and the sample alone, so any number of workers gives the same; without a number or a
    name a sample is known by its points. An epoch that shall differ takes another seed, or a generator.

    Attributes:
        kinds: to choose from, each as likely; `clean` may be among them.
        severities: to choose from.
        probability: share of the samples that are corrupted.
        seed: of the choices and of the corruptions.
        family: of the settings.
        sensor: name of a LiDAR preset; None if unknown.
        ring: column of the beam index; None where there is none.
        columns: names of the columns, see `dsrc.corrupt`; None for x y z intensity and anything.
        intensity_scale: intensity that means 1, or `waymo`; None finds 1 or 255 in each sample, so declare it for
            others.

    Raises:
        SettingsError: an unknown kind, severity, family or sensor, nothing to choose from, or no probability.
    """

    kinds: Sequence[str] = ("fog",)
    severities: Sequence[int] = tuple(SEVERITIES)
    probability: float = 1.0
    seed: int = 0
    family: Family = "physical"
    sensor: str | None = None
    ring: int | None = None
    columns: Sequence[str] | None = None
    intensity_scale: Scale | None = None

    def __post_init__(self) -> None:
        if not self.kinds or not self.severities or isinstance(self.kinds, str):
            found = f"{self.kinds!r}, {self.severities!r}"
            raise SettingsError(complaint("CorruptTransform", "kinds and severities", "lists of at least one", found))
        if not 0.0 <= self.probability <= 1.0:
            raise SettingsError(complaint("CorruptTransform", "probability", "0 to 1", self.probability))
        for kind in self.kinds:
            for severity in self.severities:
                require_corruption(kind, severity, self.family)
        if self.sensor is not None:
            get_lidar(self.sensor)
        parse_columns(self.columns)
        parse_scale(self.intensity_scale)

    def __call__(self, sample: Any, index: int | str | None = None, rng: np.random.Generator | None = None) -> Any:
        """Return the sample with corrupted points; the input is untouched.

        Args:
            sample: (P, C) array or tensor of points as `dsrc.corrupt` takes them, an object with these as `.tensor`
                (mmdetection3d), or a dictionary with one of these as `points`. Of a dictionary `gt_boxes` (OpenPCDet)
                or `gt_bboxes_3d` (mmdetection3d) are used by kinds that need objects, and labels per point stay in
                step.
            index: number or name of the sample; None for that of the dictionary, or else the points themselves.

        Raises:
            DataError: see `dsrc.corrupt`.
            SettingsError: a kind that needs boxes, and there are none.
        """
        if not isinstance(sample, dict):
            return self._corrupted(sample, None, index, rng)[0]
        if "points" not in sample:
            raise DataError(complaint("CorruptTransform", "points", "a key of the sample", ", ".join(map(str, sample))))
        if index is None:
            index = next((sample[name] for name in _NUMBERS if name in sample), None)
        points, row = self._corrupted(sample["points"], _boxes_of(sample), index, rng)
        done = {**sample, "points": points}
        for name in _PER_POINT:
            if name in sample and row is not None:
                labels = _array(sample[name])
                done[name] = _like(sample[name], np.where(row < 0, 0, labels[np.maximum(row, 0)]).astype(labels.dtype))
        return done

    def _corrupted(
        self, points: object, boxes: NDArray[np.float64] | None, index: object, rng: np.random.Generator | None
    ) -> tuple[Any, NDArray[np.int64] | None]:
        """Return the corrupted points and the row that each was, -1 for added ones; None where nothing changes."""
        rows = _array(points)
        if rng is None:
            key = zlib.crc32(rows.tobytes()) if index is None else str(_array(index))
            rng = random_generator(self.seed, Stream.TRAINING_CORRUPTION, 0, key)
        chosen, kind, level = rng.random(), rng.choice(self.kinds), rng.choice(self.severities)
        seed = rng.integers(1 << 32)
        if chosen >= self.probability or kind == CLEAN:
            return points, None
        cloud = cloud_of(rows, self.ring, self.columns, self.intensity_scale)
        spec = None if self.sensor is None else get_lidar(self.sensor)
        condition = Condition(str(kind), int(level), self.family)
        sweep = corrupt_sweep(cloud.sweep(spec), condition, int(seed), boxes=boxes)
        return _like(points, array_of(cloud.of(sweep), rows.dtype)), cloud.rows(sweep)


def _array(values: object) -> NDArray[Any]:
    """Return an array of an array, a tensor, or an object that holds a tensor."""
    values = getattr(values, "tensor", values)
    return np.asarray(values.detach().cpu() if hasattr(values, "detach") else values)


def _like(old: object, new: NDArray) -> Any:
    """Return new values in the form of the old ones: array, tensor or holder of a tensor."""
    if hasattr(old, "tensor"):
        holder = copy.copy(old)
        holder.tensor = _like(old.tensor, new)
        return holder
    return old.new_tensor(new) if hasattr(old, "new_tensor") else new


def _boxes_of(sample: dict[str, Any]) -> NDArray[np.float64] | None:
    """Return (M, 7 or 9) boxes of the vehicles of a sample, None without any."""
    if "gt_bboxes_3d" in sample:
        boxes = sample["gt_bboxes_3d"]
        rows = _array(boxes).astype(np.float64)
        if hasattr(boxes, "gravity_center"):  # boxes there are placed by the middle of their bottom
            rows[:, :3] = _array(boxes.gravity_center)
    elif "gt_boxes" in sample:
        rows = _array(sample["gt_boxes"]).astype(np.float64)
    else:
        return None
    if "gt_names" in sample and len(rows):
        names = [str(name).lower() for name in sample["gt_names"]]
        rows = rows[[not any(person in name for person in _PEOPLE) for name in names]]
    # An eighth or tenth column is the class.
    return rows[:, : 9 if rows.ndim == 2 and rows.shape[1] >= 9 else 7]
