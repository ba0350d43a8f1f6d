"""Point dropping: scattered over all beams, or in patches."""

import itertools

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sensors.corruptions.point_dropping import PointDropping, corrupt
from sensors.sweep import Sweep
from sim.errors import SettingsError
from tests.sensors.corruptions.street import same, spinning, street


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def rows_left(out: Sweep, sweep: Sweep) -> np.ndarray:
    key = sweep.ring.astype(np.int64) * 10**6 + sweep.column
    return np.isin(key, out.ring.astype(np.int64) * 10**6 + out.column)


@pytest.mark.parametrize("severity", range(1, 6))
def test_the_share_is_lost_all_over_the_sweep(severity: int) -> None:
    sweep = street(spinning(64, columns=900))
    left = rows_left(corrupt(sweep, PointDropping.severity(severity), rng()), sweep)
    assert 1.0 - left.mean() == pytest.approx(PointDropping.LEVELS["share"][severity - 1], abs=0.005)
    parts = np.array_split(left, 20)
    assert max(abs(1.0 - part.mean() - PointDropping.LEVELS["share"][severity - 1]) for part in parts) < 0.05


@pytest.mark.parametrize("how", ["scattered", "patches"])
def test_kept_points_are_unchanged_and_lost_ones_stay_lost(how: str) -> None:
    sweep = street()
    left = []
    for severity in range(1, 6):
        settings = PointDropping(
            how=how,
            share=PointDropping.LEVELS["share"][severity - 1],
            patches=PointDropping.LEVELS["patches"][severity - 1],
        )
        out = corrupt(sweep, settings, rng())
        left.append(rows_left(out, sweep))
        assert same(out, sweep[left[-1]])
    assert all((a | ~b).all() and a.sum() > b.sum() for a, b in itertools.pairwise(left))


def test_a_patch_is_a_disc_as_the_sensor_sees_it() -> None:
    sweep = street(spinning(64, columns=900))
    left = rows_left(corrupt(sweep, PointDropping(how="patches", patches=1), rng()), sweep)
    assert (~left).sum() == int(0.02 * len(sweep))
    ray = sweep.points / sweep.range[:, None]
    middle = ray[~left].mean(axis=0)
    near = ray @ (middle / np.linalg.norm(middle))
    radius = near[~left].min()
    # Inside nothing is left but at the edge, and the discs of two points of the rim are the same size.
    assert (near[left] < radius + 0.01).all()
    assert np.median(cKDTree(ray[~left]).query(ray[~left], 2)[0][:, 1]) < 0.02


def test_nothing_or_everything_is_dropped_and_no_points() -> None:
    sweep = street()
    assert same(corrupt(sweep, PointDropping(share=0.0), rng()), sweep)
    assert len(corrupt(sweep, PointDropping(share=1.0), rng())) == 0
    assert same(corrupt(sweep, PointDropping(how="patches", patches=0), rng()), sweep)
    assert len(corrupt(sweep[:0], PointDropping(how="patches"), rng())) == 0
    assert len(corrupt(sweep[:1], PointDropping(how="patches"), rng())) == 1
    with pytest.raises(SettingsError, match="share: expected 0 to 1"):
        PointDropping(share=-0.1)
