"""Points of a sweep as drawn: subsampling and colours, and which of them a corruption removed."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsrc.review.palette import FATE_COLORS, LOOKS, TURBO, VIRIDIS, Rgb, ramp
from dsrc.review.state import ColorBy, Theme
from sensors.sweep import ADDED, Sweep

FLOAT16_LIMIT_M = 1000.0
"""Greatest coordinate that is drawn, m: the wire format is float16, with steps of 0.5 m there."""


HEIGHT_M = (-0.5, 8.0)
"""Heights above the road between which points are coloured by height, m."""
RANGE_M = 100.0
"""Distance at the end of the scale of ranges, m."""
RETURNS = 3
"""Return at the end of the scale of returns."""
GROUND_M = 0.35
"""Height above the road below which points are faint, m."""


def subsample(sweep: Sweep, max_points: int) -> NDArray[np.intp]:
    """Rows of at most `max_points` points, ascending.

    Points on actors come first. Of the rest whole rings are left out and the others thinned along the ring by
    distance, so that the dense ground beside the sensor pays for the far field and the pattern of rings stays.
    """
    # No comparison with NaN is true, so these drop points that are not finite as well. Most sweeps pass at once.
    if len(sweep) and sweep.points.max() < FLOAT16_LIMIT_M and sweep.points.min() > -FLOAT16_LIMIT_M:
        drawable = np.ones(len(sweep), bool)
    else:
        near = np.abs(sweep.points) < FLOAT16_LIMIT_M
        drawable = near[:, 0] & near[:, 1] & near[:, 2]
    count = int(drawable.sum())
    if count <= max_points:
        return np.flatnonzero(drawable)
    on_actor = drawable & (sweep.object_id >= 0)
    actors, left = np.flatnonzero(on_actor), drawable ^ on_actor
    if len(actors) > max_points // 2:
        actors = actors[np.linspace(0, len(actors) - 1, max_points // 2).astype(np.intp)]
    budget = max_points - len(actors)
    every = max(int(np.sqrt((count - int(on_actor.sum())) / max(budget, 1)) + 0.5), 1)
    if every > 1:
        in_kept_rings = left & (sweep.ring % np.int16(every) == 0)
        left = in_kept_rings if in_kept_rings.sum() >= budget else left
    others = np.flatnonzero(left)
    if len(others) > budget:
        points = sweep.points.take(others, axis=0)
        # A norm of numpy takes six times as long.
        far = np.sqrt(np.einsum("ij,ij->i", points, points))
        others = others[_strided(np.maximum(far, 1.0), budget)]
    chosen = np.zeros(len(sweep), bool)
    chosen[actors] = chosen[others] = True
    return np.flatnonzero(chosen)


def _strided(far: NDArray[np.floating], budget: int) -> NDArray[np.intp]:
    """Rows of every k-th point, k falling with the distance `far` (P,), within the budget."""
    # How many a reach keeps is known well enough from a histogram: searched in all points it takes 40 ms per sweep.
    nearest, farthest = float(far.min()), float(far.max())
    edges = np.linspace(nearest, farthest, 257)
    # A histogram of numpy takes five times as long.
    scale = np.float32(256.0 / max(farthest - nearest, 1e-6))
    count = np.bincount(np.minimum((far - np.float32(nearest)) * scale, 255.0).astype(np.uint8), minlength=256)
    middle = np.maximum(0.5 * (edges[1:] + edges[:-1]), 1e-3)
    low, high = 0.0, farthest * (len(far) / max(budget, 1) + 1.0)
    for _ in range(20):
        reach = 0.5 * (low + high)
        kept = float((count / np.ceil(np.maximum(reach / middle, 1.0))).sum())
        low, high = (reach, high) if kept > budget else (low, reach)
    every = np.ceil(np.maximum(np.float32(high) / far, np.float32(1.0))).astype(np.int32)
    rows = np.flatnonzero(np.arange(len(far), dtype=np.int32) % every == 0)
    # The few too many that the histogram leaves are taken from everywhere, not from the end.
    return rows if len(rows) <= budget else rows[np.linspace(0, len(rows) - 1, budget).astype(np.intp)]


def point_colors(
    sweep: Sweep,
    color_by: ColorBy,
    agent_rgb: Rgb,
    height_of: NDArray[np.float64],
    rows: NDArray[np.intp] | None = None,
    theme: Theme = "light",
) -> NDArray[np.uint8]:
    """(P, 3) uint8 colours of the points.

    Args:
        height_of: (4,) third row of body_from_lidar: sensors may be tilted.
        rows: of the points that are drawn; None for all.
        theme: whose ground the points of the ground fade into.
    """
    chosen = slice(None) if rows is None else rows
    if color_by in _SCALES:
        values, low, high = _SCALES[color_by](sweep, chosen, height_of)
        return ramp(values, low, high, VIRIDIS if color_by == "intensity" else TURBO)
    if color_by == "object":
        ids = sweep.object_id[chosen]
        # Steps of the golden ratio keep neighbours in the list of ids apart.
        colors = ramp(np.modf(0.618034 * (ids % 1000))[0], 0.0, 1.0, TURBO)
        return np.where((ids >= 0)[:, None], colors, np.array(LOOKS[theme].faded, np.uint8)).astype(np.uint8)
    if color_by == "fate":
        table = np.array([FATE_COLORS[f] for f in sorted(FATE_COLORS)], np.uint8)
        return table.take(np.minimum(sweep.fate[chosen], len(table) - 1), axis=0)
    rgb = LOOKS[theme].ink if color_by == "verdict" else agent_rgb
    points, ids = sweep.points, sweep.object_id
    if rows is not None:  # faster than an index
        points, ids = points.take(rows, axis=0), ids.take(rows)
    return _shade(_height(points, height_of), ids, rgb, LOOKS[theme].faded)


Scale = tuple[NDArray[np.floating], float, float]
"""Values of points, and those of the ends of the scale."""


def _of_ring(sweep: Sweep, chosen: Any, _: NDArray[np.float64]) -> Scale:
    rings = sweep.spec.rings if sweep.spec is not None else int(sweep.ring.max(initial=0)) + 1
    return sweep.ring[chosen].astype(np.float64), 0.0, max(rings - 1, 1)


def _of_time(sweep: Sweep, chosen: Any, _: NDArray[np.float64]) -> Scale:
    return sweep.time_offset[chosen], float(sweep.time_offset.min(initial=0)), float(sweep.time_offset.max(initial=0))


_SCALES: dict[str, Callable[[Sweep, Any, NDArray[np.float64]], Scale]] = {
    # A square root spreads the dark materials that make most of a street.
    "intensity": lambda sweep, chosen, _: (np.sqrt(np.clip(sweep.intensity[chosen], 0.0, 1.0)), 0.0, 1.0),
    "height": lambda sweep, chosen, height_of: (_height(sweep.points[chosen], height_of), *HEIGHT_M),
    "ring": _of_ring,
    "time": _of_time,
    "range": lambda sweep, chosen, _: (np.linalg.norm(sweep.points[chosen], axis=1), 0.0, RANGE_M),
    "return": lambda sweep, chosen, _: (sweep.return_number[chosen].astype(np.float64), 1.0, RETURNS),
    "incidence": lambda sweep, chosen, _: (sweep.cosine[chosen], 0.0, 1.0),
}


def _height(points: NDArray[np.float32], height_of: NDArray[np.float64]) -> NDArray[np.float32]:
    """(P,) heights above the road, m."""
    return np.asarray(points @ height_of[:3].astype(np.float32) + np.float32(height_of[3]), np.float32)


def _shade(height_m: NDArray[np.floating], object_id: NDArray[np.integer], rgb: Rgb, faded: Rgb) -> NDArray[np.uint8]:
    """Fade the ground and the buildings, so that road users stand out of one colour."""
    strength = np.array([[0.12], [0.35], [1.0]])
    # In bytes: all points of all agents are shaded in every frame.
    level = np.maximum(height_m > GROUND_M, 2 * (object_id >= 0).view(np.int8)).astype(np.intp)
    table = np.round(np.array(faded) + strength * (np.array(rgb, np.float64) - np.array(faded))).astype(np.uint8)
    return table.take(level, axis=0)


def lost_rows(recorded: Sweep, corrupted: Sweep) -> NDArray[np.intp]:
    """Rows of the recorded sweep whose points a corruption removed, ascending.

    An untouched point has the same coordinates. A displaced one is found by its beam, and where the recording has no
    columns it is taken for the nearest point that is missing.
    """
    after = corrupted[corrupted.object_id != ADDED]
    missing = np.flatnonzero(~np.isin(_bits(recorded.points), _bits(after.points)))
    displaced = after[~np.isin(_bits(after.points), _bits(recorded.points))]
    if len(missing) == 0 or len(displaced) == 0:
        return missing
    if recorded.column.any():
        return missing[~np.isin(_beams(recorded)[missing], _beams(displaced))]
    # Imported where it is needed: it is not, before a page's first picture.
    from scipy.spatial import cKDTree

    nearest = cKDTree(recorded.points[missing]).query(displaced.points)[1]
    stays = np.ones(len(missing), bool)
    stays[nearest] = False
    return missing[stays]


def _bits(points: NDArray[np.float32]) -> NDArray[np.uint64]:
    """(P,) one number for the coordinates of each point; equal points have equal ones."""
    # Adding zero makes one of the two zeros.
    bits = np.ascontiguousarray(points + np.float32(0.0)).view(np.uint32).astype(np.uint64)
    mixed = bits[:, 0] * np.uint64(0x9E3779B97F4A7C15)
    mixed ^= bits[:, 1] * np.uint64(0xC2B2AE3D27D4EB4F)
    return mixed ^ (bits[:, 2] * np.uint64(0x165667B19E3779F9))


def _beams(sweep: Sweep) -> NDArray[np.int64]:
    """(P,) one number for the ring, the column and the place among the returns of each point."""
    beam = sweep.ring.astype(np.int64) << 40 | sweep.column.astype(np.int64) << 8
    return beam | sweep.return_number
