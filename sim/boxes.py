"""Upright boxes: corners, transforms, points in boxes and bird's-eye polygons."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.errors import DataError, complaint
from sim.geometry import pose_angles, pose_matrix, transform_points, wrap_angle
from sim.rows import Rows, stacked

CLASSES = ("car", "van", "truck", "bus", "motorcycle", "bicycle", "pedestrian")
"""Class names by label index."""

VEHICLES = ("car", "van", "truck", "bus")
"""Classes that detection counts as vehicles, as in OPV2V and DAIR-V2X."""

VULNERABLE = ("pedestrian", "bicycle", "motorcycle")
"""Vulnerable road users: those without a body of steel around them."""

# Corner order of the OPV2V tools: front right, front left, rear left, rear right; bottom, then top.
_CORNER_SIGNS = np.array(
    [[x, y, z] for z in (-0.5, 0.5) for x, y in ((0.5, -0.5), (0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5))]
)
_TURN_RAD = 2.0 * np.pi + 1e-3
"""Largest heading in radians: a whole turn, rounded up."""


def check_radians(where: Path | str, field: str, yaw: NDArray[np.floating]) -> None:
    """Check (N,) headings; DataError for one beyond a whole turn, which is in degrees. NaN passes."""
    beyond = np.flatnonzero(np.abs(yaw) > _TURN_RAD)
    if len(beyond):
        found = f"{yaw[beyond[0]]:g} in row {beyond[0]}"
        raise DataError(complaint(where, field, "radians within 2 pi", found, "; is it in degrees?"))


@dataclass(frozen=True, slots=True, eq=False)
class Boxes(Rows):
    """N upright boxes in one frame; the variable that holds them names the frame.

    Attributes:
        center: (N, 3) float64 geometric centre, m.
        size: (N, 3) float64 full length (along the heading), width and height, m.
        yaw: (N,) float64 heading, rad in (-pi, pi].
        label: (N,) int64 index into `CLASSES`.
        object_id: (N,) int64, equal for one actor in all frames and agents; -1 unknown.
    """

    center: NDArray[np.float64]
    size: NDArray[np.float64]
    yaw: NDArray[np.float64]
    label: NDArray[np.int64]
    object_id: NDArray[np.int64]

    def __post_init__(self) -> None:
        n = len(self.center)
        expected = {"center": (n, 3), "size": (n, 3), "yaw": (n,), "label": (n,), "object_id": (n,)}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"Boxes.{name} must have shape {shape}, got {getattr(self, name).shape}")

    @classmethod
    def from_array(cls, array: ArrayLike, label: ArrayLike | None = None, object_id: ArrayLike | None = None) -> Self:
        """Boxes from (N, 7) rows x, y, z, l, w, h, yaw; cars by default, with ids of -1."""
        array = np.asarray(array, dtype=np.float64).reshape(-1, 7)
        n = len(array)
        return cls(
            center=array[:, :3].copy(),
            size=array[:, 3:6].copy(),
            yaw=wrap_angle(array[:, 6]),
            label=np.zeros(n, np.int64) if label is None else np.asarray(label, np.int64),
            object_id=np.full(n, -1, np.int64) if object_id is None else np.asarray(object_id, np.int64),
        )

    @classmethod
    def zeros(cls) -> Self:
        """Empty boxes."""
        return cls.from_array(np.zeros((0, 7)))

    @property
    def array(self) -> NDArray[np.float64]:
        """(N, 7) rows x, y, z, l, w, h, yaw."""
        return np.concatenate([self.center, self.size, self.yaw[:, None]], axis=1)

    @property
    def is_vehicle(self) -> NDArray[np.bool_]:
        """(N,) mask of `VEHICLES`."""
        return np.isin(self.label, [CLASSES.index(name) for name in VEHICLES])

    @property
    def is_vulnerable(self) -> NDArray[np.bool_]:
        """(N,) mask of `VULNERABLE`."""
        return np.isin(self.label, [CLASSES.index(name) for name in VULNERABLE])

    def corners(self) -> NDArray[np.float64]:
        """Return (N, 8, 3) corners: front right, front left, rear left, rear right at the bottom, then on top."""
        local = _CORNER_SIGNS * self.size[:, None, :]
        return np.asarray(transform_points(pose_matrix(self.center, self.yaw), local), np.float64)

    def bev_polygons(self) -> NDArray[np.float64]:
        """Return (N, 4, 2) footprints, counter-clockwise from the front right corner."""
        return self.corners()[:, :4, :2]

    def transform(self, destination_from_source: ArrayLike) -> Self:
        """Boxes in another frame, still upright: a tilt turns the heading but not the box.

        The heading becomes the direction of the transformed x axis in the destination's x-y plane.
        """
        matrix = np.asarray(destination_from_source, np.float64)
        forward = np.stack([np.cos(self.yaw), np.sin(self.yaw)], axis=1) @ matrix[:2, :2].T
        return replace(
            self,
            center=np.asarray(transform_points(matrix, self.center), np.float64),
            yaw=wrap_angle(np.arctan2(forward[:, 1], forward[:, 0])),
        )

    def contains(self, points: ArrayLike, margin: float = 0.0) -> NDArray[np.bool_]:
        """Return the (N, P) mask of (P, 3) points inside each rotated box, faces included.

        Args:
            points: (P, 3) in the boxes' frame, m.
            margin: outward growth of every face, m.
        """
        points = np.asarray(points, np.float64)
        inside = np.zeros((len(self), len(points)), bool)
        reach = 0.5 * np.linalg.norm(self.size[:, :2], axis=1) + 2.0 * abs(margin) + 1e-6
        for row in range(len(self)):
            # Only points in the square around the box can be inside: the exact test runs on few of them.
            offset = points - self.center[row]
            near = np.flatnonzero(np.maximum(np.abs(offset[:, 0]), np.abs(offset[:, 1])) <= reach[row])
            local = offset[near]
            c, s = np.cos(self.yaw[row]), np.sin(self.yaw[row])
            along = np.abs(c * local[:, 0] + s * local[:, 1])
            across = np.abs(c * local[:, 1] - s * local[:, 0])
            half = 0.5 * self.size[row] + margin + 1e-9
            inside[row, near] = (along <= half[0]) & (across <= half[1]) & (np.abs(local[:, 2]) <= half[2])
        return inside


def tilted_poses(boxes: Boxes, tilt: ArrayLike) -> NDArray[np.float64]:
    """Return (N, 4, 4) poses of the middles of bodies in upright boxes, tilted about the middles of their footprints.

    Args:
        tilt: (N, 2) pitch and roll, rad.
    """
    pitch, roll = np.asarray(tilt, np.float64).reshape(-1, 2).T
    poses = pose_matrix(boxes.center, boxes.yaw, pitch, roll)
    poses[:, :3, 3] += _tipped(poses, boxes.size[:, 2])
    return poses


def upright_of(pose: ArrayLike, height: float) -> tuple[NDArray[np.float64], float, tuple[float, float]]:
    """Return centre (3,), yaw and (pitch, roll) of the upright box of one body, the inverse of `tilted_poses`.

    Args:
        pose: (4, 4) of the middle of the body.
        height: of the body, m.
    """
    matrix = np.asarray(pose, np.float64)
    yaw, pitch, roll = map(float, pose_angles(matrix))
    return matrix[:3, 3] - _tipped(matrix[None], np.array([height]))[0], yaw, (pitch, roll)


def _tipped(poses: NDArray[np.float64], height: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N, 3) ways from the middles of upright boxes to those of the tilted bodies in them."""
    return 0.5 * height[:, None] * (poses[:, :3, 2] - [0.0, 0.0, 1.0])


def concatenate(parts: Sequence[Boxes]) -> Boxes:
    """Stack boxes that share a frame."""
    return stacked(*parts) if parts else Boxes.zeros()
