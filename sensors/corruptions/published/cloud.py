"""Clouds of x, y, z, intensity, the format of published models, and conversion from and to sweeps.

Published code draws from numpy's legacy generator. Every function here takes either kind, and draws in the published
order where that costs nothing, so `numpy.random.RandomState(1205)` gives what the release gives with that seed.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensors.sweep import ADDED, KEPT, SCATTERED, UNKNOWN_MATERIAL, Sweep

Cloud = NDArray[np.floating]
"""(P, 4) x, y, z in m and intensity; further columns are unchanged unless a model says otherwise."""

RandomSource = np.random.Generator | np.random.RandomState
"""Random generator, new or legacy."""


def cloud_of(sweep: Sweep) -> NDArray[np.float64]:
    """Return the (P, 4) cloud of a sweep, intensity in [0, 1]."""
    cloud = np.zeros((len(sweep), 4))
    cloud[:, :3] = sweep.points
    cloud[:, 3] = sweep.intensity
    return cloud


def with_cloud(sweep: Sweep, cloud: Cloud, fate: NDArray[np.integer]) -> Sweep:
    """Return the sweep with the rows of a cloud, intensities clipped to [0, 1].

    Args:
        cloud: (P, 4).
        fate: (P,) of each point; `SCATTERED` points belong to no object and stay so, `KEPT` keeps the earlier fate.
    """
    added = fate == SCATTERED
    return replace(
        sweep,
        points=cloud[:, :3].astype(np.float32),
        intensity=np.clip(cloud[:, 3], 0.0, 1.0).astype(np.float32),
        object_id=np.where(added, ADDED, sweep.object_id).astype(np.int32),
        material=np.where(added, UNKNOWN_MATERIAL, sweep.material).astype(np.uint8),
        cosine=np.where(added, 0.0, sweep.cosine).astype(np.float32),
        fate=np.where((fate == KEPT) | (sweep.fate == SCATTERED), sweep.fate, fate).astype(np.uint8),
    )


def with_rows(sweep: Sweep, rows: NDArray[np.integer], cloud: Cloud) -> Sweep:
    """Return the sweep with some points replaced by points on no surface, intensities clipped to [0, 1].

    Args:
        sweep: of P points; the others are unchanged.
        rows: (K,) rows of the points, each at most once.
        cloud: (K, 4) replacement.
    """
    new = {
        "points": cloud[:, :3],
        "intensity": np.clip(cloud[:, 3], 0.0, 1.0),
        "object_id": ADDED,
        "material": UNKNOWN_MATERIAL,
        "cosine": 0.0,
        "fate": SCATTERED,
    }
    columns: dict[str, Any] = {name: getattr(sweep, name).copy() for name in new}
    for name, values in new.items():
        columns[name][rows] = values
    return replace(sweep, **columns)
