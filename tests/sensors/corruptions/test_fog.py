"""Fog: extinction, echo, detection."""

import math

import numpy as np
import pytest

from sensors import lidar
from sensors.corruptions import fog, receiver
from sensors.corruptions.fog import Fog
from sensors.corruptions.fog_echo import fog_echo
from sensors.sweep import ADDED, ATTENUATED, SCATTERED
from sim.errors import SettingsError
from tests.sensors.corruptions.street import on_a_ray, rows_of, same, shared, spinning, street, synth64

PULSE_S = 2e-8
SEES_ALL = math.inf

# Look-up table of the published code: alpha -> distance of the peak (m), integral (1e-9 s/m^2).
TABLE = {
    0.0: (4.7024, 4.6446),
    0.005: (4.7024, 4.5680),
    0.01: (4.7024, 4.4928),
    0.02: (4.7024, 4.3466),
    0.03: (4.7024, 4.2058),
    0.06: (4.6023, 3.8156),
    0.1: (4.6023, 3.3621),
    0.12: (4.6023, 3.1584),
    0.15: (4.6023, 2.8786),
    0.2: (4.5023, 2.4760),
}
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
    return Fog(extinction=alpha, backscatter=beta, pulse_s=PULSE_S, range_10_m=SEES_ALL)


@pytest.mark.parametrize("alpha", TABLE)
def test_the_echo_is_that_of_the_published_table(alpha: float) -> None:
    echo = fog_echo(alpha, PULSE_S)
    distance, integral = TABLE[alpha]
    assert abs(echo.range_m[np.argmax(echo.waveform)] - distance) < 0.06  # the table's grid is 0.1 m
    assert np.allclose(echo.peak(np.array([5.0, 30.0, 200.0])), integral * 1e-9, rtol=2e-3)


def test_the_waveform_is_that_of_the_published_theory() -> None:
    golden = np.load(shared("fog/theory_grid.npz"))
    for t, tau in enumerate(golden["tau_h"]):
        for a, alpha in enumerate(golden["alpha"]):
            echo = fog_echo(float(alpha), float(tau))
            for k, target in enumerate(golden["R0"]):
                before = golden["R"] <= target
                ours = np.interp(golden["R"][before], echo.range_m, echo.waveform)
                assert np.abs(ours - golden["soft_integral"][t, a, k][before]).max() < 0.01 * echo.waveform.max()


def test_the_echo_grows_with_the_target_s_range_and_falls_with_extinction() -> None:
    reach = np.linspace(0.5, 50.0, 200)
    peaks = np.stack([fog_echo(alpha, PULSE_S).peak(reach) for alpha in sorted(TABLE)])
    assert (np.diff(peaks, axis=1) >= 0).all() and (np.diff(peaks, axis=0) <= 0).all()
    assert (peaks[:, reach < 0.9] == 0).all()


@pytest.mark.parametrize("beta", DROWNED_FROM_M)
@pytest.mark.parametrize("column", range(6))
def test_bright_targets_drown_from_the_published_range(beta: float, column: int) -> None:
    reach = np.arange(5.0, 110.0, 0.05)
    out = fog.corrupt(on_a_ray(reach), published(ALPHAS[column], beta), rng())
    assert len(out) == len(reach)
    first = reach[out.fate == SCATTERED].min()
    assert abs(first - DROWNED_FROM_M[beta][column]) < 0.11
    assert (out.fate[reach >= first] == SCATTERED).all()


def test_drowned_and_dimmed_points_are_the_reference_s() -> None:
    golden = np.load(shared("fog/pointwise_noise0.npz"))
    cloud = synth64()[golden["synth64_index"]]
    # The published comparison doesn't depend on a target's brightness: here that of intensity 1 does not.
    bright = on_a_ray(np.linalg.norm(cloud.points.astype(np.float64), axis=1))
    for alpha in ALPHAS:
        for beta in DROWNED_FROM_M:
            out = fog.corrupt(bright, published(alpha, beta), rng())
            mask = np.unpackbits(golden[f"dsrc_synth64_a{alpha}_b{beta}_fogmask"])[: len(cloud)].astype(bool)
            # The reference rounds ranges to 0.1 m before it looks the echo up.
            assert ((out.fate == SCATTERED) != mask).sum() <= 3
            if beta == 0.008:
                kept = ~mask & (out.fate == ATTENUATED)
                dimmed = cloud.intensity * out.intensity
                assert np.allclose(dimmed[kept], golden[f"dsrc_synth64_a{alpha}_b{beta}_intensity"][kept], atol=1e-6)


