"""Fog: extinction, echo, detection; facts shared with snow and rain are in test_medium."""

import math

import numpy as np
import pytest

from sensors.corruptions import fog
from sensors.corruptions.fog import Fog
from sensors.sweep import ADDED, ATTENUATED, SCATTERED
from sim.errors import SettingsError
from tests.sensors.corruptions.street import on_a_ray, rows_of, same, shared, spinning, street, synth64

PULSE_S = 2e-8
SEES_ALL = math.inf

# Range beyond which the published code puts every target into the fog: beta -> by alpha.
DROWNED_FROM_M = {
    0.008: (92.6, 66.9, 54.6, 41.7, 34.6, 24.1),
    0.05: (37.1, 31.9, 28.4, 23.8, 20.9, 15.9),
    0.2: (18.6, 17.2, 16.1, 14.4, 13.2, 10.8),
}
ALPHAS = (0.0, 0.005, 0.01, 0.02, 0.03, 0.06)


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def published(alpha: float, beta: float) -> Fog:
    """Homogeneous fog before a receiver that detects everything."""
    return Fog(extinction=alpha, backscatter=beta, pulse_s=PULSE_S, range_10_m=SEES_ALL, patchiness=1e-3)


@pytest.mark.parametrize("beta", DROWNED_FROM_M)
@pytest.mark.parametrize("column", range(6))
def test_bright_targets_drown_from_the_published_range(beta: float, column: int) -> None:
    reach = np.arange(5.0, 110.0, 0.05)
    out = fog.corrupt(on_a_ray(reach), published(ALPHAS[column], beta), rng())
    assert len(out) == len(reach)
    # Homogeneous but for 0.1 %; the published ranges are on a grid of 0.1 m.
    first = DROWNED_FROM_M[beta][column]
    assert (out.fate[reach > first + 0.25] == SCATTERED).all()
    assert (out.fate[reach < first - 0.25] != SCATTERED).all()


def test_drowned_and_dimmed_points_are_the_reference_s() -> None:
    golden = np.load(shared("fog/pointwise_noise0.npz"))
    cloud = synth64()[golden["synth64_index"]]
    reach = np.linalg.norm(cloud.points.astype(np.float64), axis=1)
    # The published comparison doesn't depend on a target's brightness: here that of intensity 1 does not.
    bright = on_a_ray(reach)
    for column, alpha in enumerate(ALPHAS):
        for beta in DROWNED_FROM_M:
            out = fog.corrupt(bright, published(alpha, beta), rng())
            mask = np.unpackbits(golden[f"dsrc_synth64_a{alpha}_b{beta}_fogmask"])[: len(cloud)].astype(bool)
            plain = np.abs(reach - DROWNED_FROM_M[beta][column]) > 0.3
            assert ((out.fate == SCATTERED) == mask)[plain].all() and plain.mean() > 0.95
            if beta == 0.008:
                kept = ~mask & (out.fate == ATTENUATED)
                dimmed = cloud.intensity * out.intensity
                assert np.allclose(dimmed[kept], golden[f"dsrc_synth64_a{alpha}_b{beta}_intensity"][kept], atol=1e-6)


def test_remaining_targets_are_dimmed_both_ways() -> None:
    sweep = street()
    settings = Fog.of_visibility(80.0)
    out = fog.corrupt(sweep, settings, rng())
    seen = out.fate == ATTENUATED
    clean = sweep[rows_of(out[seen], sweep)]
    expected = clean.intensity * np.exp(-2.0 * settings.extinction * clean.range)
    assert np.allclose(out.intensity[seen], expected, rtol=1e-5)


def test_contrast_is_five_percent_at_the_visibility() -> None:
    settings = Fog.of_visibility(123.0)
    assert math.isclose(math.exp(-settings.extinction * 123.0), 0.05)
    assert math.isclose(settings.backscatter / settings.extinction, 0.046 / math.log(20.0))
    denser = settings.scaled(1.1)
    assert math.isclose(denser.backscatter / denser.extinction, 0.046 / math.log(20.0))
    assert same(fog.corrupt(street(), settings.scaled(1.0), rng()), fog.corrupt(street(), settings, rng()))


