"""Rigid transforms, angles, and conversions from and to the conventions of SUMO and CARLA.

Ours is right-handed ENU: metres, z up, yaw counter-clockwise from +x in radians. A transform is a float64 4 x 4
matrix named destination_from_source, so that `world_from_lidar @ points` reads as it acts. Nothing outside this
module knows another convention.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

# CARLA's world is left-handed with y to the right: the two worlds are mirror images in the x-z plane.
_MIRROR_Y = np.diag([1.0, -1.0, 1.0, 1.0])


def wrap_angle(angle: ArrayLike) -> Array:
    """Wrap angles in radians into (-pi, pi]."""
    wrapped = np.pi - np.mod(np.pi - np.asarray(angle, dtype=np.float64), 2.0 * np.pi)
    # Just above pi the remainder rounds to a full turn.
    return np.where(wrapped <= -np.pi, np.pi, wrapped)[()]


def pose_matrix(xyz: ArrayLike, yaw: ArrayLike = 0.0, pitch: ArrayLike = 0.0, roll: ArrayLike = 0.0) -> Array:
    """Return parent_from_body of bodies at `xyz` rotated by Rz(yaw) Ry(pitch) Rx(roll).

    Args:
        xyz: (..., 3) position in the parent frame, m.
        yaw: (...) rad, counter-clockwise about z.
        pitch: (...) rad about y; positive lowers the front (x forward, z up).
        roll: (...) rad about x.

    Returns:
        (..., 4, 4) float64.
    """
    xyz = np.asarray(xyz, dtype=np.float64)
    yaw, pitch, roll = np.broadcast_arrays(
        np.asarray(yaw, np.float64), np.asarray(pitch, np.float64), np.asarray(roll, np.float64)
    )
    cy, sy = np.cos(yaw), np.sin(yaw)
    cp, sp = np.cos(pitch), np.sin(pitch)
    cr, sr = np.cos(roll), np.sin(roll)
    shape = np.broadcast_shapes(xyz.shape[:-1], yaw.shape)
    matrix = np.zeros((*shape, 4, 4))
    matrix[..., 0, 0] = cy * cp
    matrix[..., 0, 1] = cy * sp * sr - sy * cr
    matrix[..., 0, 2] = cy * sp * cr + sy * sr
    matrix[..., 1, 0] = sy * cp
    matrix[..., 1, 1] = sy * sp * sr + cy * cr
    matrix[..., 1, 2] = sy * sp * cr - cy * sr
    matrix[..., 2, 0] = -sp
    matrix[..., 2, 1] = cp * sr
    matrix[..., 2, 2] = cp * cr
    matrix[..., :3, 3] = xyz
    matrix[..., 3, 3] = 1.0
    return matrix


def pose_angles(matrix: ArrayLike) -> tuple[Array, Array, Array]:
    """Return (yaw, pitch, roll) in radians of (..., 4, 4) transforms, the inverse of `pose_matrix`."""
    m = np.asarray(matrix, dtype=np.float64)
    yaw = np.arctan2(m[..., 1, 0], m[..., 0, 0])
    pitch = np.arctan2(-m[..., 2, 0], np.hypot(m[..., 0, 0], m[..., 1, 0]))
    roll = np.arctan2(m[..., 2, 1], m[..., 2, 2])
    return yaw, pitch, roll


def invert(matrix: ArrayLike) -> Array:
    """Return source_from_destination of rigid (..., 4, 4) transforms."""
    m = np.asarray(matrix, dtype=np.float64)
    rotation = np.swapaxes(m[..., :3, :3], -1, -2)
    out = np.zeros_like(m)
    out[..., :3, :3] = rotation
    out[..., :3, 3] = -(rotation @ m[..., :3, 3:4])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def nearest_rotation(matrix: ArrayLike) -> Array:
    """Return the rotation (3, 3) nearest to a matrix; a rotation exact to 1e-12 stays bit for bit.

    The orthogonal Procrustes problem: P. Schoenemann, Psychometrika 31 (1966).
    """
    m = np.asarray(matrix, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):  # huge numbers of a broken file are no rotation
        is_rotation = np.allclose(m @ m.T, np.eye(3), rtol=0.0, atol=1e-12)
    if is_rotation and np.linalg.det(m) > 0.0:
        return m.copy()
    u, _, v = np.linalg.svd(m)
    # A reflection becomes the nearest rotation.
    u[:, -1] *= np.sign(np.linalg.det(u @ v))
    return np.asarray(u @ v)


def transform_points(destination_from_source: ArrayLike, points: ArrayLike) -> NDArray[np.floating]:
    """Map (..., N, 3) points by a (..., 4, 4) transform; computed in float64, returned in the points' dtype."""
    matrix = np.asarray(destination_from_source, dtype=np.float64)
    points = np.asarray(points)
    dtype = points.dtype if np.issubdtype(points.dtype, np.floating) else np.dtype(np.float64)
    out = points.astype(np.float64) @ np.swapaxes(matrix[..., :3, :3], -1, -2)
    out += matrix[..., None, :3, 3]
    return out.astype(dtype, copy=False)


def center_from_sumo(
    front_xyz: ArrayLike, angle_deg: ArrayLike, slope_deg: ArrayLike, length: ArrayLike
) -> tuple[Array, Array, Array]:
    """Convert SUMO's vehicle pose to the centre of the footprint.

    SUMO gives the centre of the front bumper at road level, an angle in degrees clockwise from north, and the
    slope of the road in degrees, positive uphill.

    Args:
        front_xyz: (N, 3) m.
        angle_deg: (N,).
        slope_deg: (N,).

    Returns:
        (N, 3) centre of the footprint at road level, (N,) yaw and (N,) pitch in radians (nose up is negative).
    """
    front = np.asarray(front_xyz, np.float64)
    yaw = wrap_angle(np.radians(90.0 - np.asarray(angle_deg, np.float64)))
    slope = np.radians(np.asarray(slope_deg, np.float64))
    half = 0.5 * np.asarray(length, np.float64)
    forward = np.stack([np.cos(slope) * np.cos(yaw), np.cos(slope) * np.sin(yaw), np.sin(slope)], axis=-1)
    return front - half[..., None] * forward, yaw, -slope


def carla_matrix(pose: ArrayLike) -> Array:
    """Return CARLA's own left-handed world_from_body of (..., 6) poses [x, y, z, roll, yaw, pitch], m and deg."""
    pose = np.asarray(pose, dtype=np.float64)
    angles = np.radians(pose[..., 3:])
    return pose_matrix(pose[..., :3], yaw=angles[..., 1], pitch=-angles[..., 2], roll=-angles[..., 0])


def matrix_from_carla(pose: ArrayLike) -> Array:
    """Return our right-handed world_from_body of CARLA poses (..., 6): the mirror image in y."""
    return _MIRROR_Y @ carla_matrix(pose) @ _MIRROR_Y


def carla_from_matrix(matrix: ArrayLike) -> Array:
    """Return CARLA's (..., 6) pose [x, y, z, roll, yaw, pitch], m and deg, of our world_from_body."""
    matrix = np.asarray(matrix, dtype=np.float64)
    yaw, pitch, roll = pose_angles(matrix)
    xyz = matrix[..., :3, 3] * np.array([1.0, -1.0, 1.0])
    return np.concatenate([xyz, np.degrees(np.stack([roll, -yaw, -pitch], axis=-1))], axis=-1)
