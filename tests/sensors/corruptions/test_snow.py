"""Snow: flakes, beams, and what is heard."""

import itertools
import json
import math

import numpy as np
import pytest

from sensors.corruptions import snow
from sensors.corruptions.receiver import BLIND_M
from sensors.corruptions.snow import Snow
from sensors.corruptions.snow_beams import Meetings, gather, meet, taken_shares
from sensors.corruptions.snow_flakes import (
    DISC_RADIUS_M,
    Flakes,
    extinction,
    flake_pool,
    flake_rate,
    gunn_marshall_rate,
    occupancy,
)
from sensors.sweep import ADDED, ATTENUATED, KEPT, SCATTERED
from sim.errors import SettingsError
from tests.sensors.corruptions.street import on_a_ray, rows_of, same, shared, spinning, street

DIVERGENCE = 0.003
PAPER = Snow()
MEDIUM = (PAPER.snowfall_mm_h, PAPER.fall_speed_mps, PAPER.flake_density)


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def flakes_of(discs: np.ndarray) -> Flakes:
    """Flakes from rows of x, y, radius."""
    discs = discs[np.argsort(np.hypot(discs[:, 0], discs[:, 1]))]
    reach = np.hypot(discs[:, 0], discs[:, 1])
    return Flakes(
        range_m=reach,
        azimuth=np.mod(np.arctan2(discs[:, 1], discs[:, 0]), 2 * np.pi),
        half_width=np.arcsin(np.minimum(discs[:, 2] / reach, 1.0)),
    )


def test_snow_fills_the_published_share_of_the_air() -> None:
    assert math.isclose(occupancy(0.5, 2.0, 0.1), 6.9444e-7, rel_tol=1e-4)
    assert math.isclose(occupancy(2.5, 1.6, 0.1), 4.3403e-6, rel_tol=1e-4)


def test_flakes_sizes_follow_gunn_and_marshall() -> None:
    assert math.isclose(gunn_marshall_rate(2.2383844962893775), 1732.094288617883, rel_tol=1e-9)
    # The published light snow, which is the paper's setting, has a rate of 17.32 per cm.
    assert math.isclose(flake_rate(0.5, 0.1), 1732.1, rel_tol=0.06)


def test_discs_fill_their_share_of_the_plane_and_are_spread_evenly() -> None:
    pool = flake_pool(*MEDIUM)
    reach = np.concatenate([f.range_m for f in pool])
    radius = reach * np.sin(np.concatenate([f.half_width for f in pool]))
    plane = len(pool) * math.pi * (DISC_RADIUS_M**2 - BLIND_M**2)
    assert math.isclose((math.pi * radius**2).sum() / plane, occupancy(*MEDIUM), rel_tol=0.02)
    counts, _ = np.histogram(reach, np.arange(0, 81, 10))
    assert np.allclose(counts / (np.arange(8) + 0.5), counts.sum() / 32, rtol=0.05)  # density grows as r
    assert reach.min() >= BLIND_M
    azimuth, _ = np.histogram(np.concatenate([f.azimuth for f in pool]), 16, (0, 2 * np.pi))
    assert azimuth.std() / azimuth.mean() < 0.02


@pytest.mark.parametrize("snowfall", [0.1, 0.5, 5.0])
def test_flakes_block_what_their_cross_section_says(snowfall: float) -> None:
    pool, azimuth, reach = flake_pool(snowfall, 2.0, 0.1), np.linspace(-3.1, 3.1, 1500), 60.0
    blocked = 0.0
    for flakes in pool[:20]:
        met = gather([meet(azimuth, np.full(1500, reach), flakes, DIVERGENCE)])
        blocked += np.bincount(met.beam, taken_shares(met, DIVERGENCE), 1500).mean() / 20
    expected = 1.0 - math.exp(-extinction(snowfall, 2.0, 0.1) * (reach - BLIND_M))
    assert math.isclose(blocked, expected, rel_tol=0.08)


