"""Ring estimates of published code."""

from typing import get_args

import numpy as np
import pytest

from sensors.corruptions.published.rings import RingSource, azimuth_wrap, elevation_bin, k_means, rings_from
from sensors.sweep import make_sweep
from sim.errors import DataError
from tests.sensors.corruptions.published.goldens import arrays, cloud
from tests.sensors.corruptions.street import spinning, street


def test_rings_by_azimuth_are_those_of_the_release() -> None:
    assert (azimuth_wrap(cloud("synth64")) == arrays("rings")["wrap_ring_synth64"]).all()


def test_rings_by_azimuth_need_the_order_of_the_file() -> None:
    points, ring = cloud("synth64"), arrays("synth64")["ring"]
    assert (azimuth_wrap(points[::-1]) == 0).all()
    shuffled = np.random.default_rng(1).permutation(len(points))
    assert (azimuth_wrap(points[shuffled]) == ring[shuffled]).mean() < 0.05


@pytest.mark.parametrize(("columns", "name"), [(4, "elev_channel_synth64"), (3, "elev_channel_xyzdepth_synth64")])
def test_rings_by_elevation_are_those_of_the_release(columns: int, name: str) -> None:
    assert (elevation_bin(cloud("synth64")[:, :columns]) == arrays("rings")[name]).all()


def test_the_intensity_in_the_norm_moves_points_to_other_bins() -> None:
    points = cloud("synth64")
    assert 0.005 < (elevation_bin(points) != elevation_bin(points[:, :3])).mean() < 0.01


def test_clusters_of_elevation_are_the_rings_where_these_stand_apart() -> None:
    data = arrays("synth64")
    order = np.random.default_rng(1).permutation(len(data["ring"]))
    assert (k_means(data["xyz"][order]) == data["ring"][order]).all()


def test_clusters_are_the_best_ones() -> None:
    rng = np.random.default_rng(1)
    elevation = rng.normal(size=400) * 0.1
    points = np.column_stack([np.cos(elevation), np.zeros(400), np.sin(elevation)])
    ring = k_means(points, 5)

    def deviation(label: np.ndarray) -> float:
        return sum(elevation[label == k].var() * (label == k).sum() for k in np.unique(label))

    for _ in range(200):
        bounds = np.sort(rng.choice(elevation, 4, replace=False))
        assert deviation(np.searchsorted(bounds, elevation)) >= deviation(ring)
    means = [elevation[ring == k].mean() for k in range(5)]
    assert (np.diff(means) < 0).all()  # ring 0 is on top


@pytest.mark.parametrize("source", get_args(RingSource))
@pytest.mark.parametrize("points", [0, 1])
def test_hardly_any_points_have_rings_too(source: str, points: int) -> None:
    ring, rings = rings_from(street(spinning())[:points], source, "test")  # type: ignore[arg-type]
    assert len(ring) == points and rings == 64 and (ring < rings).all()


def test_recorded_rings_are_used_on_request() -> None:
    sweep = street(spinning(40, columns=90))
    ring, rings = rings_from(sweep, "sweep", "test")
    assert rings == 40 and (ring == sweep.ring).all()
    with pytest.raises(DataError, match="crosstalk"):
        rings_from(make_sweep(np.random.default_rng(1).normal(size=(500, 3))), "sweep", "crosstalk")
