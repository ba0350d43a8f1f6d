"""Spray: plumes of drops behind vehicles on a wet road, which attenuate targets and return echoes.

| severity                                | 1    | 2    | 3    | 4    | 5    |
|-----------------------------------------|------|------|------|------|------|
| water on the road, mm                   | 0.2  | 0.5  | 1    | 1.5  | 2.5  |
| extinction behind a car at 50 km/h, 1/m | 0.04 | 0.09 | 0.18 | 0.27 | 0.44 |

Place and density of the drops follow from the sizes and speeds of the frame's vehicles (`plume`); standing vehicles
have no plume. All agents of a frame share the same plumes and patches, their own included. Along each beam, at range r,

    transmission(r) = exp(-2 * integral of alpha up to r)
    echo(r) = pi / S * integral of alpha * transmission over the pulse's length c tau / 2 around r, over max(r, 10 m)^2

in the units of `receiver`; S = 18.8 sr is the ratio of extinction to backscatter of water drops at 905 nm (O'Connor,
Illingworth and Hogan 2004). Receivers reduce their gain at close range (assumed): nearer than 10 m an echo counts as if
from there, and one weaker than that of a surface of reflectivity 1/255 at its range, the least step of an 8-bit
intensity, is not reported; with a pulse of 10 ns that is an extinction of 0.016 per metre, a visibility of 190 m. The
strongest echo competes with the target as in `medium`: dense spray hides targets behind points on no object, thin spray
only attenuates them. Rays are sampled every 0.8 m or finer, segments of more than 51 m at 64 places. During a sweep
plumes move with their vehicles.

Published LiDAR models: Linnhoff et al. (2022) place clusters of points at rates fitted to one sensor; the spray of
RainyPCSim (Yang et al. 2023) is a particle system of a game engine. Neither gives numbers per severity; these are
assumed; level 5 has as much water as level 5 of wet ground.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.levels import WeatherSettings
from sensors.corruptions.physics.medium import Echo, Rays, open_axis, rays_of, report
from sensors.corruptions.physics.plume import PERIOD_M, Plume, draw_patches, patches_at, plumes_of
from sensors.frame import Frame
from sensors.optics.reflectance import LIGHT_SPEED
from sensors.sweep import Sweep
from sim.geometry import invert
from sim.streams import Stream, random_generator

LIDAR_RATIO_SR = 18.8
"""Extinction over backscatter of water drops, sr."""

DEFAULT_PULSE_S = 1e-8
"""Pulse length of an unknown sensor, s."""

HAZE_REFLECTIVITY = 1.0 / 255.0
"""Least echo, as the reflectivity of a surface at its range; weaker ones are not reported at any range."""

FULL_GAIN_M = 10.0
"""Range of full gain, m: nearer echoes count as if from here."""

_STEP_M = 0.8
_LEAST_WAY_M = 0.05
_MARGIN_M = 0.1
_LEAST_DEPTH = 1e-3
_LEAST_ECHO_DEPTH = 0.99 * HAZE_REFLECTIVITY * LIDAR_RATIO_SR / np.pi
"""Optical depth below which a segment has no reported echo, even if all of it is within one pulse."""
_LEAST_EXTINCTION = 1e-3
_PROBES = 1 << 16


class Spray(WeatherSettings, frozen=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        water_mm: height of the water on the road, mm.
        range_10_m: see `LidarSpec`; None for what `receiver` takes, infinity for one that detects everything.
    """

    LEVELS: ClassVar = {"water_mm": (0.2, 0.5, 1.0, 1.5, 2.5)}
    STRENGTH: ClassVar = ("water_mm",)
    RANGES: ClassVar = {"water_mm": (0.0, 100.0)}

    water_mm: float = 1.0
    range_10_m: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _WorldRays:
    """L rays in the world frame.

    Attributes:
        origin: (3,) of all of them, m.
        direction: (3, L) float32 unit vectors.
        near, reach: (L,) float32 nearest reported range and range of the target, m.
        lag_s: (L,) float32 firing time after the frame's time, s.
        pulse_m: length of the pulse in range.
        by_azimuth: (L,) rays sorted by their azimuth in the world.
        azimuth: (L,) float32 the azimuths, ascending, rad.
    """

    origin: NDArray[np.float64]
    direction: NDArray[np.float32]
    near: NDArray[np.float32]
    reach: NDArray[np.float32]
    lag_s: NDArray[np.float32]
    pulse_m: float
    by_azimuth: NDArray[np.intp]
    azimuth: NDArray[np.float32]


