"""Motion blur: uncompensated motion of the sensor and of objects during a sweep, and vibration of the mount.

| severity                                              | 1     | 2     | 3    | 4    | 5    |
|-------------------------------------------------------|-------|-------|------|------|------|
| share of the own motion that odometry misses          | 0.1   | 0.25  | 0.5  | 0.75 | 1    |
| relative increase of the sweep's duration             | 0.1   | 0.25  | 0.5  | 0.75 | 1    |
| vibration, root mean square of each axis, m           | 0.002 | 0.005 | 0.01 | 0.02 | 0.04 |
| vibration, root mean square of each axis, deg/s       | 2     | 5     | 10   | 20   | 40   |

A beam that fires at t measures p_t in the sensor frame at t. With G(t) the sensor's true pose relative to the reference
time, B(t) the pose by odometry and S(t) the vibration, the driver delivers

    p = B(t) S(t) p_t,    p_t = inv(G(t)) p_true

B moves and turns the share `1 - missed_motion` of what G does: with 1 the sweep is not compensated at all. S is a sum
of sines of 8 to 30 Hz, between a car's wheel hop and the resonance of a mast, too fast for odometry; 10 deg/s at 15 Hz
are 0.1 degrees. Raw, uncompensated sweeps only vibrate.

Moving objects are smeared by the rolling shutter already; a longer sweep (1 for a sensor at 5 Hz instead of 10) smears
them by velocity * t * `slower` more. Their velocities are those of the frame, see `in_frame`.

The sensor's motion is that of `Sweep.path`, else the agent's speed in the frame, else none. Missing firing times, as in
CARLA's sweeps, follow from the columns, or from the azimuth at 10 Hz. Every point stays a return of its object with its
intensity. All numbers are assumed: level 3 displaces points 20 m away by 0.2 m at a speed of 10 m/s, the deviation of
the DSRC paper's jitter.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.levels import SeveritySettings
from sensors.frame import Frame
from sensors.sweep import MOVED, SCATTERED, Sweep
from sim.errors import DataError, complaint
from sim.geometry import invert

DEFAULT_PERIOD_S = 0.1
"""Duration of a sweep of an unknown sensor, s."""

_SHAKE_HZ = (8.0, 30.0)
_SINES = 4
_INSTANTS = 1024


class MotionBlur(SeveritySettings, frozen=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        missed_motion: share of the sensor's motion during the sweep that odometry misses.
        slower: increase of the sweep's duration, relative to it.
        shake_m: root mean square of the vibration along each axis, m.
        shake_deg_s: root mean square of the angular rate about each axis, deg/s.
    """

    LEVELS: ClassVar = {
        "missed_motion": (0.1, 0.25, 0.5, 0.75, 1.0),
        "slower": (0.1, 0.25, 0.5, 0.75, 1.0),
        "shake_m": (0.002, 0.005, 0.01, 0.02, 0.04),
        "shake_deg_s": (2.0, 5.0, 10.0, 20.0, 40.0),
    }
    RANGES: ClassVar = {
        "missed_motion": (0.0, 1.0),
        "slower": (0.0, 100.0),
        "shake_m": (0.0, 10.0),
        "shake_deg_s": (0.0, 1000.0),
    }

    missed_motion: float = 0.5
    slower: float = 0.5
    shake_m: float = 0.01
    shake_deg_s: float = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class SceneVelocities:
    """Velocities of the sensor and the objects of a frame.

    Attributes:
        sensor: (3,) velocity of the sensor in its own frame, m/s; used for sweeps without a path.
        object_id: (N,) ids, ascending.
        velocity: (N, 3) of the objects in the world, m/s.
    """

    sensor: NDArray[np.float64]
    object_id: NDArray[np.int64]
    velocity: NDArray[np.float64]


_STILL = SceneVelocities(np.zeros(3), np.zeros(0, np.int64), np.zeros((0, 3)))


def corrupt(
    sweep: Sweep, settings: MotionBlur, rng: np.random.Generator, velocities: SceneVelocities = _STILL
) -> Sweep:
    """Displace points by uncompensated motion, vibration and moving objects.

    Args:
        rng: draws the vibration; the same, only weaker, at a lower severity.
        velocities: of sensor and objects, from the frame.

    Raises:
        DataError: firing times are NaN or infinite.
    """
    hertz = _SHAKE_HZ[0] * (_SHAKE_HZ[1] / _SHAKE_HZ[0]) ** rng.random((6, _SINES))
    phase = rng.uniform(0.0, 2.0 * np.pi, (6, _SINES))
    if len(sweep) == 0:
        return sweep
    fired_s = _firing_offsets(sweep)
    first, last = float(fired_s.min()), float(fired_s.max())
    if not np.isfinite(last - first):
        raise DataError(complaint("motion_blur", "time_offset", "finite firing times", "nan or inf"))
    time_s = np.linspace(first, last, _INSTANTS if last > first else 1)
    change = _vibration(settings, hertz, phase, time_s)
    if sweep.motion != "raw":
        change = _uncompensated(sweep, settings, velocities, time_s, change)
    step = np.zeros(len(sweep), np.intp)
    if last > first:
        step = ((fired_s - first) * ((_INSTANTS - 1) / (last - first)) + 0.5).astype(np.intp)
    points = sweep.points + _displacement(sweep.points, (change - np.eye(4)).astype(np.float32), step)
    on, velocity = _object_velocities(sweep, velocities)
    points[on] += (velocity * (settings.slower * fired_s[on, None])).astype(np.float32)
    x, y, z = (points != sweep.points).T
    changed = (x | y | z) & (sweep.fate != SCATTERED)
    return replace(sweep, points=points, fate=np.where(changed, np.uint8(MOVED), sweep.fate))