@pytest.mark.parametrize("severity", range(1, 6))
def test_fog_never_lengthens_a_range_and_never_leaves_a_ray(severity: int) -> None:
    sweep = street()
    out = fog.corrupt(sweep, severity, rng())
    clean = sweep[rows_of(out, sweep)]
    assert (out.range <= clean.range).all()
    moved = out.fate == SCATTERED
    assert (out.points[~moved] == clean.points[~moved]).all()
    before, after = clean.points[moved].astype(np.float64), out.points[moved].astype(np.float64)
    cosine = (before * after).sum(axis=1) / np.linalg.norm(before, axis=1) / np.linalg.norm(after, axis=1)
    assert (cosine > 1.0 - 1e-9).all()
    assert (out.range[moved] >= receiver.BLIND_M - 1e-3).all()


def test_what_shines_through_is_dimmed_both_ways() -> None:
    sweep = street()
    settings = Fog.of_visibility(80.0)
    out = fog.corrupt(sweep, settings, rng())
    through = out.fate == ATTENUATED
    clean = sweep[rows_of(out, sweep)][through]
    expected = clean.intensity * np.exp(-2.0 * settings.extinction * clean.range)
    assert np.allclose(out.intensity[through], expected, rtol=1e-5)


def test_contrast_is_five_percent_at_the_visibility() -> None:
    settings = Fog.of_visibility(123.0)
    assert math.isclose(math.exp(-settings.extinction * 123.0), 0.05)
    assert math.isclose(settings.backscatter / settings.extinction, 0.046 / math.log(20.0))


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


def test_the_fog_s_return_does_not_know_its_target() -> None:
    reach = np.full(500, 60.0)
    dark, bright = (
        fog.corrupt(on_a_ray(reach, i), Fog(extinction=0.06, backscatter=9e-4, range_10_m=SEES_ALL), rng())
        for i in (0.05, 0.5)
    )
    assert (dark.fate == SCATTERED).all() and same(dark, bright)


def test_a_weak_receiver_loses_far_and_dark_targets() -> None:
    reach = np.arange(2.0, 110.0, 0.5)
    seen = {}
    for name, range_10_m in (("weak", 40.0), ("strong", 200.0)):
        for brightness in (0.1, 0.8):
            spec = spinning(range_10_m=range_10_m)
            out = fog.corrupt(on_a_ray(reach, brightness, spec), Fog.of_visibility(100.0), rng())
            seen[name, brightness] = (out.fate == ATTENUATED).sum()
    assert seen["weak", 0.1] < seen["weak", 0.8] < seen["strong", 0.8]
    assert seen["weak", 0.1] < seen["strong", 0.1]
    weak = fog.corrupt(on_a_ray(reach, 0.1, spinning(range_10_m=40.0)), Fog.of_visibility(100.0), rng())
    assert len(weak) < len(reach) and weak.range.max() < 40.0


def test_fog_returns_are_dim_near_and_on_no_object() -> None:
    sweep = street()
    out = fog.corrupt(sweep, 5, rng())
    added = out.fate == SCATTERED
    assert added.sum() > 100
    assert (out.object_id[added] == ADDED).all()
    assert np.median(out.range[added]) < 5.0 and out.intensity[added].max() < 0.1
    assert out.range[added].std() > 0.5  # patchy, not one shell


def test_a_longer_pulse_hears_more_fog() -> None:
    reach = np.arange(5.0, 100.0, 0.1)
    drowned = []
    for pulse_s in (5e-9, 1e-8, 2e-8):
        out = fog.corrupt(on_a_ray(reach, 0.3, spinning(pulse_s=pulse_s, range_10_m=1e4)), 4, rng())
        drowned.append((out.fate == SCATTERED).sum())
    assert drowned[0] < drowned[1] < drowned[2]


def test_the_receiver_is_the_one_that_scans() -> None:
    assert receiver.CLEAR_AIR_EXTINCTION == lidar.CLEAR_AIR_EXTINCTION
    spec = spinning(range_10_m=70.0)
    target = 0.1 * math.exp(-2.0 * lidar.CLEAR_AIR_EXTINCTION * 70.0) / 70.0**2
    assert math.isclose(receiver.least_power(spec), target)


def test_a_fog_that_cannot_be_is_one_line() -> None:
    with pytest.raises(SettingsError, match="Fog: extinction: expected 0 to 10, found -1"):
        Fog(extinction=-1.0, backscatter=0.0)
    with pytest.raises(SettingsError, match="visibility_m"):
        Fog.of_visibility(0.0)
