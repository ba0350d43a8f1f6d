"""Deskewing: compensation of the sensor's own motion during a sweep, lossless, by the true path.

A beam that fires at t measures in the sensor frame at t. Those are raw points: a static world is bent by the sensor's
motion during the sweep. A point is compensated to a reference time r by

    p_r = inv(world_from_lidar(r)) world_from_lidar(t) p_t

with t its own firing time. Sensor drivers do this with odometry; here the path is the true one. `Sweep.motion` names
r: the middle of the sweep (the default, the instant of the ground-truth boxes), its start or end (the usual time stamp
of a message), or raw.

An object that moves with velocity v is still sheared: its points lie v (t - r) away from their places at r.
`deskew_objects` undoes that with the objects' true paths.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sensors.frame import Frame
from sensors.motion import Path
from sensors.sweep import MOTIONS, Motion, Sweep, firing_poses, firing_times, moved, path_at, path_of
from sim.errors import DataError, SettingsError, complaint, did_you_mean
from sim.geometry import invert, transform_points

_SIDE = {"start": -1.0, "middle": 0.0, "end": 1.0, "raw": 0.0}
"""Reference time within the sweep, in halves of its duration from the middle."""


def check_motion(motion: str) -> None:
    """Raise SettingsError unless this is one of `MOTIONS`."""
    if motion not in MOTIONS:
        raise SettingsError(complaint("LiDAR", "motion", "a compensation", motion, did_you_mean(motion, MOTIONS)))


def deskew(sweep: Sweep, to: Motion) -> Sweep:
    """Return the same measurements with another compensation of the sensor's motion.

    Points in the world, their firing times `time_s + time_offset` and all other columns stay; start and end move
    `time_s` and `world_from_lidar` along the path. Back and forth gives the same points up to rounding (float32).

    Args:
        sweep: any sweep, compensated or raw.

    Raises:
        DataError: path, firing times or, for start and end, the sensor are unknown.
        SettingsError: unknown motion.
    """
    check_motion(to)
    if to == sweep.motion:
        return sweep
    # Checked in all cases, so that no deskewed sweep lacks its firing times.
    path_of(sweep), firing_times(sweep)
    points = sweep.compensated_points
    shift = _reference_s(sweep, to) - _reference_s(sweep, sweep.motion)
    if shift != 0.0:
        sweep, points = _referred(sweep, points, shift)
    if to == "raw":
        poses, row = firing_poses(sweep)
        points = moved(invert(poses)[row], points)
    return replace(sweep, points=points.astype(np.float32), motion=to)


def deskew_frame(frame: Frame, to: Motion) -> Frame:
    """Return the frame with all sweeps deskewed to `to`; boxes and velocities stay those of the frame's time.

    Raises:
        DataError: an agent's sweep cannot be deskewed; the message names the agent.
        SettingsError: unknown motion.
    """
    sweeps = []
    for agent in frame.agents:
        try:
            sweeps.append(deskew(agent.sweep, to))
        except DataError as error:
            raise DataError(f"frame {frame.index}: agent {agent.agent_id}: {error}") from None
    return frame.with_sweeps(sweeps)


def deskew_objects(sweep: Sweep, object_id: NDArray[np.integer], path: Path) -> Sweep:
    """Return the sweep with the shear of moving objects undone: every object as it stood at `time_s`.

    This takes ground truth (object of each point, paths) that no sensor has. Points of object k move rigidly with it
    from its pose at their firing, by -v (t - r) if it drives straight. All other points and the firing times stay:
    applying it twice is wrong.

    Args:
        sweep: any sweep; raw points stay raw.
        object_id: (N,) ids, each once.
        path: of N bodies over the sweep: `RayScene.bodies.path`.

    Raises:
        DataError: firing times are unknown, a path is shorter than the sweep, or the points are raw and the sensor's
            path is unknown.
    """
    times, row = firing_times(sweep)
    world_from_reference = sweep.world_from_lidar
    points = np.asarray(transform_points(world_from_reference, sweep.compensated_points))
    for body, key in enumerate(object_id):
        on = sweep.object_id == key
        if on.any():
            met, which = np.unique(row[on], return_inverse=True)
            world_from_body = path_at(path[body], np.append(times[met], sweep.time_s), f"object {key}")
            back = world_from_body[-1] @ invert(world_from_body[:-1])
            points[on] = moved(back[which], points[on])
    points = np.asarray(transform_points(invert(world_from_reference), points))
    if sweep.motion == "raw":
        poses, row = firing_poses(sweep)
        points = moved(invert(poses)[row], points)
    return replace(sweep, points=points.astype(np.float32))


def _referred(sweep: Sweep, points: NDArray[np.float64], shift_s: float) -> tuple[Sweep, NDArray[np.float64]]:
    """Return the sweep and its compensated points (P, 3) with the reference time moved."""
    now, then = path_at(path_of(sweep), sweep.time_s + np.array([0.0, shift_s]))
    now_from_then = invert(now) @ then
    sweep = replace(
        sweep,
        world_from_lidar=sweep.world_from_lidar @ now_from_then,
        time_s=sweep.time_s + shift_s,
        time_offset=(sweep.time_offset.astype(np.float64) - shift_s).astype(np.float32),
    )
    return sweep, np.asarray(transform_points(invert(now_from_then), points))


def _reference_s(sweep: Sweep, motion: Motion) -> float:
    """Return the reference time of a motion, s after the middle of the sweep."""
    if _SIDE[motion] == 0.0:
        return 0.0
    if sweep.spec is None:
        raise DataError(complaint("sweep", "spec", f"a sensor, to know the {motion} of its sweep", "none"))
    return _SIDE[motion] * 0.5 * sweep.spec.columns * sweep.spec.column_s