def test_more_snow_blocks_more() -> None:
    blocked = [extinction(s, 2.0, 0.1) for s in snow.SNOWFALL_MM_H]
    assert all(a < b for a, b in itertools.pairwise(blocked))


def test_the_nearer_flake_owns_the_overlap() -> None:
    flakes = Flakes(np.array([5.0, 10.0]), np.array([0.0, 0.0005]), np.array([0.0005, 0.0006]))
    met = gather([meet(np.zeros(1), np.array([20.0]), flakes, DIVERGENCE)])
    assert np.allclose(met.range_m, [5.0, 10.0])
    assert np.allclose(taken_shares(met, DIVERGENCE), [1.0 / 3.0, 0.2])  # 0.1 .. 1.1 mrad less what -0.5 .. 0.5 took


def test_flakes_behind_the_target_or_beside_the_beam_take_nothing() -> None:
    flakes = Flakes(np.array([5.0, 10.0]), np.array([0.01, 0.0]), np.array([0.001, 0.001]))
    assert len(meet(np.zeros(1), np.array([8.0]), flakes, DIVERGENCE)) == 0


def test_shares_are_those_of_rays_shot_through_the_beam() -> None:
    generator = rng(3)
    lows = generator.uniform(-0.0015, 0.001, (40, 9))
    met = Meetings(
        beam=np.repeat(np.arange(40), 9),
        range_m=np.tile(np.arange(1.0, 10.0), 40),
        low=lows.ravel(),
        high=np.minimum(lows + generator.uniform(0, 0.001, lows.shape), 0.0015).ravel(),
    )
    rays = np.linspace(-0.0015, 0.0015, 20_001)[:-1] + 0.0015 / 20_000
    inside = (met.low[:, None] <= rays) & (rays < met.high[:, None])
    inside = inside.reshape(40, 9, -1)
    first = inside & (np.cumsum(inside, axis=1) == 1)
    assert np.allclose(taken_shares(met, DIVERGENCE).reshape(40, 9), first.mean(axis=2), atol=1e-3)


def test_shares_are_in_the_unit_interval_and_leave_no_less_than_nothing() -> None:
    azimuth = np.linspace(-np.pi, np.pi, 3000, endpoint=False)
    met = gather([meet(azimuth, np.full(3000, 75.0), flake_pool(5.0, 2.0, 0.1)[0], DIVERGENCE)])
    shares = taken_shares(met, DIVERGENCE)
    assert shares.min() >= 0.0 and shares.max() <= 1.0
    assert np.bincount(met.beam, shares).max() <= 1.0 + 1e-9
    assert len(met) > 3000


def test_beams_across_azimuth_0_and_pi_are_like_the_others() -> None:
    flakes, azimuth, reach = flake_pool(*MEDIUM)[0], np.linspace(-0.05, 0.05, 60), np.full(60, 60.0)
    expected = None
    for turn in (0.0, 1.0, math.pi, 2.0 * math.pi - 0.3, 2.0 * math.pi):
        beams = np.mod(azimuth + turn + np.pi, 2 * np.pi) - np.pi
        met = gather([meet(beams, reach, flakes, DIVERGENCE, turn)])
        left = 1.0 - np.bincount(met.beam, taken_shares(met, DIVERGENCE), 60)
        expected = left if expected is None else expected
        assert np.allclose(left, expected, atol=1e-9)


def test_occlusion_is_the_reference_s() -> None:
    cases = json.loads(shared("snow/occlusion_unit.json").read_text())
    agree = total = 0
    for case in cases:
        beams, divergence = np.array(case["beams"]), math.radians(case["div_deg"])
        axis = beams[:, 0] + 0.5 * np.mod(beams[:, 1] - beams[:, 0], 2 * np.pi)
        targets = np.array(case["ranges"])
        met = gather([meet(axis, targets, flakes_of(np.array(case["particles"])), divergence)])
        shares = taken_shares(met, divergence)
        for beam, expected in enumerate(case["occl"]):
            reference = sorted((reach, share) for index, reach, share in expected if index >= 0 and share > 1e-9)
            rows = (met.beam == beam) & (shares > 1e-9)
            ours = list(zip(met.range_m[rows], shares[rows], strict=True))
            same_length = len(ours) == len(reference)
            agree += same_length and (len(ours) == 0 or np.allclose(ours, reference, atol=1e-6))
            total += 1
    assert agree >= total - 4, f"{agree} of {total}"  # the reference errs in beams across azimuth 0