def test_no_fog_is_the_identity() -> None:
    sweep = street()
    assert same(fog.corrupt(sweep, Fog(extinction=0.0, backscatter=0.0), rng()), sweep)
    assert same(fog.corrupt(sweep, Fog.of_visibility(math.inf), rng()), sweep)


def test_dark_targets_drown_first() -> None:
    reach = np.arange(5.0, 100.0, 0.1)
    first = [
        reach[fog.corrupt(on_a_ray(reach, i), published(0.03, 0.008), rng()).fate == SCATTERED].min()
        for i in (0.05, 0.3, 1.0)
    ]
    assert first[0] < first[1] < first[2]


def test_the_fog_s_return_is_independent_of_its_target() -> None:
    reach = np.full(500, 60.0)
    dark, bright = (
        fog.corrupt(on_a_ray(reach, i), Fog(extinction=0.06, backscatter=9e-3, range_10_m=SEES_ALL), rng())
        for i in (0.05, 0.5)
    )
    assert (dark.fate == SCATTERED).all() and same(dark, bright)


def test_a_weak_receiver_loses_far_and_dark_targets() -> None:
    reach = np.arange(2.0, 110.0, 0.5)
    seen = {}
    for name, range_10_m in (("weak", 40.0), ("strong", 200.0)):
        for brightness in (0.1, 0.8):
            spec = spinning(range_10_m=range_10_m, range_max_m=200.0)
            # Each detected in clear air: what it isn't is not in a sweep.
            visible = reach[reach < range_10_m * math.sqrt(brightness / 0.1)]
            out = fog.corrupt(on_a_ray(visible, brightness, spec), Fog.of_visibility(100.0), rng())
            seen[name, brightness] = (out.fate == ATTENUATED).sum()
    assert seen["weak", 0.1] < seen["weak", 0.8] < seen["strong", 0.8]
    assert seen["weak", 0.1] < seen["strong", 0.1] < seen["strong", 0.8]


def test_fog_returns_are_dim_near_and_not_all_from_one_range() -> None:
    out = fog.corrupt(street(), Fog.severity(5), rng())
    added = out.fate == SCATTERED
    assert added.sum() > 100
    assert (out.object_id[added] == ADDED).all()
    assert np.median(out.range[added]) < 3.0 and out.intensity[added].max() < 0.1
    assert out.range[added].std() > 0.3


def test_patchier_fog_spreads_the_ranges_of_its_returns() -> None:
    spread = []
    for patchiness in (0.01, 0.1, 0.2, 0.4):
        settings = Fog(extinction=0.06, backscatter=9e-3, patchiness=patchiness)
        out = fog.corrupt(on_a_ray(np.full(2000, 80.0), 0.1), settings, rng())
        spread.append(out.range[out.fate == SCATTERED].std())
    assert spread[0] < 0.2 and spread == sorted(spread)


def test_a_longer_pulse_returns_more_fog() -> None:
    reach = np.arange(5.0, 100.0, 0.1)
    drowned = []
    for pulse_s in (5e-9, 1e-8, 2e-8):
        out = fog.corrupt(on_a_ray(reach, 0.3, spinning(pulse_s=pulse_s, range_10_m=120.0)), Fog.severity(4), rng())
        drowned.append((out.fate == SCATTERED).sum())
    assert drowned[0] < drowned[1] < drowned[2]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"extinction": -1.0}, "Fog: extinction: expected 0 to 1, found -1"),
        ({"backscatter": math.nan}, "Fog: backscatter"),
        ({"patchiness": 0.5}, "Fog: patchiness: expected 0.001 to 0.45, found 0.5"),
        ({"pulse_s": 0.0}, "Fog: pulse_s"),
    ],
)
def test_impossible_fog_is_refused_in_one_line(settings: dict[str, float], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        Fog(**settings)
    with pytest.raises(SettingsError, match="visibility_m"):
        Fog.of_visibility(0.0)
