"""Cross sensor: fewer rings, coarser azimuth and less reach, with the phase of a real rotation."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from sensors.corruptions.cross_sensor import CrossSensor, corrupt, removed_rings
from sensors.presets import get_lidar
from sensors.sweep import make_sweep
from sim.errors import DataError, SettingsError
from tests.sensors.corruptions.street import same, spinning, street, synth16


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


BEAMS_ONLY = CrossSensor(reach=1.0)


def test_half_of_the_beams_and_half_of_the_firings_are_left() -> None:
    sweep = street()
    out = corrupt(sweep, BEAMS_ONLY, rng())
    assert same(out, sweep[(sweep.ring % 2 == 0) & (sweep.column % 2 == 0)])


@pytest.mark.parametrize("rings", [16, 32, 40, 128, 300])
def test_the_azimuth_step_doubles_within_every_ring(rings: int) -> None:
    sweep = street(spinning(rings, columns=720))
    out = corrupt(sweep, BEAMS_ONLY, rng())
    for ring in np.unique(out.ring):
        steps = [np.median(np.diff(np.unwrap(np.arctan2(*s.points[s.ring == ring, 1::-1].T)))) for s in (sweep, out)]
        assert np.isclose(steps[1], 2 * steps[0], rtol=1e-3)


def test_rings_keep_one_phase_where_beams_had_no_return() -> None:
    sweep = street(spinning(16, columns=720))
    holes = sweep[rng().random(len(sweep)) > 0.1]
    kept = {(r, c) for r, c in zip(holes.ring, holes.column, strict=True) if r % 2 == 0 and c % 2 == 0}
    out = corrupt(holes, BEAMS_ONLY, rng())
    assert set(zip(out.ring, out.column, strict=True)) == kept
    # A file without columns: which half is kept is free, but it is one half all round.
    bare = replace(holes, spec=None, column=np.zeros(len(holes), np.int32))
    found = {tuple(p) for p in corrupt(bare, BEAMS_ONLY, rng()).points}
    column = holes.column[[tuple(p) in found for p in holes.points]]
    assert np.unique(column % 2).size == 1 and len(found) > 0.45 * len(out)


@pytest.mark.parametrize("severity", range(1, 5))
def test_points_kept_at_a_severity_are_among_those_of_the_previous(severity: int) -> None:
    sweep = street()
    kept = [corrupt(sweep, CrossSensor.severity(level), rng()) for level in (severity, severity + 1)]
    more, less = ({tuple(p) for p in out.points} for out in kept)
    assert less < more


def test_the_reach_shrinks() -> None:
    sweep = street(spinning(64, range_10_m=40.0))
    out = corrupt(sweep, CrossSensor(rings_of_64=0, keep_one_of=1, reach=0.5), rng())
    assert out.range.max() <= 0.5 * sweep.spec.range_max_m
    # Half the reach is four times the light: what was seen with less to spare is gone.
    need = 0.1 / 20.0**2
    spare = out.intensity / out.range.astype(np.float64) ** 2 / need
    assert spare[out.intensity / out.range**2 > 0.1 / 40.0**2].min() > 0.98
    assert len(out) < len(sweep)


def test_dark_returns_of_an_uncalibrated_sensor_stay() -> None:
    sweep = replace(street(), intensity=np.zeros(len(street()), np.float32))
    near = sweep[sweep.range < 20.0]
    assert same(corrupt(near, CrossSensor(rings_of_64=0, keep_one_of=1, reach=0.5), rng()), near)


def test_another_sensor_has_its_own_beams_and_firings() -> None:
    sweep = street(get_lidar("pandar128"))
    target = get_lidar("vlp-16")
    out = corrupt(sweep, CrossSensor(target="vlp-16"), rng())
    elevation = np.degrees(sweep.spec.elevation)
    for ring in np.unique(out.ring):
        assert np.abs(np.array(target.elevation_deg) - elevation[ring]).min() < 0.51
    assert len(np.unique(out.ring)) <= 16
    assert out.range.max() <= target.range_max_m
    azimuth = np.degrees(sweep.spec.azimuth)
    assert 1700 < len(np.unique(out.column)) <= 1808
    assert {tuple(p) for p in out.points} < {tuple(p) for p in sweep.points}
    front = corrupt(sweep, CrossSensor(target="at128"), rng())
    assert np.abs(azimuth[front.column]).max() <= 60.0


def test_the_sensor_itself_as_a_target_keeps_everything() -> None:
    sweep = street(get_lidar("pandar64"))
    sweep = sweep[(sweep.range > 0.4) & (sweep.intensity > 0.06)]
    assert same(corrupt(sweep, CrossSensor(target="pandar64"), rng()), sweep)


def test_a_sensor_with_more_beams_adds_none() -> None:
    sweep = street(spinning(16))
    out = corrupt(sweep, CrossSensor(target="rs-ruby-plus"), rng())
    assert {tuple(p) for p in out.points} <= {tuple(p) for p in sweep.points}
    assert len(out) > 0.8 * len(sweep)


def test_no_change_and_no_points() -> None:
    sweep = street()
    assert same(corrupt(sweep, CrossSensor(rings_of_64=0, keep_one_of=1, reach=1.0), rng()), sweep)
    assert len(corrupt(sweep[:0], CrossSensor.severity(3), rng())) == 0
    assert len(corrupt(synth16()[:1], CrossSensor(target="vlp-16"), rng())) <= 1


@pytest.mark.parametrize(("rings", "removed"), [(64, 16), (64, 32), (64, 48), (16, 12), (40, 30), (300, 225), (5, 4)])
def test_removed_rings_are_distinct_and_leave_the_first(rings: int, removed: int) -> None:
    gone = removed_rings(rings, removed)
    assert len(set(gone)) == removed and gone.min() == 1 and gone.max() < rings
    kept = np.setdiff1d(np.arange(rings), gone)
    assert max(b - a for a, b in itertools.pairwise([*kept, rings])) <= -(-rings // (rings - removed))


def test_impossible_settings_are_refused_in_one_line() -> None:
    with pytest.raises(SettingsError, match="keep_one_of"):
        CrossSensor(keep_one_of=0)
    with pytest.raises(SettingsError, match="unknown lidar 'vlp-61'; did you mean 'vlp-16'"):
        CrossSensor(target="vlp-61")
    with pytest.raises(SettingsError, match="expected a sensor with rings, found livox-avia"):
        CrossSensor(target="livox-avia")
    rosette = make_sweep(np.ones((3, 3)), spec=get_lidar("livox-avia"))
    with pytest.raises(DataError, match="expected a sensor with rings, found livox-avia"):
        corrupt(rosette, CrossSensor(target="vlp-16"), rng())
    with pytest.raises(DataError, match="cross_sensor: expected points with their rings"):
        corrupt(make_sweep(rng().normal(0.0, 10.0, (500, 3))), CrossSensor.severity(3), rng())
