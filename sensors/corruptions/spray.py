"""Spray: vehicles on a wet road draw plumes of drops behind them, which dim what lies behind and answer themselves.

| severity                                | 1    | 2    | 3    | 4    | 5    |
|-----------------------------------------|------|------|------|------|------|
| water on the road, mm                   | 0.2  | 0.5  | 1    | 1.5  | 2.5  |
| extinction behind a car at 50 km/h, 1/m | 0.04 | 0.09 | 0.18 | 0.27 | 0.44 |

Where the drops are and how many, says `plume`: it takes the vehicles of the frame, their sizes and their speeds, and
vehicles that stand still make none. All agents of a frame see the same plumes and the same patches in them, their own
ones included. Along each beam, at range r,

    transmission(r) = exp(-2 * integral of alpha up to r)
    echo(r) = pi / S * integral of alpha * transmission over the pulse's length c tau / 2 around r, over max(r, 10 m)^2

in the units of `receiver`; S = 18.8 sr is the ratio of extinction to backscatter of water drops at 905 nm (O'Connor,
Illingworth and Hogan 2004). Receivers lower their sensitivity at close range, or every haze would be a wall (assumed):
nearer than 10 m an echo counts no more than from there, and one weaker than that of a surface of reflectivity 1/255 at
its range, the least step of an 8-bit intensity, is not reported; with a pulse of 10 ns that is an extinction of 0.016
per metre, a visibility of 190 m. The strongest echo competes with the target as in `medium`: dense spray buries what is
behind it under points on no object, thin spray only dims it. Rays are probed every 0.8 m or more finely, on ways of
more than 51 m at 64 places. During a sweep plumes move on with their vehicles.

What published LiDAR models do instead: Linnhoff et al. (2022) place clusters of points at rates fitted to one sensor;
the spray of RainyPCSim (Yang et al. 2023) are particles of a game engine. Neither gives numbers per severity; these are
chosen; level 5 has as much water as level 5 of wet ground.
"""

from dataclasses import dataclass
from typing import Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.levels import at_level, check_range
from sensors.corruptions.physics.medium import Echo, Sight, look, open_axis, report
from sensors.corruptions.physics.plume import PERIOD_M, Plume, draw_patches, patches_at, plumes_of
from sensors.frame import Frame
from sensors.optics.reflectance import LIGHT_SPEED
from sensors.sweep import Sweep
from sim.geometry import invert

WATER_MM = (0.2, 0.5, 1.0, 1.5, 2.5)

LIDAR_RATIO_SR = 18.8
"""Extinction over backscatter of water drops."""

UNKNOWN_PULSE_S = 1e-8
"""Length of the pulse of a sensor that is not known."""

HAZE_REFLECTIVITY = 1.0 / 255.0
"""Echoes weaker than those of a surface of this reflectivity at their range are not reported, however near they are."""

FULL_GAIN_M = 10.0
"""Receivers hear echoes of nearer haze as if it were so far away."""

_STEP_M = 0.8
_LEAST_WAY_M = 0.05
_MARGIN_M = 0.1
_LEAST_DEPTH = 1e-3
_LEAST_HEARD = 0.99 * HAZE_REFLECTIVITY * LIDAR_RATIO_SR / np.pi
"""Optical depth of a way so thin that no echo from it would be reported, were all of it within one pulse."""
_LEAST_EXTINCTION = 1e-3
_PROBES = 1 << 16


