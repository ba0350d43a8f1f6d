"""Figures of one sweep that tell a real street from a simulated one.

A figure is a sample of numbers: a value per point, per vehicle or per cell, or a single share. Points on the carrier
and beyond `REACH_M` are left out; the ground is that of `dsrc.ops.ground`; what stands is more than 0.3 m above it.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dsrc.data.points_in_boxes import points_in_boxes
from dsrc.ops.ground import Ground, fit_ground
from sensors.corruptions.physics.rings import rings_of
from sensors.frame import Frame
from sensors.sweep import Sweep
from sim.boxes import Boxes
from sim.errors import DataError
from sim.geometry import invert

REACH_M = 60.0
QUANTILES = np.linspace(0.0, 1.0, 101)
"""Quantiles by which a large sample is kept."""

_NEAREST_M = 2.5
_LOWEST_M = -12.0
_CARRIER_M = (2.6, 1.2)
"""Half length and half width of the carrier around the sensor."""
_STANDS_M = 0.3
BANDS_M = ((5.0, 15.0), (15.0, 30.0), (30.0, 50.0))
_MARGIN_M = 0.1
"""Margin of the boxes whose points are a road user's."""
_AROUND_M, _FEWEST_AROUND = 0.5, 8
"""Neighbourhood of a point whose shape is looked at, and its fewest points."""
_LOOKED_AT = 2000
_SCATTERED, _PLANE = 0.06, 0.01
"""Share of the smallest eigenvalue of a neighbourhood above which it is leaf-like, and below which it is a plane."""
_FEWEST_ON_VEHICLE = 5
_REFERENCE_M = 20.0
_EIGHTHS, _FULLEST = 8, 0.9
"""Groups of beams, and the quantile of points per beam that counts as a full one."""
_FEWEST = 20
"""Fewest points of a share or a distribution."""


@dataclass(frozen=True, slots=True)
class FigureOf:
    """A figure.

    Attributes:
        name: its key.
        family: figures of one kind are summed up in one number.
        title: what it is, for people.
        unit: of its numbers; "" for shares.
    """

    name: str
    family: str
    title: str
    unit: str = ""


FIGURES = (
    *(FigureOf(f"returns_{k}", "beams", f"returns, beams {k + 1}/8") for k in range(8)),
    FigureOf("elevation", "beams", "elevation", "deg"),
    FigureOf("range", "range", "range", "m"),
    *(FigureOf(f"standing_{low:.0f}", "roadside", f"standing, {low:.0f}-{high:.0f} m") for low, high in BANDS_M),
    FigureOf("scattered", "roadside", "leaf-like, 5-30 m"),
    FigureOf("slope", "ground", "slope"),
    FigureOf("residual", "ground", "residual", "m"),
    FigureOf("bottom", "ground", "vehicle bottom", "m"),
    FigureOf("length", "vehicles", "length", "m"),
    FigureOf("width", "vehicles", "width", "m"),
    FigureOf("height", "vehicles", "height", "m"),
    FigureOf("points", "vehicles", "log10 points at 20 m"),
    FigureOf("intensity_vehicle", "intensity", "vehicles"),
    FigureOf("intensity_ground", "intensity", "ground"),
    FigureOf("intensity_standing", "intensity", "standing"),
    FigureOf("noise", "noise", "off planes", "m"),
)
"""All figures, those of a family one after the other."""

FAMILIES = tuple(dict.fromkeys(one.family for one in FIGURES))

BEAMS = "beams"
"""Name of the number of beams in samples, which is no figure."""

Samples = dict[str, NDArray[np.float64]]
"""Samples by the names of figures; those that a sweep does not have are absent."""


