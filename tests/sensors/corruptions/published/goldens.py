"""Outputs of the published code on the synthetic clouds, and comparison with them."""

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.sensors.corruptions.street import FIXTURES

RANGE_BINS_M = (0.0, 10.0, 20.0, 40.0, 80.0, 120.0, np.inf)


def arrays(name: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of a golden file."""
    with np.load(FIXTURES / f"{name}.npz") as data:
        return dict(data)


def table(name: str) -> dict[str, Any]:
    """Return a golden table."""
    return dict(json.loads((FIXTURES / f"{name}.json").read_text()))


def cloud(name: str) -> NDArray[np.float32]:
    """Return (P, 4) of `synth16` or `synth64`."""
    data = arrays(name)
    return np.column_stack([data["xyz"], data["intensity"]])


def mask(packed: NDArray[np.uint8], points: int) -> NDArray[np.bool_]:
    """Return (points,) bits."""
    return np.unpackbits(packed)[:points].astype(bool)


def by_range(points: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the number of points in each of `RANGE_BINS_M`."""
    return np.histogram(np.linalg.norm(points[:, :3].astype(np.float32), axis=1), RANGE_BINS_M)[0]


def agrees(ours: list[Any], theirs: dict[str, Any], errors: float = 3.0, seeds: int = 20) -> bool:
    """Return whether means over seeds agree within `errors` standard errors, nulls aside.

    Args:
        ours: one value or list of values per seed.
        theirs: golden `mean` and `std`, over `seeds` seeds.
        errors: standard errors of the difference.
        seeds: of the golden.
    """
    mine = np.array(ours, np.float64)
    mean, std = np.array(theirs["mean"], np.float64), np.array(theirs["std"], np.float64)
    known = np.isfinite(mean) & np.isfinite(mine).all(axis=0)
    error = np.sqrt(mine.std(axis=0) ** 2 / len(mine) + std**2 / seeds)
    # The tables have six digits.
    return bool((np.abs(mine.mean(axis=0) - mean) <= errors * error + 1e-5 * np.abs(mean))[known].all())


def equals(ours: list[Any], theirs: dict[str, Any], tolerance: float = 1e-5) -> bool:
    """Return whether mean and spread over the same seeds equal the golden's to its digits, nulls aside."""
    mine = np.array(ours, np.float64)
    for found, key in ((mine.mean(axis=0), "mean"), (mine.std(axis=0), "std")):
        expected = np.array(theirs[key], np.float64)
        if not np.isclose(found, expected, rtol=1e-5, atol=tolerance)[np.isfinite(expected)].all():
            return False
    return True
