"""Crosstalk: foreign pulses along the ray, also where a beam had no return."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sensors.corruptions.crosstalk import Crosstalk, corrupt
from sensors.corruptions.physics.receiver import detection_threshold
from sensors.motion import Path
from sensors.sweep import ADDED, KEPT, SCATTERED, UNKNOWN_MATERIAL, make_sweep
from sim.errors import SettingsError
from tests.sensors.corruptions.drives import World, worlds
from tests.sensors.corruptions.street import on_a_ray, same, spinning, street, synth16

on_random_sweeps = settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


@on_random_sweeps
@given(world=worlds, share=st.sampled_from([0.01, 0.1, 1.0]), seed=st.integers(0, 1000))
def test_false_points_lie_on_the_rays_of_the_sensor_within_its_ranges(world: World, share: float, seed: int) -> None:
    sweep = world.sweep()
    out = corrupt(sweep, Crosstalk(share=share), rng(seed))
    false = out[out.fate == SCATTERED]
    spec = sweep.spec
    azimuth, elevation = spec.azimuth[false.column], spec.elevation[false.ring]
    ray = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], 1)
    assert ((false.points * ray).sum(axis=1) >= false.range * (1.0 - 1e-5)).all()
    assert (false.range <= spec.range_max_m * (1 + 1e-6)).all()
    assert (false.range >= max(spec.range_min_m, 0.9) * (1 - 1e-6)).all()
    assert ((out.intensity >= 0.0) & (out.intensity <= 1.0)).all()
    assert (false.object_id == ADDED).all() and (false.material == UNKNOWN_MATERIAL).all()
    assert np.allclose(false.time_offset, spec.time_offset[false.ring, false.column], atol=1e-6)


@on_random_sweeps
@given(world=worlds, seed=st.integers(0, 1000))
def test_true_returns_are_bit_identical(world: World, seed: int) -> None:
    sweep = world.sweep()
    out = corrupt(sweep, Crosstalk(share=0.3), rng(seed))
    first = out[: len(sweep)]
    kept = first.fate == KEPT
    assert same(first[kept], sweep[kept])
    assert (first.ring == sweep.ring).all() and (first.column == sweep.column).all()
    assert (out[len(sweep) :].fate == SCATTERED).all()
    answered = set(zip(sweep.ring, sweep.column, strict=True))
    assert not answered & set(zip(out.ring[len(sweep) :], out.column[len(sweep) :], strict=True))


def test_the_order_of_the_points_does_not_matter() -> None:
    sweep = street(spinning(32, columns=360, range_max_m=40.0))
    shuffled = sweep[rng(5).permutation(len(sweep))]
    one, other = (corrupt(s, Crosstalk.severity(5), rng()) for s in (sweep, shuffled))
    assert 0 < (one.fate == SCATTERED).sum() < len(one) and len(one) > len(sweep)
    assert same(*(out[np.lexsort((out.column, out.ring))] for out in (one, other)))


def test_every_beam_is_reached_as_often() -> None:
    sweep = street(spinning(32, columns=360, range_max_m=40.0))
    beams = 32 * 360
    sweep = sweep[sweep.range < 11.0]
    out = corrupt(sweep, Crosstalk.severity(3), rng())
    silent = beams - len(sweep)
    assert silent > 3000
    assert len(out) - len(sweep) == pytest.approx(0.02 * silent, rel=0.25)


def test_at_level_3_one_return_of_a_street_in_a_hundred_is_false() -> None:
    sweep = street(spinning(64, columns=1800))
    out = corrupt(sweep, Crosstalk.severity(3), rng())[: len(sweep)]
    assert 0.005 < (out.fate == SCATTERED).mean() < 0.02


def test_false_ranges_are_uniform_and_independent_of_the_target() -> None:
    sweep = make_sweep(street().points, spec=spinning(), ring=street().ring, column=street().column)
    out = corrupt(sweep, Crosstalk(share=1.0), rng())
    false = out.range[out.fate == SCATTERED]
    assert np.allclose(np.percentile(false, [25, 50, 75]), [30.7, 60.5, 90.2], atol=2.0)


def test_a_bright_target_is_not_outshouted_and_a_dark_one_is() -> None:
    near, far = np.full(400, 5.0), np.full(400, 80.0)
    bright = corrupt(on_a_ray(near, 1.0), Crosstalk(share=1.0), rng())
    dark = corrupt(on_a_ray(far, 0.05), Crosstalk(share=1.0), rng())
    assert (bright.fate == KEPT).all()
    assert (dark.fate == SCATTERED).mean() > 0.6


def test_a_sensor_of_last_returns_reports_the_farther_one() -> None:
    sweep = street(spinning(16, returns="last"))
    out = corrupt(sweep, Crosstalk(share=1.0), rng())[: len(sweep)]
    assert (out.range[out.fate == SCATTERED] > sweep.range[out.fate == SCATTERED]).all()


def test_pulses_of_a_severity_are_among_those_of_the_next() -> None:
    sweep = street()
    outs = [corrupt(sweep, Crosstalk.severity(severity), rng()) for severity in range(1, 6)]
    false = [{(r, c) for r, c in zip(f.ring, f.column, strict=True)} for f in (o[o.fate == SCATTERED] for o in outs)]
    assert all(a < b for a, b in itertools.pairwise(false))


def test_intensity_follows_from_the_pulse_s_power() -> None:
    out = corrupt(street(), Crosstalk(share=1.0), rng())
    false = out[out.fate == SCATTERED]
    power = false.intensity / false.range.astype(np.float64) ** 2
    seen = false.intensity < 1.0
    assert power[seen].min() >= detection_threshold(out.spec) * (1 - 1e-4) and power[seen].max() <= 0.01 * (1 + 1e-4)


def test_echoes_of_a_moving_sensor_start_at_its_place_at_firing() -> None:
    sweep = street(spinning(16, range_max_m=30.0))
    times = np.array([-0.06, 0.06])
    path = Path(times, np.outer(times, [20.0, 0.0, 0.0]), np.zeros((2, 3)))
    still = corrupt(sweep, Crosstalk.severity(5), rng())[len(sweep) :]
    driven = corrupt(replace(sweep, path=path), Crosstalk.severity(5), rng())[len(sweep) :]
    shift = driven.points - still.points
    assert np.allclose(shift[:, 0], 20.0 * still.time_offset, atol=1e-4) and np.abs(shift[:, 1:]).max() < 1e-4


def test_files_without_a_sensor_columns_or_points() -> None:
    sweep = synth16()
    out = corrupt(sweep, Crosstalk.severity(3), rng())
    assert len(out) == len(sweep) and (out.fate == SCATTERED).any()
    assert len(corrupt(sweep[:0], Crosstalk.severity(5), rng())) == 0
    assert len(corrupt(sweep[:1], Crosstalk.severity(5), rng())) == 1
    blind = make_sweep(street().points, spec=spinning(), ring=street().ring)
    assert len(corrupt(blind, Crosstalk.severity(3), rng())) == len(blind)
    silent = corrupt(street()[:0], Crosstalk.severity(5), rng())
    assert 0 < len(silent) < 0.08 * 64 * 360


def test_no_pulses_no_change() -> None:
    sweep = street()
    assert corrupt(sweep, Crosstalk(share=0.0), rng()) is sweep
    with pytest.raises(SettingsError, match="share: expected 0 to 1, found"):
        Crosstalk(share=1.5)
