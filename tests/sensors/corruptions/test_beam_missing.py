"""Beam missing: dead rings, the same ones for a drive."""

import itertools

import numpy as np
import pytest

from sensors.corruptions.beam_missing import BeamMissing, corrupt
from sensors.sweep import make_sweep
from sim.errors import DataError, SettingsError
from tests.sensors.corruptions.street import same, spinning, street, synth16


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.mark.parametrize(("rings", "lost"), [(64, 16), (32, 8), (16, 4), (40, 10), (128, 32), (300, 75)])
def test_a_quarter_of_the_beams_is_missing_on_any_sensor(rings: int, lost: int) -> None:
    sweep = street(spinning(rings, columns=90))
    present = len(np.unique(sweep.ring))
    out = corrupt(sweep, BeamMissing.severity(3), rng())
    # Rings that only see the sky may be among the missing ones.
    assert present - lost <= len(np.unique(out.ring)) <= present - lost + (rings - present)


@pytest.mark.parametrize("severity", range(1, 6))
def test_the_number_of_missing_rings_is_exact(severity: int) -> None:
    sweep = synth16()
    for seed in range(20):
        missing = 16 - len(np.unique(corrupt(sweep, BeamMissing.severity(severity), rng(seed)).ring))
        assert missing == round(BeamMissing.LEVELS["rings_of_64"][severity - 1] / 4)


def test_missing_beams_take_all_their_points_and_no_others() -> None:
    sweep = street()
    out = corrupt(sweep, BeamMissing.severity(3), rng())
    assert same(out, sweep[np.isin(sweep.ring, np.unique(out.ring))])


def test_every_beam_is_equally_likely_to_be_missing() -> None:
    sweep = synth16()
    times = np.zeros(16)
    for seed in range(400):
        times[np.unique(corrupt(sweep, BeamMissing.severity(3), rng(seed)).ring)] += 1
    assert abs(times / 400 - 0.75).max() < 0.1


def test_beams_missing_at_a_severity_are_missing_at_the_next() -> None:
    sweep = street()
    left = [set(corrupt(sweep, BeamMissing.severity(severity), rng()).ring) for severity in range(1, 6)]
    assert all(a > b for a, b in itertools.pairwise(left))


def test_points_without_rings_lose_the_same_beams_as_with_them() -> None:
    sweep = synth16()
    for seed in range(5):
        out = corrupt(make_sweep(sweep.points), BeamMissing.severity(3), rng(seed))
        assert len(np.unique(sweep.ring[np.isin(sweep.points[:, 2], out.points[:, 2])])) >= 12
        lost = {tuple(p) for p in sweep.points} - {tuple(p) for p in out.points}
        rings = [ring for ring in range(16) if tuple(sweep.points[sweep.ring == ring][0]) in lost]
        assert len(rings) == 4
        assert len(lost) == np.isin(sweep.ring, rings).sum()


def test_a_dead_beam_stays_dead_while_others_have_no_points() -> None:
    whole = make_sweep(synth16().points)
    part = whole[np.isin(synth16().ring, [0, 3, 4], invert=True)]
    seen = {tuple(p) for p in part.points}
    dead, dead_there = (
        {tuple(p) for p in s.points} - {tuple(p) for p in corrupt(s, BeamMissing.severity(3), rng(3)).points}
        for s in (whole, part)
    )
    # Rings die in one order: a quarter of those that are seen may be one ring more or less, never others.
    assert dead_there and (dead & seen <= dead_there or dead_there <= dead)


def test_no_or_all_beams_can_be_missing() -> None:
    sweep = street()
    assert same(corrupt(sweep, BeamMissing(rings_of_64=0), rng()), sweep)
    assert len(corrupt(sweep, BeamMissing(rings_of_64=64), rng())) == 0


def test_points_that_have_no_rings_are_refused() -> None:
    with pytest.raises(DataError, match="beam_missing: expected points with their rings, found a sweep without"):
        corrupt(make_sweep(rng().normal(0.0, 10.0, (500, 3))), BeamMissing.severity(3), rng())


def test_too_many_rings_are_refused_in_one_line() -> None:
    with pytest.raises(SettingsError, match="rings_of_64: expected 0 to 64, found 65"):
        BeamMissing(rings_of_64=65)