class Spray(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        water_mm: height of the water on the road, mm.
        range_10_m: see `LidarSpec`; None for what `receiver` takes, infinity for one that detects everything.
    """

    water_mm: float = 1.0
    range_10_m: float | None = None

    def __post_init__(self) -> None:
        check_range("Spray", "water_mm", self.water_mm, 0.0, 100.0)

    @classmethod
    def severity(cls, level: int) -> Self:
        """Return the settings of a severity, 1 to 5."""
        return cls(water_mm=at_level(WATER_MM, level))

    def scaled(self, factor: float) -> Self:
        """Return the settings with so many times the water."""
        return msgspec.structs.replace(self, water_mm=factor * self.water_mm)


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """L lines of sight in the world.

    Attributes:
        origin: (3,) of all of them, m.
        direction: (3, L) float32 unit vectors.
        near, reach: (L,) float32 where they begin to be heard and where they end, m.
        lag_s: (L,) float32 when they are fired, after the frame's time.
        pulse_m: length of the pulse in range.
        by_azimuth: (L,) the lines by their azimuth in the world.
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


def corrupt(frame: Frame, row: int, severity: int | Spray, rng: np.random.Generator) -> Sweep:
    """Return the sweep of the agent in a row of `frame.agents` among the spray of the frame's vehicles.

    Args:
        frame: gives the vehicles' boxes and velocities.
        row: of the agent.
        severity: 1 to 5, or the settings.
        rng: in the same state for all agents and frames of a drive: the patches are the drive's.
    """
    spray = severity if isinstance(severity, Spray) else Spray.severity(severity)
    agent = frame.agents[row]
    patches = draw_patches(rng)
    own = np.random.default_rng([int(rng.integers(2**63)), frame.index % 2**32, agent.agent_id % 2**32])
    plumes = plumes_of(frame, spray.water_mm)
    if not plumes:
        return agent.sweep
    sight = look(agent.sweep, spray.range_10_m, own)
    lines = _lines(frame, sight)
    plumes.sort(key=lambda plume: float(np.linalg.norm(plume.world_from_plume[:3, 3] - lines.origin)))
    depth, loudest, place = np.zeros(len(sight)), np.zeros(len(sight)), np.zeros(len(sight))
    jitter = sight.draw(own.random)
    for plume in plumes:
        _add(plume, patches, lines, jitter, depth, loudest, place)
    count = len(agent.sweep)
    return report(sight, np.exp(-2.0 * depth[:count]), Echo(place, loudest))


def _lines(frame: Frame, sight: Sight) -> _Lines:
    sweep, spec, count = sight.sweep, sight.sweep.spec, len(sight.sweep)
    turn = sweep.world_from_lidar[:3, :3].astype(np.float32)
    toward = np.concatenate([sweep.points, open_axis(sight)]).T.astype(np.float32)
    # Sums of products by hand: threads of a matrix product this thin wait for each other longer than they compute.
    direction = np.stack([row[0] * toward[0] + row[1] * toward[1] + row[2] * toward[2] for row in turn])
    direction[:, :count] /= np.maximum(sight.reach[:count], 1e-6).astype(np.float32)
    lag_s = (sweep.time_s - frame.time_s) + sweep.time_offset.astype(np.float64)
    azimuth = np.arctan2(direction[1], direction[0])
    by_azimuth = np.argsort(azimuth)
    later = np.zeros(0) if spec is None else spec.time_offset[sight.open_ring, sight.open_column]
    return _Lines(
        origin=sweep.world_from_lidar[:3, 3],
        direction=direction,
        near=sight.near.astype(np.float32),
        reach=sight.reach.astype(np.float32),
        lag_s=np.concatenate([lag_s, later]).astype(np.float32),
        pulse_m=0.5 * LIGHT_SPEED * (UNKNOWN_PULSE_S if spec is None else spec.pulse_s),
        by_azimuth=by_azimuth,
        azimuth=azimuth[by_azimuth],
    )


def _add(
    plume: Plume,
    patches: NDArray[np.float32],
    lines: _Lines,
    jitter: NDArray[np.float64],
    depth: NDArray[np.float64],
    loudest: NDArray[np.float64],
    place: NDArray[np.float64],
) -> None:
    """Add what one plume does to L lines, after the nearer ones.

    Args:
        plume: the plume.
        patches: of the drive.
        lines: of sight.
        jitter: (L,) uniform in [0, 1): where within a step a line is probed.
        depth: (L,) optical depth so far, added to.
        loudest: (L,) power of the strongest echo so far, raised.
        place: (L,) range of it, m.
    """
    rays = _through(plume, lines)
    fineness = np.clip(np.ceil(np.log2(rays.way / _STEP_M)), 2, 6).astype(np.intp)
    for power_of_two in range(2, 7):
        some = np.flatnonzero(fineness == power_of_two)
        steps = 1 << power_of_two
        for part in np.split(some, range(_PROBES // steps, len(some), _PROBES // steps)):
            ray = rays[part]
            row = ray.line
            passed, along = _probe(plume, patches, lines, ray, jitter[row].astype(np.float32), steps)
            met = passed.sum(axis=1)
            heard = np.flatnonzero(met >= _LEAST_HEARD)
            _hear(ray[heard], passed[heard], along[heard], lines.pulse_m, depth, loudest, place)
            depth[row] += np.where(met >= _LEAST_DEPTH, met, 0.0)


def _hear(
    ray: "_Rays",
    passed: NDArray[np.float32],
    along: NDArray[np.float32],
    pulse_m: float,
    depth: NDArray[np.float64],
    loudest: NDArray[np.float64],
    place: NDArray[np.float64],
) -> None:
    """Raise `loudest` and `place` (L,) to the strongest echoes of N rays, (N, K) of whose steps are given."""
    row, steps = ray.line, passed.shape[1]
    answer = _echo(passed, depth[row].astype(np.float32), pulse_m * steps / ray.way)
    power = answer / np.maximum(along, np.float32(FULL_GAIN_M)) ** 2
    best = power.argmax(axis=1)
    each = np.arange(len(row))
    louder = power[each, best] > loudest[row]
    loudest[row[louder]] = power[each, best][louder]
    place[row[louder]] = along[each, best][louder]


@dataclass(frozen=True, slots=True, eq=False)
class _Rays:
    """N of the lines, on their way through a plume.

    Attributes:
        line: (N,) which.
        origin, direction: (3, N) float32 where they start, m, and unit vectors, in the plume's frame.
        first, way: (N,) float32 range where they enter it, and how far it is from there to where they leave it, m.
    """

    line: NDArray[np.intp]
    origin: NDArray[np.float32]
    direction: NDArray[np.float32]
    first: NDArray[np.float32]
    way: NDArray[np.float32]

    def __getitem__(self, rows: NDArray[np.intp]) -> "_Rays":
        return _Rays(self.line[rows], self.origin[:, rows], self.direction[:, rows], self.first[rows], self.way[rows])


def _through(plume: Plume, lines: _Lines) -> _Rays:
    """Return the lines that pass through a plume."""
    plume_from_world = invert(plume.world_from_plume)
    start = (plume_from_world[:3, :3] @ lines.origin + plume_from_world[:3, 3]).astype(np.float32)
    turn, bounds = plume_from_world[:3, :3].astype(np.float32), plume.bounds.astype(np.float32)
    line = _toward(plume, start[:2], lines)
    first, last = lines.near[line], lines.reach[line]
    # Across the plume first: that leaves the fewest.
    found = {}
    for axis in (1, 0, 2):
        x, y, z = lines.direction[:, line]
        slope = turn[axis, 0] * x + turn[axis, 1] * y + turn[axis, 2] * z
        slope[np.abs(slope) < 1e-9] = 1e-9
        at = np.full(len(line), start[axis])
        if axis == 0:
            # The plume runs ahead with its vehicle: seen from it, lines fired later start farther back.
            at += np.float32(plume.speed) * lines.lag_s[line]
        one, other = (bounds[0, axis] - at) / slope, (bounds[1, axis] - at) / slope
        first = np.maximum(first, np.minimum(one, other))
        last = np.minimum(last, np.maximum(one, other))
        kept = np.flatnonzero(last - first > _LEAST_WAY_M)
        line, first, last = line[kept], first[kept], last[kept]
        found[axis] = at, slope
        for before, (begin, rate) in found.items():
            found[before] = begin[kept], rate[kept]
    return _Rays(
        line=line,
        origin=np.stack([found[axis][0] for axis in range(3)]),
        direction=np.stack([found[axis][1] for axis in range(3)]),
        first=first,
        way=last - first,
    )


def _toward(plume: Plume, start: NDArray[np.float32], lines: _Lines) -> NDArray[np.intp]:
    """Return the lines, in their order, whose azimuth leads to a plume: few of them, so no other is looked at.

    Args:
        plume: the plume.
        start: (2,) where all lines start, in its frame, m.
        lines: of sight.
    """
    everything = np.arange(len(lines.reach))
    if len(everything) == 0:
        return everything
    run = plume.speed * np.array([lines.lag_s.max(), lines.lag_s.min()])
    bounds = plume.bounds[:, :2] - np.stack([run, [0.0, 0.0]], axis=1) + [[-_MARGIN_M], [_MARGIN_M]]
    if ((bounds[0] <= start) & (start <= bounds[1])).all():
        return everything
    corners = (np.stack(np.meshgrid(*bounds.T), axis=-1).reshape(4, 2) - start) @ plume.world_from_plume[:2, :2].T
    middle = np.arctan2(*corners.mean(axis=0)[::-1])
    aside = np.mod(np.arctan2(corners[:, 1], corners[:, 0]) - middle + np.pi, 2.0 * np.pi) - np.pi
    found = []
    for turn in (-2.0 * np.pi, 0.0, 2.0 * np.pi):
        limits = middle + turn + np.array([aside.min(), aside.max()])
        begin, end = np.searchsorted(lines.azimuth, limits.astype(np.float32))
        found.append(lines.by_azimuth[begin:end])
    return np.sort(np.concatenate(found))


def _probe(
    plume: Plume,
    patches: NDArray[np.float32],
    lines: _Lines,
    ray: _Rays,
    jitter: NDArray[np.float32],
    steps: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return (N, K) optical depth of each step and (N, K) the range where it was probed, m.

    Args:
        plume: the plume.
        patches: of the drive.
        lines: all lines.
        ray: N of them.
        jitter: (N,) where within a step they are probed, as a share of it.
        steps: K.
    """
    step = (ray.way / np.float32(steps))[:, None]
    along = ray.first[:, None] + step * (np.arange(steps, dtype=np.float32) + jitter[:, None])
    x, y, z = (begin[:, None] + along * rate[:, None] for begin, rate in zip(ray.origin, ray.direction, strict=True))
    dense = plume.mean_extinction(x, y, z)
    dense[dense < np.float32(_LEAST_EXTINCTION)] = 0.0
    found = np.nonzero(dense)
    # World coordinates are large: the field of patches is asked relative to a place near by.
    nearby = np.mod(lines.origin, PERIOD_M).astype(np.float32)[:, None]
    dense[found] *= patches_at(patches, plume, nearby + along[found] * lines.direction[:, ray.line[found[0]]])
    return dense * step, along


def _echo(
    passed: NDArray[np.float32], before: NDArray[np.float32], pulse_steps: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return (N, K) the echo from each step as the reflectivity of a surface there; 0 where haze is not reported.

    Args:
        passed: (N, K) optical depth of each step.
        before: (N,) optical depth on the way to the plume.
        pulse_steps: (N,) length of the pulse in steps.
    """
    left = np.exp(np.float32(-2.0) * (before[:, None] + np.cumsum(passed, axis=1) - np.float32(0.5) * passed))
    answer = np.float32(np.pi / LIDAR_RATIO_SR) * _over_pulse(passed * left, pulse_steps)
    return np.where(answer >= np.float32(HAZE_REFLECTIVITY), answer, np.float32(0.0))


def _over_pulse(answer: NDArray[np.float32], steps: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (N, K) sums of (N, K) answers over a pulse of (N,) steps around each of them."""
    count = answer.shape[1]
    total = np.zeros((len(answer), count + 1), np.float32)
    np.cumsum(answer, axis=1, out=total[:, 1:])

    def until(place: NDArray[np.float32]) -> NDArray[np.float32]:
        place = np.clip(place, np.float32(0.0), np.float32(count))
        low = np.minimum(place.astype(np.intp), count - 1)
        part = place - low.astype(np.float32)
        return np.asarray(np.take_along_axis(total, low, 1) + part * np.take_along_axis(answer, low, 1))

    middle = np.arange(count, dtype=np.float32) + np.float32(0.5)
    half = np.float32(0.5) * steps[:, None]
    return until(middle + half) - until(middle - half)