def figures_of(sweep: Sweep, boxes: Boxes, seed: int = 0) -> Samples:
    """Return the figures of one sweep.

    Args:
        sweep: of an upright sensor; intensities on the sensor's own scale, 0 to 1.
        boxes: road users in the sensor's frame; none where nobody labelled them.
        seed: of the points whose neighbourhoods are looked at.
    """
    points = sweep.points.astype(np.float64)
    away = np.hypot(points[:, 0], points[:, 1])
    carrier = (np.abs(points[:, 0]) < _CARRIER_M[0]) & (np.abs(points[:, 1]) < _CARRIER_M[1])
    kept = ~carrier & (away > _NEAREST_M) & (away < REACH_M) & (points[:, 2] > _LOWEST_M)
    samples = _beams(sweep[np.isfinite(points).all(axis=1) & (away > 0.0)])
    if kept.any():
        scene = _Scene.of(points[kept], sweep.intensity[kept].astype(np.float64), boxes)
        samples["range"] = np.linalg.norm(scene.points, axis=1)
        samples |= _roadside(scene, seed) | _ground(scene) | _vehicles(scene) | _intensities(scene)
    return {name: _few(sample) for name, sample in samples.items() if len(sample)}


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """P points of a sweep and what they lie on.

    Attributes:
        points: (P, 3) float64, m.
        intensity: (P,).
        away: (P,) distance from the sensor in the plane, m.
        height: (P,) above the ground, m.
        flat: (P,) on the ground.
        stands: (P,) above it, road users left out.
        ground: below the sweep.
        boxes: road users.
        pairs: rows of points and of the boxes that they lie in.
    """

    points: NDArray[np.float64]
    intensity: NDArray[np.float64]
    away: NDArray[np.float64]
    height: NDArray[np.float64]
    flat: NDArray[np.bool_]
    stands: NDArray[np.bool_]
    ground: Ground
    boxes: Boxes
    pairs: tuple[NDArray[np.intp], NDArray[np.intp]]

    @classmethod
    def of(cls, points: NDArray[np.float64], intensity: NDArray[np.float64], boxes: Boxes) -> Self:
        ground = fit_ground(points, REACH_M)
        height = points[:, 2] - ground.at(points)
        pairs = points_in_boxes(boxes, points.astype(np.float32), margin=_MARGIN_M)
        place = ground.knows(points)
        place[pairs[0]] = False
        away = np.hypot(points[:, 0], points[:, 1])
        flat, stands = place & (np.abs(height) < _STANDS_M), place & (height > _STANDS_M)
        return cls(points, intensity, away, height, flat, stands, ground, boxes, pairs)


def _roadside(scene: _Scene, seed: int) -> Samples:
    """Return shares of what stands, of what is leaf-like in it, and the scatter about planes."""
    samples: Samples = {}
    for low, high in BANDS_M:
        band = (scene.away > low) & (scene.away < high) & (scene.flat | scene.stands)
        if band.sum() >= _FEWEST:
            samples[f"standing_{low:.0f}"] = np.array([scene.stands[band].mean()])
    middle = (scene.away > BANDS_M[0][0]) & (scene.away < BANDS_M[1][1])
    standing = _shapes(scene.points[scene.stands & middle], seed)
    if len(standing):
        samples["scattered"] = np.array([(standing[:, 0] > _SCATTERED).mean()])
    shapes = _shapes(scene.points[(scene.stands | scene.flat) & middle], seed)
    samples["noise"] = shapes[shapes[:, 0] < _PLANE, 1]
    return samples


def _ground(scene: _Scene) -> Samples:
    """Return slopes and residual of the ground."""
    ground = scene.ground
    slope = np.hypot(*np.gradient(np.where(ground.known, ground.heights, np.nan), ground.cell_m))
    near = scene.flat & (scene.away < _REFERENCE_M)
    residual = [scene.height[near].std()] if near.sum() >= _FEWEST else []
    return {"slope": slope[np.isfinite(slope)], "residual": np.array(residual)}