def corrupt(frame: Frame, row: int, spray: Spray, rng: np.random.Generator) -> Sweep:
    """Return the sweep of the agent in a row of `frame.agents` in the spray of the frame's vehicles.

    Args:
        frame: gives the vehicles' boxes and velocities.
        rng: in the same state for all agents and frames of a drive, which share the patches.
    """
    agent = frame.agents[row]
    patches = draw_patches(rng)
    own = random_generator(int(rng.integers(2**63)), Stream.SPRAY_NOISE, frame.index, agent.agent_id)
    plumes = plumes_of(frame, spray.water_mm)
    if not plumes:
        return agent.sweep
    rays = rays_of(agent.sweep, spray.range_10_m, own)
    world_rays = _world_rays(frame, rays)
    plumes.sort(key=lambda plume: float(np.linalg.norm(plume.world_from_plume[:3, 3] - world_rays.origin)))
    depth, strongest, place = np.zeros(len(rays)), np.zeros(len(rays)), np.zeros(len(rays))
    jitter = rays.draw(own.random)
    for plume in plumes:
        _add_plume(plume, patches, world_rays, jitter, depth, strongest, place)
    count = len(agent.sweep)
    return report(rays, np.exp(-2.0 * depth[:count]), Echo(place, strongest))


def _world_rays(frame: Frame, rays: Rays) -> _WorldRays:
    sweep, spec, count = rays.sweep, rays.sweep.spec, len(rays.sweep)
    turn = sweep.world_from_lidar[:3, :3].astype(np.float32)
    toward = np.concatenate([sweep.points, open_axis(rays)]).T.astype(np.float32)
    # Products by hand: threads of a matrix product this thin wait longer than they compute.
    direction = np.stack([row[0] * toward[0] + row[1] * toward[1] + row[2] * toward[2] for row in turn])
    direction[:, :count] /= np.maximum(rays.reach[:count], 1e-6).astype(np.float32)
    lag_s = (sweep.time_s - frame.time_s) + sweep.time_offset.astype(np.float64)
    azimuth = np.arctan2(direction[1], direction[0])
    by_azimuth = np.argsort(azimuth)
    later = np.zeros(0) if spec is None else spec.time_offset[rays.open_ring, rays.open_column]
    return _WorldRays(
        origin=sweep.world_from_lidar[:3, 3],
        direction=direction,
        near=rays.near.astype(np.float32),
        reach=rays.reach.astype(np.float32),
        lag_s=np.concatenate([lag_s, later]).astype(np.float32),
        pulse_m=0.5 * LIGHT_SPEED * (DEFAULT_PULSE_S if spec is None else spec.pulse_s),
        by_azimuth=by_azimuth,
        azimuth=azimuth[by_azimuth],
    )


