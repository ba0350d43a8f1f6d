"""Clock offset: sweeps of collaborators older than their timestamps.

| severity                          | 1  | 2  | 3   | 4   | 5   |
|-----------------------------------|----|----|-----|-----|-----|
| mean delay of the sweep, ms       | 20 | 50 | 100 | 200 | 400 |

100 ms is the delay of V2X-ViT's noisy setting (Xu et al., ECCV 2022), 400 ms the longest of its experiments. Each
agent's delay is the level times a factor from U(0.5, 1.5) that stays for the drive.

A sweep with timestamp t, measured at t - d, shows the scene of t - d from the pose of t. With P(t) the agent's true
path and v the velocity of a point's surface,

    p' = inv(P(t - d)) (P(t) p - v d)        in the sensor frame; the reported pose is that of the timestamp, P(t)

so houses run ahead with a moving agent by its own displacement during d, a car that drives beside it stays right, and
for a roadside unit only moving objects are displaced. Beyond its ends, or where it is unknown, the path is extrapolated
straight on, and objects keep their velocity. Approximation: surfaces hidden at t - d and visible at t keep their
points. Ground truth is that of t. The ego has no delay: its clock is the reference.
"""

from dataclasses import replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.levels import SeveritySettings
from sensors.deskew import deskew
from sensors.frame import AgentFrame, Frame
from sensors.motion import Path
from sensors.sweep import MOVED, SCATTERED, Sweep
from sim.geometry import invert

_SPREAD = 0.5
_STILL_M = 1e-4


class ClockOffset(SeveritySettings, frozen=True, kw_only=True):
    """Settings of `in_frame`.

    Attributes:
        late_ms: delay of a sweep, mean over agents, ms.
    """

    LEVELS: ClassVar = {"late_ms": (20.0, 50.0, 100.0, 200.0, 400.0)}
    RANGES: ClassVar = {"late_ms": (0.0, 10_000.0)}

    late_ms: float = 100.0


def in_frame(frame: Frame, row: int, settings: ClockOffset, rng: np.random.Generator) -> Sweep:
    """Return the delayed sweep of the agent in a row of the frame, under its current timestamp.

    Args:
        rng: of the agent, restarted for every frame of a drive.
    """
    late_s = 1e-3 * settings.late_ms * rng.uniform(1.0 - _SPREAD, 1.0 + _SPREAD)
    agent = frame.agents[row]
    if late_s == 0.0 or len(agent.sweep) == 0:
        return agent.sweep
    if agent.sweep.motion == "raw":
        known = replace(agent, sweep=deskew(agent.sweep, "middle"))
        return deskew(_delayed(frame, known, late_s), "raw")
    return _delayed(frame, agent, late_s)


def _delayed(frame: Frame, agent: AgentFrame, late_s: float) -> Sweep:
    sweep = agent.sweep
    path = sensor_path(agent)
    then, now = extrapolate(path, sweep.time_s - np.array([late_s, 0.0]))
    velocity = np.append(frame.velocity, [[0.0, 0.0]], axis=0)[_owners(frame, sweep)]  # the last row: on no object
    shift = velocity @ sweep.world_from_lidar[:2, :3] * late_s
    then_from_now = invert(then) @ now
    points = (sweep.points.astype(np.float64) - shift) @ then_from_now[:3, :3].T + then_from_now[:3, 3]
    moved = np.linalg.norm(points - sweep.points, axis=1) > _STILL_M
    earlier = Path.through(path.time_s, extrapolate(path, path.time_s - late_s))
    return replace(
        sweep,
        points=np.where(moved[:, None], points, sweep.points).astype(np.float32),
        fate=np.where(moved & (sweep.fate != SCATTERED), MOVED, sweep.fate).astype(np.uint8),
        path=None if sweep.path is None else earlier,
    )


def sensor_path(agent: AgentFrame) -> Path:
    """Return the sensor's path; where it is unknown, straight on at the agent's speed and heading."""
    sweep = agent.sweep
    if sweep.path is not None:
        return sweep.path
    times = np.array([-1.0, 1.0])
    poses = np.repeat(sweep.world_from_lidar[None], 2, axis=0)
    poses[:, :3, 3] += times[:, None] * agent.speed * agent.world_from_body[:3, 0]
    return Path.through(sweep.time_s + times, poses)


def extrapolate(path: Path, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (T, 4, 4) poses at (T,) times, extrapolated straight on beyond both ends of the path."""
    first, last = path.time_s[[0, -1]]
    reach_s = max(first - time_s.min(), time_s.max() - last, 0.0) + 1.0
    times = np.concatenate([[first - reach_s], path.time_s, [last + reach_s]])
    xyz, angles = (_extrapolate_values(values, path.time_s, reach_s) for values in (path.xyz, path.angles))
    return Path(times, xyz, angles).at(time_s)


def _extrapolate_values(
    values: NDArray[np.float64], time_s: NDArray[np.float64], reach_s: float
) -> NDArray[np.float64]:
    """Return (K + 2, 3) the values (K, 3) with an extrapolated one on either side."""
    slope = np.diff(values, axis=0) / np.diff(time_s)[:, None]
    return np.concatenate([[values[0] - slope[0] * reach_s], values, [values[-1] + slope[-1] * reach_s]])


def _owners(frame: Frame, sweep: Sweep) -> NDArray[np.intp]:
    """Return (P,) the row of each point's object in `frame.truth`, -1 for none.

    By the points' object ids; in files without ids by the boxes that contain the points.
    """
    truth = frame.truth
    if len(truth) == 0:
        return np.full(len(sweep), -1)
    if (sweep.object_id >= 0).any():
        row = np.minimum(np.searchsorted(truth.object_id, sweep.object_id), len(truth) - 1)
        return np.where(truth.object_id[row] == sweep.object_id, row, -1)
    inside = truth.contains(sweep.world_points)
    return np.where(inside.any(axis=0), inside.argmax(axis=0), -1)