@pytest.mark.parametrize("severity", range(1, 6))
def test_flakes_returns_are_nearer_on_the_ray_and_on_no_object(severity: int) -> None:
    sweep = street()
    out = snow.corrupt(sweep, severity, rng())
    clean = sweep[rows_of(out, sweep)]
    scattered = out.fate == SCATTERED
    assert scattered.sum() > 50
    assert (out.range[scattered] < clean.range[scattered] - snow.SAME_RETURN_M + 1e-3).all()
    assert (out.range[scattered] >= BLIND_M - 1e-3).all()
    before, after = clean.points[scattered].astype(np.float64), out.points[scattered].astype(np.float64)
    cosine = (before * after).sum(axis=1) / np.linalg.norm(before, axis=1) / np.linalg.norm(after, axis=1)
    assert (cosine > 1.0 - 1e-9).all()
    assert (out.object_id[scattered] == ADDED).all()
    assert (out.points[~scattered] == clean.points[~scattered]).all()


def test_what_shines_past_the_flakes_is_dimmer_and_the_rest_untouched() -> None:
    sweep = street()
    out = snow.corrupt(sweep, 5, rng())
    clean = sweep[rows_of(out, sweep)]
    dimmed, kept = out.fate == ATTENUATED, out.fate == KEPT
    assert dimmed.any() and kept.any()
    assert (out.intensity[dimmed] <= clean.intensity[dimmed]).all()
    assert (out.intensity[kept] == clean.intensity[kept]).all()


def test_bright_targets_are_heard_over_the_flakes() -> None:
    reach = np.full(4000, 30.0)
    azimuth = np.linspace(-np.pi, np.pi, 4000, endpoint=False)
    share = []
    for brightness in (0.05, 0.3, 1.0):
        sweep = on_a_ray(reach, brightness, spinning(1, range_10_m=1e4))
        sweep.points[:] = np.stack([30 * np.cos(azimuth), 30 * np.sin(azimuth), 0 * azimuth], 1)
        share.append((snow.corrupt(sweep, 3, rng()).fate == SCATTERED).mean())
    assert share[0] > share[1] > share[2] > 0.0


def test_near_targets_are_heard_more_often_than_far_ones() -> None:
    sweep = street(spinning(64, columns=720))
    out = snow.corrupt(sweep, 4, rng())
    scattered = out.fate == SCATTERED
    reach = sweep.range[rows_of(out, sweep)]
    assert scattered[reach < 10].mean() < scattered[(reach > 10) & (reach < 25)].mean() < scattered[reach > 40].mean()


def test_a_weak_receiver_loses_what_flakes_hide() -> None:
    reach = np.full(3000, 38.0)
    azimuth = np.linspace(-np.pi, np.pi, 3000, endpoint=False)
    sweep = on_a_ray(reach, 0.1, spinning(1, range_10_m=40.0))
    sweep.points[:] = np.stack([38 * np.cos(azimuth), 38 * np.sin(azimuth), 0 * azimuth], 1)
    out = snow.corrupt(sweep, 5, rng())
    assert len(out) < len(sweep)


def test_no_snow_is_the_identity() -> None:
    sweep = street()
    assert same(snow.corrupt(sweep, Snow(snowfall_mm_h=0.0), rng()), sweep)


def test_a_snowfall_that_cannot_be_is_one_line() -> None:
    with pytest.raises(SettingsError, match="Snow: snowfall_mm_h: expected 0 to 50, found -1"):
        Snow(snowfall_mm_h=-1.0)
