"""Strongest particle of a beam: the closed form against media of sampled particles."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import ks_2samp

from sensors.corruptions.physics.medium import Rays, rays_of
from sensors.corruptions.physics.receiver import FULL_OVERLAP_M
from sensors.corruptions.physics.strongest import (
    DEFAULT_DIVERGENCE_RAD,
    SAME_RETURN_M,
    Particles,
    beam_width,
    strongest_particle,
)
from sensors.presets import get_lidar
from tests.sensors.corruptions.street import on_a_ray, spinning

WIDTH = 0.01
MEDIUM = Particles(per_m3=150.0, rate_per_m=1500.0, reflectivity=0.2, extinction=0.0)


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def beams(reach_m: float, count: int, intensity: float = 0.0, width: float = WIDTH) -> Rays:
    """Beams without a detection threshold, on targets at one range."""
    sweep = on_a_ray(np.full(count, reach_m), intensity, spinning(1, 4, divergence_rad=width))
    return rays_of(sweep, math.inf, rng())


def sampled(particles: Particles, reach_m: float, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every particle before the targets: its beam, its range, its power."""
    generator = rng(7)
    volume = math.pi * WIDTH**2 / 12.0 * reach_m**3
    number = generator.poisson(particles.per_m3 * volume, count)
    beam = np.repeat(np.arange(count), number)
    range_m = reach_m * generator.random(len(beam)) ** (1.0 / 3.0)
    diameter = generator.exponential(1.0 / particles.rate_per_m, len(beam))
    return beam, range_m, particles.reflectivity * diameter**2 / (WIDTH**2 * range_m**4)


@pytest.mark.parametrize("reach_m", [6.0, 15.0])
def test_strongest_particles_agree_with_sampled_media(reach_m: float) -> None:
    count = 4000
    beam, range_m, power = sampled(MEDIUM, reach_m, count)
    seen = (range_m >= FULL_OVERLAP_M) & (range_m <= reach_m - SAME_RETURN_M)
    order = np.lexsort((-power[seen], beam[seen]))
    first = np.flatnonzero(np.diff(np.r_[-1, beam[seen][order]]))
    best_power, best_m = power[seen][order][first], range_m[seen][order][first]

    echo = strongest_particle(MEDIUM, beams(reach_m, count), np.ones(count), rng(3))
    # Stronger than the walk of a few steps may miss in a beam without a threshold.
    loud = 0.002 * 0.2 / reach_m**2
    ours, theirs = echo.power > loud, best_power > loud
    assert ours.sum() > 500
    assert math.isclose(ours.sum(), theirs.sum(), abs_tol=4.0 * math.sqrt(count * 0.25 * 2.0))
    assert ks_2samp(echo.power[ours], best_power[theirs]).pvalue > 0.001
    assert ks_2samp(echo.range_m[ours], best_m[theirs]).pvalue > 0.001


def test_counts_above_a_power_agree_with_the_closed_form() -> None:
    power = sampled(MEDIUM, 40.0, 300)[2]
    for level in (3e-6, 3e-5, 3e-4):
        c = MEDIUM.rate_per_m * WIDTH * math.sqrt(level / MEDIUM.reflectivity)
        expected = MEDIUM.per_m3 * math.pi**1.5 * WIDTH**2 / (16.0 * c**1.5)
        heard = (power > level).sum() / 300
        assert math.isclose(heard, expected, rel_tol=5.0 / math.sqrt(expected * 300)), level


def test_only_echoes_stronger_than_the_target_are_drawn() -> None:
    rays = beams(30.0, 3000, intensity=0.02)
    echo = strongest_particle(MEDIUM, rays, np.full(3000, 0.9), rng())
    heard = echo.power > 0.0
    assert 100 < heard.sum() < 2900
    assert (echo.power[heard] > 0.9 * 0.0199 / 30.0**2).all()


@settings(max_examples=40, deadline=None)
@given(
    st.floats(1.0, 5000.0),
    st.floats(300.0, 6000.0),
    st.floats(0.005, 1.0),
    st.floats(2e-4, 0.01),
    st.floats(1.5, 200.0),
    st.floats(0.0, 1.0),
)
def test_particles_lie_between_sensor_and_target_and_are_no_brighter_than_their_kind(
    per_m3: float, rate: float, reflectivity: float, width: float, reach_m: float, brightness: float
) -> None:
    particles = Particles(per_m3, rate, reflectivity, extinction=0.003)
    echo = strongest_particle(particles, beams(reach_m, 50, brightness, width), np.ones(50), rng())
    heard = echo.power > 0.0
    place = echo.range_m[heard]
    assert (place >= FULL_OVERLAP_M).all() and (place <= reach_m - SAME_RETURN_M).all()
    assert (echo.power[heard] * place**2 <= reflectivity * (1.0 + 1e-12)).all()


@pytest.mark.parametrize("nothing", [{"per_m3": 0.0}, {"reflectivity": 0.0}])
def test_no_particles_and_black_ones_have_no_echo(nothing: dict[str, float]) -> None:
    fields = {"per_m3": 100.0, "rate_per_m": 1000.0, "reflectivity": 0.5, "extinction": 0.0} | nothing
    assert not strongest_particle(Particles(**fields), beams(50.0, 100), np.ones(100), rng()).power.any()


def test_a_simulator_s_rays_are_as_wide_as_an_unknown_sensor_s() -> None:
    assert get_lidar("carla-64").divergence_rad == 0.0
    assert beam_width(get_lidar("carla-64")) == beam_width(None) == DEFAULT_DIVERGENCE_RAD


def test_an_oval_beam_is_as_wide_as_a_round_one_of_its_area() -> None:
    spec = get_lidar("livox-avia")
    assert spec.divergence_vertical_rad is not None
    assert math.isclose(beam_width(spec) ** 2, spec.divergence_rad * spec.divergence_vertical_rad)
