"""Rain: drops, attenuation, echoes, range noise."""

import itertools
import json
import math

import numpy as np
import pytest
from scipy.integrate import quad

from sensors.corruptions import rain
from sensors.corruptions.physics.medium import rays_of
from sensors.corruptions.physics.receiver import detection_threshold
from sensors.corruptions.rain import Rain, rain_particles
from sensors.sweep import ATTENUATED, SCATTERED
from sim.errors import SettingsError
from tests.sensors.corruptions.street import on_a_ray, rows_of, same, shared, spinning, street, synth64

# Published figures (LISA): rate in mm/h -> extinction, 1/m.
EXTINCTION = {0.2: 1.34e-4, 1.0: 3.69e-4, 10.0: 1.57e-3, 30.0: 3.13e-3, 50.0: 4.31e-3}


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.mark.parametrize("rate", EXTINCTION)
def test_extinction_is_the_published_one(rate: float) -> None:
    extinction = rain_particles(rate, 0.02).extinction
    assert math.isclose(extinction, EXTINCTION[rate], rel_tol=0.01)
    assert math.isclose(extinction, 3.65e-4 * rate**0.63, rel_tol=0.02)


def test_extinction_is_the_sum_over_mie_s_theory() -> None:
    golden = np.load(shared("lisa/tables.npz"))
    for rate, alpha, other in zip(
        golden["rain_rates"], golden["rain_alpha"], golden["rain_alpha_pymiescatt"], strict=True
    ):
        extinction = rain_particles(float(rate), 0.02).extinction
        assert math.isclose(extinction, alpha, rel_tol=0.01)
        assert math.isclose(extinction, other, rel_tol=0.02)


@pytest.mark.parametrize("rate", [0.5, 25.0, 150.0])
def test_drops_are_those_of_marshall_and_palmer(rate: float) -> None:
    drops = rain_particles(rate, 0.02)
    per_mm = 4.1 * rate**-0.21
    assert math.isclose(drops.rate_per_m, 1e3 * per_mm)
    assert math.isclose(drops.per_m3, 8000.0 / per_mm)
    # Extinction twice the drops' cross-section, and a little for the rims of the small ones.
    area, _ = quad(lambda mm: 8000.0 * math.exp(-per_mm * mm) * 0.25 * math.pi * (1e-3 * mm) ** 2, 0.0, 30.0)
    assert 2.0 * area < drops.extinction < 2.05 * area


def test_the_table_of_severities_holds() -> None:
    extinction = [1e3 * rain_particles(rate, 0.02).extinction for rate in rain.Rain.LEVELS["rain_mm_h"]]
    assert np.allclose(extinction, [0.57, 1.36, 2.79, 4.85, 7.5], rtol=0.01)
    assert Rain() == Rain.severity(3)


def test_a_target_is_dimmed_both_ways_and_stays_on_its_ray() -> None:
    sweep = street()
    out = rain.corrupt(sweep, Rain.severity(4), rng())
    seen = out[out.fate != SCATTERED]
    clean = sweep[rows_of(seen, sweep)]
    extinction = rain_particles(rain.Rain.LEVELS["rain_mm_h"][3], 0.02).extinction
    assert np.allclose(seen.intensity, clean.intensity * np.exp(-2.0 * extinction * clean.range), rtol=1e-5)
    ray = clean.points / clean.range[:, None]
    assert np.abs(seen.points - ray * seen.range[:, None]).max() < 1e-4
    assert (seen.fate == ATTENUATED).all()


@pytest.mark.parametrize("accuracy_m", [0.09, 0.5])
def test_range_noise_follows_from_the_signal(accuracy_m: float) -> None:
    # Clear air's share is in the sweep already: what is added makes the whole of the published deviation.
    spec = spinning(range_10_m=100.0)
    sweep = on_a_ray(np.full(50_000, 60.0), 0.3, spec)
    settings = Rain(rain_mm_h=100.0, drop_reflectivity=0.0, range_accuracy_m=accuracy_m)
    out = rain.corrupt(sweep, settings, rng())
    assert len(out) == 50_000
    clear = 0.3 / 60.0**2 / detection_threshold(spec)
    dimmed = clear * math.exp(-120.0 * rain_particles(100.0, 0.0).extinction)
    variance = (accuracy_m / math.sqrt(2.0 * dimmed)) ** 2 - (accuracy_m / math.sqrt(2.0 * clear)) ** 2
    assert math.isclose(out.range.std(), math.sqrt(variance), rel_tol=0.02)
    assert abs(out.range.mean() - 60.0) < 5.0 * math.sqrt(variance / 50_000)


def test_a_receiver_that_detects_everything_measures_without_noise() -> None:
    sweep = on_a_ray(np.full(100, 60.0), 0.3)
    rays = rays_of(sweep, math.inf, rng())
    assert not rain.added_deviation(rays, np.full(100, 0.5), 0.09).any()


def test_targets_too_weak_for_the_receiver_are_lost_and_no_others() -> None:
    spec = spinning(range_10_m=60.0)
    reach = np.arange(2.0, 60.0, 0.05)
    out = rain.corrupt(on_a_ray(reach, 0.1, spec), Rain(rain_mm_h=100.0, drop_reflectivity=0.0), rng())
    left = np.exp(-2.0 * rain_particles(100.0, 0.0).extinction * reach) * 0.1 / reach**2
    assert len(out) == (left >= detection_threshold(spec)).sum() < len(reach)


def test_number_and_ranges_of_drops_agree_with_lisa() -> None:
    golden = json.loads(shared("lisa/stats.json").read_text())
    cloud = synth64()[::8]
    # Published: p_min = 0.9 / (200 m)^2, no drop nearer than 1.5 m.
    range_10_m = 0.1**0.5 * 200.0 / 0.9**0.5
    for rate in (10, 30, 50):
        out = [rain.corrupt(cloud, Rain(rain_mm_h=rate, range_10_m=range_10_m), rng(seed)) for seed in range(20)]
        drops = [o.range[(o.fate == SCATTERED) & (o.range > 1.5)] for o in out]
        theirs = golden[f"rain_R{rate}_strongest/synth64_stride8"]
        assert math.isclose(np.mean([len(d) for d in drops]), theirs["n_label"]["mean"][1], rel_tol=0.1)
        quantiles = np.percentile(np.concatenate(drops), [5, 50, 95])
        assert np.allclose(quantiles, theirs["scattered_range_q_5_50_95"]["mean"], rtol=0.12)


def test_darker_drops_return_fewer_echoes() -> None:
    sweep = street(spinning(64, columns=720))
    answers = [
        (rain.corrupt(sweep, Rain(drop_reflectivity=share), rng()).fate == SCATTERED).sum()
        for share in (0.0, 0.005, 0.02, 0.3)
    ]
    assert answers[0] == 0 and all(a < b for a, b in itertools.pairwise(answers))


def test_no_rain_is_the_identity() -> None:
    sweep = street()
    assert same(rain.corrupt(sweep, Rain(rain_mm_h=0.0), rng()), sweep)


def test_impossible_rain_is_refused_in_one_line() -> None:
    with pytest.raises(SettingsError, match="Rain: rain_mm_h: expected 0 to 300, found -1"):
        Rain(rain_mm_h=-1.0)
    with pytest.raises(SettingsError, match="Rain: range_accuracy_m"):
        Rain(range_accuracy_m=math.nan)
