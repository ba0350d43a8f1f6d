"""Flakes as published."""

import numpy as np
import pytest

from sensors.corruptions.published.cloud import RandomSource
from sensors.corruptions.published.snow_discs import (
    RADIUS_M,
    Law,
    Sampler,
    disc_sample,
    occupancy,
    rain_rate,
    sample_discs,
    size_rate,
)
from tests.sensors.corruptions.published.goldens import arrays, table

SNOWS = {"light": (0.5, 2.0), "moderate": (1.0, 1.6), "heavy": (2.5, 1.6)}


def draw_in_turn(goal: float, rate: float, radius_m: float, rng: RandomSource) -> np.ndarray:
    """Draw discs that fill an area one after the other, as the published code does."""
    darts, area = [], 0.0
    while area < goal:
        reach = np.sqrt(rng.uniform(0.0, radius_m**2))
        angle = np.pi * rng.uniform(0.0, 2.0)
        diameter = rng.exponential(1.0 / rate)
        while diameter > 0.02:
            diameter = rng.exponential(1.0 / rate)
        height = rng.uniform(-diameter / 2.0, diameter / 2.0)
        radius = np.sqrt(diameter**2 / 4.0 - height**2)
        darts.append((reach * np.cos(angle), reach * np.sin(angle), radius))
        area += np.pi * radius**2
    return np.array(darts)


def test_rates_are_the_published_ones() -> None:
    for snowfall, speed, rain, filled, gunn, sekhon, _ in table("snow_formulas")["rows"]:
        assert np.isclose(rain_rate(snowfall, speed), rain, rtol=1e-12)
        assert np.isclose(occupancy(snowfall, speed), filled, rtol=1e-12)
        assert np.isclose(size_rate(rain, "gunn"), 100 * gunn, rtol=1e-12)
        assert np.isclose(size_rate(rain, "sekhon"), 100 * sekhon, rtol=1e-12)


@pytest.mark.parametrize("law", ["gunn", "sekhon"])
@pytest.mark.parametrize("snow", SNOWS)
def test_a_generator_draws_the_published_discs(snow: str, law: Law) -> None:
    rate = size_rate(rain_rate(*SNOWS[snow]), law)
    discs = sample_discs(occupancy(*SNOWS[snow]), rate, 10.0, np.random.default_rng(42), draw=draw_in_turn)
    golden = arrays("snow_discs")[f"{law}_{snow}_R10_rng42"]
    assert discs.shape == (table("snow_discs")[f"{law}_{snow}_R10_rng42"]["n"], 3)
    assert np.allclose(discs, golden[:, :3], rtol=0, atol=1e-12)


@pytest.mark.parametrize("snow", ["light", "moderate"])
def test_both_samplers_draw_the_same_medium(snow: str) -> None:
    golden = table("snow_discs")[f"shipped_gunn_{snow}"]
    filled, rate = occupancy(*SNOWS[snow]), size_rate(rain_rate(*SNOWS[snow]))
    samples = [sample_discs(filled, rate, RADIUS_M, np.random.default_rng(seed)) for seed in range(6)]
    count = np.array([len(discs) for discs in samples])
    error = golden["n_std"] * np.sqrt(1 / 6 + 1 / 64)
    assert abs(count.mean() - golden["n_mean"]) < 3 * error
    discs = np.concatenate(samples)
    assert np.isclose(discs[:, 2].mean(), golden["mean_disc_radius_m"], rtol=0.01)
    quantiles = np.quantile(discs[:, 2], [0.05, 0.25, 0.5, 0.75, 0.95, 0.99])
    assert np.allclose(quantiles, golden["radius_quantiles_5_25_50_75_95_99_100"][:6], rtol=0.03)
    ours, _ = np.histogram(np.hypot(discs[:, 0], discs[:, 1]), np.arange(0, 81, 10))
    assert np.allclose(ours / 6, golden["radial_hist_0_80_by10_per_disc"], rtol=0.05)


@pytest.mark.parametrize("draw", [draw_in_turn, None])
def test_discs_fill_their_share_without_overlap(draw: Sampler | None) -> None:
    # So dense that discs do collide.
    discs = sample_discs(0.1, 200.0, 0.2, np.random.default_rng(1), draw=draw)
    area = np.pi * discs[:, 2] ** 2
    goal = 0.1 * np.pi * 0.04
    assert area[:-1].sum() < goal <= area.sum()
    assert (np.hypot(discs[:, 0], discs[:, 1]) > discs[:, 2]).all() and discs[:, 2].max() <= 0.01
    gap = np.hypot(*(discs[:, None, :2] - discs[None, :, :2]).transpose(2, 0, 1)) - discs[:, None, 2] - discs[:, 2]
    assert gap[~np.eye(len(discs), dtype=bool)].min() >= 0.0


def test_samples_are_the_same_in_every_process() -> None:
    first = disc_sample(2.5, 1.6, "gunn", 3)
    disc_sample.cache_clear()
    assert (disc_sample(2.5, 1.6, "gunn", 3) == first).all()
    assert not np.array_equal(disc_sample(2.5, 1.6, "gunn", 4)[:9], first[:9])
