"""deskew: how the sensor's own motion during a sweep is compensated, changed with the true path; nothing is lost.

A beam that fires at t measures in the sensor frame at t. Those are raw points: a still world is bent by the sensor's
way during the sweep. A point is compensated to a reference time r by

    p_r = inv(world_from_lidar(r)) world_from_lidar(t) p_t

with t its own firing time. Drivers of sensors do this with odometry; here the path is the true one. `Sweep.motion` says
which r it is: the middle of the sweep (ours, ground truth boxes are of that instant), its start or its end (the header
of a message carries one of them as a rule), or none (raw).

Only the sensor's motion can be compensated without knowing what was hit. An object that moves with velocity v is
sheared: its points lie v (t - r) away from where they were at r. `deskew_objects` takes that back with the objects'
true paths.
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
    """Return the same measurements with the sensor's motion compensated otherwise.

    Points in the world, their firing times `time_s + time_offset` and all other columns stay; start and end move
    `time_s` and `world_from_lidar` along the path. Back and forth gives the same points but for rounding (float32).

    Args:
        sweep: any sweep, compensated or raw.
        to: the motion wanted.

    Raises:
        DataError: the sweep doesn't know its path, its firing times or, for start and end, the sensor's period.
        SettingsError: there is no such motion.
    """
    check_motion(to)
    if to == sweep.motion:
        return sweep
    # Asked for here already, so that no sweep comes out whose points do not say when they were measured.
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
    """Return the frame with all sweeps given as `to`; boxes and velocities stay those of the frame's time.

    Raises:
        DataError: an agent's sweep cannot be given so; the message names the agent.
        SettingsError: there is no such motion.
    """
    sweeps = []
    for agent in frame.agents:
        try:
            sweeps.append(deskew(agent.sweep, to))
        except DataError as error:
            raise DataError(f"frame {frame.index}: agent {agent.agent_id}: {error}") from None
    return frame.with_sweeps(sweeps)


def deskew_objects(sweep: Sweep, object_id: NDArray[np.integer], path: Path) -> Sweep:
    """Return the sweep with every object put together as it stood at `time_s`: the shear of moving objects undone.

    No sensor can do that: it takes the ground truth of who was hit and how it moved. Points of object k go rigidly with
    it from where it was at their firing, so they are moved by -v (t - r) if it drives straight. Points on anything else
    stay, and firing times too: applying it twice is wrong.

    Args:
        sweep: any sweep; raw points stay raw.
        object_id: (N,) ids, each once.
        path: of N bodies over the sweep: `RayScene.bodies.path`, or `coasting` where only velocities are known.

    Raises:
        DataError: the sweep doesn't know its firing times, a path ends before the sweep does, or the points are raw and
            the sensor's path is unknown.
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


def coasting(velocity: NDArray[np.floating], time_s: float, reach_s: float = 0.1) -> Path:
    """Return paths of bodies that keep their velocity and heading, for `deskew_objects`.

    Where the bodies are doesn't matter as long as none turns, so their places at `time_s` are taken as zero.

    Args:
        velocity: (N, 2) or (N, 3) in the world, m/s.
        time_s: an instant of the sweep, s.
        reach_s: the paths go so far before and after it, s.
    """
    velocity = np.asarray(velocity, np.float64)
    away = reach_s * np.array([-1.0, 1.0])
    xyz = np.zeros((len(velocity), 2, 3))
    xyz[:, :, : velocity.shape[1]] = velocity[:, None] * away[:, None]
    return Path(time_s + away, xyz, np.zeros_like(xyz))


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
