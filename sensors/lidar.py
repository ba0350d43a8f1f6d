"""scan: one rotation of a spinning LiDAR through a scene.

Time: a sweep is centred on its reference time `time_s`; column c fires at `time_s + spec.time_offset[c]`, from half a
rotation before to half a rotation after. Every ray starts at the sensor's pose at its firing and meets every body
where that body is then (rolling shutter of both). Points are given in the sensor frame at `time_s`: the sensor's own
motion is compensated, as drivers do with odometry, so a still world is sharp; what moves is smeared by its motion,
and its ground-truth box at `time_s` sits in the middle of the smear.

Signal: `reflectivity * cos(incidence) ** 0.5 * exp(-2 * extinction * range)`, eight times as much and hardly
dependent on incidence for retro-reflectors, clipped to [0, 1]. Sensors report it calibrated, so 1/range^2 is not in
the intensity; it is in the detection threshold: a return is seen while its signal is at least that of a target of
reflectivity 0.1 at `spec.range_10_m`. The exponent below Lambert's 1 stands for rough road and render surfaces, whose
backscatter falls off slower towards grazing incidence (Oren and Nayar 1994).
"""

import numpy as np
from numpy.typing import NDArray

from sensors.motion import Path
from sensors.scene import Rays, RayScene, Trace
from sensors.spec import LidarSpec
from sensors.sweep import Sweep, make_sweep
from sim.geometry import invert, transform_points
from sim.world.materials import MATERIALS

CLEAR_AIR_EXTINCTION = 2e-4
"""Extinction of clear air, 1/m: a meteorological range of 15 km."""

_INCIDENCE_EXPONENT = 0.5
_RETRO_GAIN = 8.0
_RETRO_EXPONENT = 0.1


def scan(
    scene: RayScene,
    spec: LidarSpec,
    world_from_lidar_start: NDArray[np.float64],
    world_from_lidar_end: NDArray[np.float64],
    time_s: float,
    rng: np.random.Generator,
    exclude_id: int | None = None,
    *,
    world_from_lidar: NDArray[np.float64] | None = None,
) -> Sweep:
    """Scan a scene once.

    Args:
        scene: static world and the bodies around `time_s`.
        spec: the sensor.
        world_from_lidar_start: (4, 4) pose half a rotation before `time_s`.
        world_from_lidar_end: (4, 4) pose half a rotation after.
        time_s: reference time, s.
        rng: noise and drop-off; the same draws whatever the scene, so a ray keeps its noise.
        exclude_id: object that the sensor rides on and cannot see.
        world_from_lidar: (4, 4) pose at `time_s`; half-way between start and end when left out.

    Returns:
        The sweep in the sensor frame at `time_s`, ring by ring from the top, columns ascending.
    """
    path = _sensor_path(spec, world_from_lidar_start, world_from_lidar, world_from_lidar_end, time_s)
    times = time_s + spec.time_offset
    rays = Rays(
        elevation=spec.elevation,
        azimuth=spec.azimuth,
        time_s=times,
        world_from_lidar=path.at(times),
        reach_m=spec.range_max_m,
    )
    trace = scene.trace(rays, exclude_id)
    return _measure(trace, rays, spec, path.at(np.array([time_s]))[0], time_s, rng)


def _sensor_path(spec: LidarSpec, start: NDArray, middle: NDArray | None, end: NDArray, time_s: float) -> Path:
    half = 0.5 * spec.period_s
    if middle is None:
        return Path.through([time_s - half, time_s + half], np.stack([start, end]))
    return Path.through([time_s - half, time_s, time_s + half], np.stack([start, middle, end]))


def _measure(
    trace: Trace, rays: Rays, spec: LidarSpec, pose: NDArray[np.float64], time_s: float, rng: np.random.Generator
) -> Sweep:
    """Turn what the rays met into what the sensor reports."""
    shape = trace.hit.shape
    noise = rng.standard_normal(shape, np.float32) * np.float32(spec.range_noise_m)
    lost_before, lost_after = rng.random((2, *shape), np.float32)

    intensity, seen = _returned_signal(trace, spec)
    measured = trace.distance + noise
    seen &= (trace.distance >= spec.range_min_m) & (measured >= spec.range_min_m) & (measured <= spec.range_max_m)
    seen &= (lost_before >= spec.dropoff_rate) & (lost_after >= drop_chance(intensity, spec))

    flat = np.flatnonzero(seen)
    ring, column = np.divmod(flat, shape[1])
    reach = measured.reshape(-1, 1)[flat].astype(np.float64)
    world = trace.direction.reshape(-1, 3)[flat] * reach + rays.world_from_lidar[column, :3, 3]
    sweep = make_sweep(
        transform_points(invert(pose), world),
        world_from_lidar=pose,
        time_s=time_s,
        spec=spec,
        intensity=intensity.reshape(-1)[flat],
        ring=ring,
        column=column,
        time_offset=spec.time_offset[column],
        object_id=trace.object_id.reshape(-1)[flat],
    )
    # Seen from the reference pose, a point may lie a little beyond the range that the firing pose had.
    within = sweep.range <= spec.range_max_m
    return sweep if within.all() else sweep[within]


def _returned_signal(trace: Trace, spec: LidarSpec) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return (R, C) intensity in [0, 1] and whether the return is strong enough to be detected."""
    gain = np.array([m.reflectivity * (_RETRO_GAIN if m.retro else 1.0) for m in MATERIALS], np.float32)
    retro = np.array([m.retro for m in MATERIALS])
    shine = trace.cosine**_INCIDENCE_EXPONENT
    if retro[trace.material].any():
        shine = np.where(retro[trace.material], trace.cosine**_RETRO_EXPONENT, shine)
    distance = trace.distance
    signal = gain[trace.material] * shine * np.exp(np.float32(-2.0 * CLEAR_AIR_EXTINCTION) * distance)
    threshold = np.float32(0.1 * np.exp(-2.0 * CLEAR_AIR_EXTINCTION * spec.range_10_m) / spec.range_10_m**2)
    seen = trace.hit & (signal >= threshold * distance * distance)
    return np.clip(signal, 0.0, 1.0), seen


def drop_chance(intensity: NDArray[np.float32], spec: LidarSpec) -> NDArray[np.float32]:
    """Return the chance that CARLA's model loses a return: linear from zero intensity up to the limit, then none."""
    if spec.dropoff_intensity_limit <= 0.0:
        return np.zeros_like(intensity)
    share = 1.0 - intensity / np.float32(spec.dropoff_intensity_limit)
    return np.float32(spec.dropoff_zero_intensity) * np.clip(share, 0.0, 1.0)