def _vehicles(scene: _Scene) -> Samples:
    """Return sizes, bottoms and points of the vehicles that have a few points."""
    boxes, (_, rows) = scene.boxes, scene.pairs
    counts = np.bincount(rows, minlength=len(boxes))
    seen = boxes.is_vehicle & (counts >= _FEWEST_ON_VEHICLE)
    boxes, counts = boxes[seen], counts[seen]
    below = scene.ground.at(np.zeros((1, 2)))[0]
    away = np.hypot(boxes.center[:, 0], boxes.center[:, 1])
    return {
        **dict(zip(("length", "width", "height"), boxes.size.T, strict=True)),
        "bottom": boxes.center[:, 2] - 0.5 * boxes.size[:, 2] - below,
        "points": np.log10(counts * np.maximum(away / _REFERENCE_M, 1e-3) ** 2),
    }


def _intensities(scene: _Scene) -> Samples:
    """Return intensities of vehicles, of the ground and of what stands; none of a cloud that has one alone."""
    if np.ptp(scene.intensity) == 0.0:
        return {}
    on_vehicle = np.zeros(len(scene.points), bool)
    points, rows = scene.pairs
    on_vehicle[points[scene.boxes.is_vehicle[rows]]] = True
    classes = {"vehicle": on_vehicle, "ground": scene.flat, "standing": scene.stands}
    return {f"intensity_{name}": scene.intensity[on] for name, on in classes.items() if on.sum() >= _FEWEST}


def sweeps_of(frame: Frame) -> list[tuple[Sweep, Boxes]]:
    """Return each vehicle's sweep in a frame, and the boxes of all others in the sensor's frame, for `figures_of`."""
    return [
        (
            agent.sweep,
            frame.truth[frame.truth.object_id != agent.agent_id].transform(invert(agent.sweep.world_from_lidar)),
        )
        for agent in frame.agents
        if agent.kind == "vehicle"
    ]


def _beams(sweep: Sweep) -> Samples:
    """Return elevations, and points of each eighth of the beams as a share of the fullest beams'.

    The shares are left out where neither file nor sensor tells the beams and elevations don't either.
    """
    if len(sweep) == 0:
        return {}
    away = np.hypot(sweep.points[:, 0], sweep.points[:, 1])
    samples: Samples = {"elevation": np.degrees(np.arctan2(sweep.points[:, 2], away))}
    try:
        rings = rings_of(sweep, "realism")
    except DataError:
        return samples
    samples[BEAMS] = np.array([rings.count], np.float64)
    if rings.count >= _EIGHTHS:
        counts = np.bincount(rings.ring, minlength=rings.count)
        full = max(np.quantile(counts, _FULLEST), 1.0)
        for k, eighth in enumerate(np.array_split(counts, _EIGHTHS)):
            samples[f"returns_{k}"] = np.minimum(eighth / full, 1.0).mean(keepdims=True)
    return samples


def _shapes(points: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Return (K, 2) share of the smallest eigenvalue and its root, m, of the neighbourhoods of some points."""
    if len(points) < _FEWEST_AROUND:
        return np.zeros((0, 2))
    chosen = np.random.default_rng(seed).choice(len(points), min(_LOOKED_AT, len(points)), replace=False)
    around = cKDTree(points).query_ball_point(points[chosen], _AROUND_M)
    around = [rows for rows in around if len(rows) >= _FEWEST_AROUND]
    if not around:
        return np.zeros((0, 2))
    near, counts = points[np.concatenate(around)], np.array([len(rows) for rows in around])
    starts = np.cumsum(counts) - counts
    mean = np.add.reduceat(near, starts) / counts[:, None]
    near -= mean.repeat(counts, axis=0)
    spread = np.add.reduceat(near[:, :, None] * near[:, None], starts) / (counts - 1)[:, None, None]
    values = np.linalg.eigvalsh(spread)
    least = np.maximum(values[:, 0], 0.0)
    return np.column_stack([least / np.maximum(values.sum(axis=1), 1e-9), np.sqrt(least)])


def _few(sample: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return a sample, or its quantiles where it is large."""
    return np.asarray(sample if len(sample) <= len(QUANTILES) else np.quantile(sample, QUANTILES), np.float64)