def _add_plume(
    plume: Plume,
    patches: NDArray[np.float32],
    world_rays: _WorldRays,
    jitter: NDArray[np.float64],
    depth: NDArray[np.float64],
    strongest: NDArray[np.float64],
    place: NDArray[np.float64],
) -> None:
    """Add depth and echoes of one plume to L rays, nearer plumes first.

    Args:
        jitter: (L,) uniform in [0, 1): sample position within a step.
        depth: (L,) optical depth so far, added to.
        strongest: (L,) power of the strongest echo so far, updated.
        place: (L,) range of it, m.
    """
    segments = _segments_of(plume, world_rays)
    fineness = np.clip(np.ceil(np.log2(segments.span / _STEP_M)), 2, 6).astype(np.intp)
    for power_of_two in range(2, 7):
        some = np.flatnonzero(fineness == power_of_two)
        steps = 1 << power_of_two
        for part in np.split(some, range(_PROBES // steps, len(some), _PROBES // steps)):
            segment = segments[part]
            row = segment.ray_row
            passed, along = _sample_depth(plume, patches, world_rays, segment, jitter[row].astype(np.float32), steps)
            met = passed.sum(axis=1)
            audible = np.flatnonzero(met >= _LEAST_ECHO_DEPTH)
            _update_echoes(
                segment[audible], passed[audible], along[audible], world_rays.pulse_m, depth, strongest, place
            )
            depth[row] += np.where(met >= _LEAST_DEPTH, met, 0.0)


def _update_echoes(
    segment: "_Segments",
    passed: NDArray[np.float32],
    along: NDArray[np.float32],
    pulse_m: float,
    depth: NDArray[np.float64],
    strongest: NDArray[np.float64],
    place: NDArray[np.float64],
) -> None:
    """Update `strongest` and `place` (L,) with the strongest echoes of N segments of (N, K) steps."""
    row, steps = segment.ray_row, passed.shape[1]
    echoes = _echo(passed, depth[row].astype(np.float32), pulse_m * steps / segment.span)
    power = echoes / np.maximum(along, np.float32(FULL_GAIN_M)) ** 2
    best = power.argmax(axis=1)
    each = np.arange(len(row))
    stronger = power[each, best] > strongest[row]
    strongest[row[stronger]] = power[each, best][stronger]
    place[row[stronger]] = along[each, best][stronger]


@dataclass(frozen=True, slots=True, eq=False)
class _Segments:
    """N segments of rays inside a plume.

    Attributes:
        ray_row: (N,) row of the ray.
        origin, direction: (3, N) float32 origins, m, and unit vectors of the rays in the plume's frame.
        first, span: (N,) float32 range of entry and length of the segment, m.
    """

    ray_row: NDArray[np.intp]
    origin: NDArray[np.float32]
    direction: NDArray[np.float32]
    first: NDArray[np.float32]
    span: NDArray[np.float32]

    def __getitem__(self, rows: NDArray[np.intp]) -> "_Segments":
        return _Segments(
            self.ray_row[rows], self.origin[:, rows], self.direction[:, rows], self.first[rows], self.span[rows]
        )


def _segments_of(plume: Plume, world_rays: _WorldRays) -> _Segments:
    plume_from_world = invert(plume.world_from_plume)
    start = (plume_from_world[:3, :3] @ world_rays.origin + plume_from_world[:3, 3]).astype(np.float32)
    turn, bounds = plume_from_world[:3, :3].astype(np.float32), plume.bounds.astype(np.float32)
    ray_row = _rays_toward(plume, start[:2], world_rays)
    first, last = world_rays.near[ray_row], world_rays.reach[ray_row]
    # Across the plume first: leaves the fewest rays.
    found = {}
    for axis in (1, 0, 2):
        x, y, z = world_rays.direction[:, ray_row]
        slope = turn[axis, 0] * x + turn[axis, 1] * y + turn[axis, 2] * z
        slope[np.abs(slope) < 1e-9] = 1e-9
        at = np.full(len(ray_row), start[axis])
        if axis == 0:
            # The plume moves with its vehicle: in its frame rays fired later start farther back.
            at += np.float32(plume.speed) * world_rays.lag_s[ray_row]
        one, other = (bounds[0, axis] - at) / slope, (bounds[1, axis] - at) / slope
        first = np.maximum(first, np.minimum(one, other))
        last = np.minimum(last, np.maximum(one, other))
        kept = np.flatnonzero(last - first > _LEAST_WAY_M)
        ray_row, first, last = ray_row[kept], first[kept], last[kept]
        found[axis] = at, slope
        for before, (begin, rate) in found.items():
            found[before] = begin[kept], rate[kept]
    return _Segments(
        ray_row=ray_row,
        origin=np.stack([found[axis][0] for axis in range(3)]),
        direction=np.stack([found[axis][1] for axis in range(3)]),
        first=first,
        span=last - first,
    )


def _rays_toward(plume: Plume, start: NDArray[np.float32], world_rays: _WorldRays) -> NDArray[np.intp]:
    """Return the few rays, in their order, whose azimuth leads to a plume.

    Args:
        start: (2,) origin of all rays in its frame, m.
    """
    everything = np.arange(len(world_rays.reach))
    if len(everything) == 0:
        return everything
    run = plume.speed * np.array([world_rays.lag_s.max(), world_rays.lag_s.min()])
    bounds = plume.bounds[:, :2] - np.stack([run, [0.0, 0.0]], axis=1) + [[-_MARGIN_M], [_MARGIN_M]]
    if ((bounds[0] <= start) & (start <= bounds[1])).all():
        return everything
    corners = (np.stack(np.meshgrid(*bounds.T), axis=-1).reshape(4, 2) - start) @ plume.world_from_plume[:2, :2].T
    middle = np.arctan2(*corners.mean(axis=0)[::-1])
    aside = np.mod(np.arctan2(corners[:, 1], corners[:, 0]) - middle + np.pi, 2.0 * np.pi) - np.pi
    found = []
    for turn in (-2.0 * np.pi, 0.0, 2.0 * np.pi):
        limits = middle + turn + np.array([aside.min(), aside.max()])
        begin, end = np.searchsorted(world_rays.azimuth, limits.astype(np.float32))
        found.append(world_rays.by_azimuth[begin:end])
    return np.sort(np.concatenate(found))


def _sample_depth(
    plume: Plume,
    patches: NDArray[np.float32],
    world_rays: _WorldRays,
    segment: _Segments,
    jitter: NDArray[np.float32],
    steps: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return (N, K) optical depth of each step and (N, K) its sampled range, m.

    Args:
        jitter: (N,) sample position within a step, as a share of it.
    """
    step = (segment.span / np.float32(steps))[:, None]
    along = segment.first[:, None] + step * (np.arange(steps, dtype=np.float32) + jitter[:, None])
    x, y, z = (
        begin[:, None] + along * rate[:, None] for begin, rate in zip(segment.origin, segment.direction, strict=True)
    )
    dense = plume.mean_extinction(x, y, z)
    dense[dense < np.float32(_LEAST_EXTINCTION)] = 0.0
    found = np.nonzero(dense)
    # World coordinates are large: patches are sampled relative to a near origin.
    nearby = np.mod(world_rays.origin, PERIOD_M).astype(np.float32)[:, None]
    dense[found] *= patches_at(
        patches, plume, nearby + along[found] * world_rays.direction[:, segment.ray_row[found[0]]]
    )
    return dense * step, along


def _echo(
    passed: NDArray[np.float32], before: NDArray[np.float32], pulse_steps: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return (N, K) echo of each step as the reflectivity of a surface there; 0 below the least reported.

    Args:
        passed: (N, K) optical depth of each step.
        before: (N,) optical depth before the plume.
        pulse_steps: (N,) length of the pulse in steps.
    """
    left = np.exp(np.float32(-2.0) * (before[:, None] + np.cumsum(passed, axis=1) - np.float32(0.5) * passed))
    echoes = np.float32(np.pi / LIDAR_RATIO_SR) * _over_pulse(passed * left, pulse_steps)
    return np.where(echoes >= np.float32(HAZE_REFLECTIVITY), echoes, np.float32(0.0))


def _over_pulse(echoes: NDArray[np.float32], steps: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (N, K) sums of (N, K) echoes over a pulse of (N,) steps around each step."""
    count = echoes.shape[1]
    total = np.zeros((len(echoes), count + 1), np.float32)
    np.cumsum(echoes, axis=1, out=total[:, 1:])

    def until(place: NDArray[np.float32]) -> NDArray[np.float32]:
        place = np.clip(place, np.float32(0.0), np.float32(count))
        low = np.minimum(place.astype(np.intp), count - 1)
        part = place - low.astype(np.float32)
        return np.asarray(np.take_along_axis(total, low, 1) + part * np.take_along_axis(echoes, low, 1))

    middle = np.arange(count, dtype=np.float32) + np.float32(0.5)
    half = np.float32(0.5) * steps[:, None]
    return until(middle + half) - until(middle - half)
