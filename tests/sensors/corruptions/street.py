"""Sweeps to corrupt: an analytic street, the synthetic golden clouds, points on one ray."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from sensors.corruptions.published import snow
from sensors.corruptions.published.snow_discs import disc_sample
from sensors.spec import LidarSpec
from sensors.sweep import POINT_FIELDS, Sweep, make_sweep
from tests.paths import GOLDENS, ROOT

FIXTURES = GOLDENS / "corruptions"
SHARED = ROOT.parent / "shared" / "goldens" / "corruptions"


def spinning(rings: int = 64, columns: int = 360, **changes: object) -> LidarSpec:
    """A LiDAR of any number of rings, without noise."""
    elevation = tuple(np.linspace(3.0, -25.0, rings))
    settings = {"range_10_m": 120.0, "range_noise_m": 0.0, **changes}
    return LidarSpec(name="test", elevation_deg=elevation, columns=columns, **settings)  # type: ignore[arg-type]


def street(spec: LidarSpec | None = None) -> Sweep:
    """A road between two house fronts, seen from 1.9 m above it; reflectivities vary along it."""
    spec = spec or spinning()
    elevation, azimuth = np.meshgrid(spec.elevation, spec.azimuth, indexing="ij")
    across = np.cos(elevation)
    ray = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)], -1)
    with np.errstate(divide="ignore"):
        walls = np.where(ray[..., 1] > 0, 9.0, -14.0) / ray[..., 1]
        road = np.where(ray[..., 2] < 0, -1.9 / ray[..., 2], np.inf)
    reach = np.minimum(np.minimum(np.abs(walls), road), 1e6)
    ring, column = np.nonzero(reach < spec.range_max_m)
    points = (ray * reach[..., None])[ring, column]
    intensity = 0.05 + 0.5 * np.sin(points[:, 0] * 3.0 + points[:, 2] * 5.0) ** 4
    return make_sweep(
        points, spec=spec, intensity=intensity, ring=ring, column=column, time_offset=spec.time_offset[ring, column]
    )


def on_a_ray(reach: np.ndarray, intensity: np.ndarray | float = 1.0, spec: LidarSpec | None = None) -> Sweep:
    """Points at these ranges, all in one slanting direction."""
    direction = np.array([0.8, 0.6, -0.05]) / np.linalg.norm([0.8, 0.6, -0.05])
    return make_sweep(np.outer(reach, direction), spec=spec, intensity=np.full(len(reach), intensity, np.float32))


def synth16() -> Sweep:
    """The 16-ring golden cloud."""
    return _cloud(FIXTURES / "synth16.npz")


def synth64() -> Sweep:
    """The 64-ring golden cloud; the test is skipped where it is absent."""
    return _cloud(shared("inputs/synth64.npz"))


@contextmanager
def few_discs() -> Iterator[None]:
    """Two samples of discs for all channels of published snow: 64 for each severity take seconds to draw."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(snow, "disc_sample", lambda s, v, law, index: disc_sample(s, v, law, index % 2))
        yield


def shared(name: str) -> Path:
    """A large golden that is kept beside the repository; the test is skipped where it is absent."""
    if not (SHARED / name).exists():
        pytest.skip(f"golden {name} is not here")
    return SHARED / name


def _cloud(path: Path) -> Sweep:
    data = np.load(path)
    return make_sweep(data["xyz"], intensity=data["intensity"], ring=data["ring"])


def same(a: Sweep, b: Sweep) -> bool:
    """Equality of the points of two sweeps, to the byte."""
    return all(getattr(a, name).tobytes() == getattr(b, name).tobytes() for name in POINT_FIELDS)


def rows_of(part: Sweep, whole: Sweep) -> np.ndarray:
    """Rows of `whole` that the points of `part` were, by ring and column."""
    key = whole.ring.astype(np.int64) * 100_000 + whole.column
    order = np.argsort(key)
    return order[np.searchsorted(key[order], part.ring.astype(np.int64) * 100_000 + part.column)]
