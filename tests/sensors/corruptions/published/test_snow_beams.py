"""Shares of beams as published."""

import numpy as np
import pytest

from sensors.corruptions.published.snow_beams import Shares, shares_of
from tests.sensors.corruptions.published.goldens import arrays


def one(discs: list[tuple[float, float, float]], azimuth: float = 1.0, target: float = 50.0) -> Shares:
    """Discs by range, offset from the beam's axis and half width in beam widths of 0.1 rad."""
    rows = [
        (r * np.cos(azimuth + 0.1 * offset), r * np.sin(azimuth + 0.1 * offset), r * np.sin(0.1 * half))
        for r, offset, half in discs
    ]
    return shares_of(np.array([azimuth]), np.array([target]), np.array(rows).reshape(-1, 3), 0.1)


@pytest.mark.parametrize("case", [0, 1])
def test_shares_of_discs_are_those_of_the_release(case: int) -> None:
    golden = {
        name.removesuffix(f"_{case}"): a for name, a in arrays("snow_occlusion").items() if name.endswith(f"_{case}")
    }
    right, left = golden["beams"].T
    azimuth = right + 0.5 * np.mod(left - right, 2 * np.pi)
    found = shares_of(azimuth, golden["ranges"], golden["particles"], np.radians(golden["div_deg"]))
    rank = np.arange(len(found.beam)) - np.searchsorted(found.beam, found.beam)
    ours = {
        (b, r): (m, s) for b, r, m, s in zip(*found[:1], rank, found.range_m, found.share, strict=True) if s > 1e-12
    }
    ours |= {(b, -1): (golden["ranges"][b], share) for b, share in enumerate(found.target) if share > 1e-12}
    theirs = {
        (b, r): (m, s)
        for b, r, (m, s) in zip(golden["beam_index"], golden["particle_index"], golden["range_ratio"], strict=True)
        if s > 1e-12
    }
    assert ours.keys() == theirs.keys()
    assert all(np.allclose(ours[key], theirs[key], rtol=0, atol=1e-9) for key in theirs)


def test_a_beam_of_its_own_is_the_target_s() -> None:
    found = one([])
    assert len(found.beam) == 0 and found.target.tolist() == [1.0]


def test_the_nearest_disc_owns_the_overlap() -> None:
    found = one([(20.0, 0.1, 0.2), (10.0, 0.0, 0.2)])
    assert np.allclose(found.range_m, [10.0, 20.0])
    assert np.allclose(found.share, [0.4, 0.1]) and np.allclose(found.target, 0.5)


def test_only_what_is_in_the_beam_and_before_the_target_counts() -> None:
    found = one([(10.0, 0.5, 0.1), (10.0, 0.7, 0.1), (60.0, 0.0, 0.1)])
    assert np.allclose(found.share, [0.1]) and np.allclose(found.target, 0.9)


def test_hidden_discs_have_no_share() -> None:
    found = one([(10.0, 0.0, 0.3), (20.0, 0.1, 0.1)])
    assert np.allclose(found.share, [0.6, 0.0]) and np.allclose(found.target, 0.4)


def test_beams_across_azimuth_0_keep_the_target_whole_as_released() -> None:
    discs = [(10.0, -0.3, 0.1), (20.0, 0.2, 0.1)]
    released, elsewhere = one(discs, 0.0), one(discs, 1.0)
    assert np.allclose(released.target, 1.0) and np.allclose(elsewhere.target, 0.6)
    assert np.allclose(released.share, elsewhere.share)
    straddling = one([(10.0, 0.0, 0.1)], 0.0)
    assert np.allclose(straddling.target, 0.8)


def test_many_discs_share_a_beam_whole() -> None:
    rng = np.random.default_rng(1)
    reach, angle = rng.uniform(1, 60, 3000), rng.uniform(-np.pi, np.pi, 3000)
    discs = np.column_stack([reach * np.cos(angle), reach * np.sin(angle), rng.uniform(0, 0.05, 3000)])
    found = shares_of(np.linspace(0.03, 2 * np.pi - 0.03, 500), np.full(500, 40.0), discs, 0.05)
    assert np.allclose(np.bincount(found.beam, found.share, 500) + found.target, 1.0, atol=1e-9)
    assert found.share.min() >= 0.0 and found.target.min() >= 0.0
    order = np.lexsort((found.range_m, found.beam))
    assert (order == np.arange(len(order))).all()