def in_frame(frame: Frame, row: int, settings: MotionBlur, rng: np.random.Generator) -> Sweep:
    """Return the blurred sweep of the agent in a row of `frame.agents`, with the velocities of the frame's objects."""
    agent = frame.agents[row]
    forward = agent.sweep.world_from_lidar[:3, :3].T @ agent.world_from_body[:3, 0]
    order = np.argsort(frame.truth.object_id, kind="stable")
    velocity = np.zeros((len(order), 3))
    velocity[:, :2] = frame.velocity[order]
    return corrupt(
        agent.sweep, settings, rng, SceneVelocities(agent.speed * forward, frame.truth.object_id[order], velocity)
    )


def _firing_offsets(sweep: Sweep) -> NDArray[np.float32]:
    """Return (P,) firing times relative to the reference time, s."""
    spec = sweep.spec
    if sweep.time_offset.any():
        return sweep.time_offset
    if spec is not None and not spec.prisms and (len(sweep) <= spec.rings or sweep.column.any()):
        share = (sweep.column % spec.columns + 0.5) / spec.columns - 0.5
        return (share * spec.period_s).astype(np.float32)
    period_s = DEFAULT_PERIOD_S if spec is None else spec.period_s
    return np.arctan2(sweep.points[:, 1], sweep.points[:, 0]) * np.float32(period_s / (2.0 * np.pi))


def _vibration(
    settings: MotionBlur, hertz: NDArray[np.float64], phase: NDArray[np.float64], time_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (T, 4, 4) vibration at (T,) times; axes: three of translation, then three of rotation."""
    sines = np.sin(2.0 * np.pi * hertz[..., None] * time_s + phase[..., None]) * np.sqrt(2.0 / _SINES)
    rotation = np.radians(settings.shake_deg_s) * (sines[3:] / (2.0 * np.pi * hertz[3:, :, None])).sum(axis=1)
    return _poses(settings.shake_m * sines[:3].sum(axis=1).T, rotation.T)


def _uncompensated(
    sweep: Sweep,
    settings: MotionBlur,
    velocities: SceneVelocities,
    time_s: NDArray[np.float64],
    shake: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return (T, 4, 4) delivered_from_true transforms of points that fire at (T,) times."""
    # SciPy takes half a second to import, which most users of the registry need not wait for.
    from scipy.spatial.transform import Rotation

    if sweep.path is None:
        translation, rotation = velocities.sensor * time_s[:, None], np.zeros((len(time_s), 3))
    else:
        now = sweep.path.at(np.array([sweep.time_s]))
        true = invert(now) @ sweep.path.at(sweep.time_s + time_s)
        translation, rotation = true[:, :3, 3], Rotation.from_matrix(true[:, :3, :3]).as_rotvec()
    believed = 1.0 - settings.missed_motion
    return _poses(believed * translation, believed * rotation) @ shake @ invert(_poses(translation, rotation))


def _poses(translation: NDArray[np.float64], rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (T, 4, 4) poses of (T, 3) positions and (T, 3) rotation vectors."""
    from scipy.spatial.transform import Rotation

    poses = np.tile(np.eye(4), (len(translation), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    poses[:, :3, 3] = translation
    return poses


def _displacement(
    points: NDArray[np.float32], change: NDArray[np.float32], step: NDArray[np.intp]
) -> NDArray[np.float32]:
    """Return (P, 3) displacement of points by (T, 4, 4) transforms less the identity, selected by `step` (P,)."""
    x, y, z = np.ascontiguousarray(points.T)
    moved = np.zeros_like(points)
    for axis in range(3):
        by_x, by_y, by_z, by = (change[:, axis, term].take(step) for term in range(4))
        moved[:, axis] = by_x * x + by_y * y + by_z * z + by
    return moved


def _object_velocities(sweep: Sweep, velocities: SceneVelocities) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return (M,) rows of points on moving objects and their (M, 3) velocities in the sensor frame, m/s."""
    moving = velocities.velocity.any(axis=1)
    ids = velocities.object_id[moving]
    on = np.flatnonzero(sweep.object_id >= 0) if len(ids) else np.zeros(0, np.intp)
    if len(on) == 0:
        return on, np.zeros((0, 3))
    slot = np.minimum(np.searchsorted(ids, sweep.object_id[on]), len(ids) - 1)
    hit = ids[slot] == sweep.object_id[on]
    return on[hit], (velocities.velocity[moving] @ sweep.world_from_lidar[:3, :3])[slot[hit]]
