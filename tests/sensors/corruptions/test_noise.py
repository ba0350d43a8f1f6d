"""Noise: on coordinates, of three distributions."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from sensors.corruptions.noise import Noise, corrupt
from sensors.sweep import KEPT, MOVED, SCATTERED
from sim.errors import SettingsError
from tests.sensors.corruptions.street import same, street, synth16


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def settings(how: str, severity: int) -> Noise:
    return Noise(how=how, size_m=Noise.LEVELS["size_m"][severity - 1], one_of=Noise.LEVELS["one_of"][severity - 1])


@pytest.mark.parametrize("severity", range(1, 6))
def test_gaussian_noise_has_its_deviation_on_each_coordinate(severity: int) -> None:
    sweep = synth16()
    shift = corrupt(sweep, Noise.severity(severity), rng()).points.astype(np.float64) - sweep.points
    assert np.allclose(shift.std(axis=0), Noise.LEVELS["size_m"][severity - 1], rtol=0.03)
    assert np.abs(shift.mean(axis=0)).max() < 5 * Noise.LEVELS["size_m"][severity - 1] / np.sqrt(len(sweep))
    assert np.abs(np.corrcoef(shift.T) - np.eye(3)).max() < 0.05


def test_uniform_noise_fills_its_width() -> None:
    sweep = synth16()
    shift = corrupt(sweep, settings("uniform", 3), rng()).points.astype(np.float64) - sweep.points
    assert np.abs(shift).max() <= 0.06 + 1e-5
    assert np.allclose(np.percentile(shift, [5, 50, 95]), [-0.054, 0.0, 0.054], atol=0.002)


def test_impulses_hit_few_points_hard() -> None:
    sweep = synth16()
    out = corrupt(sweep, settings("impulse", 3), rng())
    hit = out.fate == MOVED
    assert hit.mean() == pytest.approx(1 / 20, rel=0.15)
    assert np.allclose(np.abs(out.points[hit] - sweep.points[hit]), 0.1, atol=1e-5)
    assert same(out[~hit], sweep[~hit]) and (out.fate[~hit] == KEPT).all()


@pytest.mark.parametrize("how", ["gaussian", "uniform", "impulse"])
def test_coordinates_alone_are_noisy_and_more_so_at_the_next_severity(how: str) -> None:
    sweep = street()
    outs = [corrupt(sweep, settings(how, severity), rng()) for severity in range(1, 6)]
    for out in outs:
        assert (out.intensity == sweep.intensity).all() and (out.ring == sweep.ring).all() and len(out) == len(sweep)
    shifts = [np.linalg.norm(out.points - sweep.points, axis=1) for out in outs]
    assert all((a <= b + 2e-5).all() and a.sum() < b.sum() for a, b in itertools.pairwise(shifts))


@pytest.mark.parametrize("how", ["gaussian", "uniform", "impulse"])
def test_no_noise_and_no_points(how: str) -> None:
    sweep = street()
    assert same(corrupt(sweep, Noise(how=how, size_m=0.0, impulse_m=0.0), rng()), sweep)
    assert len(corrupt(sweep[:0], settings(how, 5), rng())) == 0
    assert len(corrupt(sweep[:1], settings(how, 5), rng())) == 1
    clouded = replace(sweep, fate=np.full(len(sweep), SCATTERED, np.uint8))
    assert (corrupt(clouded, settings(how, 5), rng()).fate == SCATTERED).all()


def test_a_negative_size_is_refused_in_one_line() -> None:
    with pytest.raises(SettingsError, match="size_m: expected 0 to 100, found -1"):
        Noise(size_m=-1.0)
