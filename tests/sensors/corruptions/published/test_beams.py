"""Beam missing and cross sensor as published."""

import itertools

import numpy as np
import pytest

from sensors.corruptions.physics.levels import DEFAULT_SEVERITY, SEVERITIES
from sensors.corruptions.published.beams import (
    PUBLISHED_BEAM_MISSING,
    PUBLISHED_CROSS_SENSOR,
    PaperBeamMissing,
    PaperCrossSensor,
    beam_missing,
    cross_sensor,
    deleted_rings,
    kept_points,
    missing_rings,
)
from sim.errors import SettingsError
from tests.sensors.corruptions.published.goldens import agrees, arrays, by_range, cloud, mask, table
from tests.sensors.corruptions.street import same, spinning, street

SEEDS = range(20)


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_a_legacy_generator_draws_the_beams_of_the_release() -> None:
    golden = table("beam_missing")["dsrc_code_seed1205/synth64"]
    missing = missing_rings(PUBLISHED_BEAM_MISSING["dsrc"], 64, np.random.RandomState(1205))
    assert sorted(missing) == golden["dropped"]
    assert np.count_nonzero(~np.isin(arrays("synth64")["ring"], missing)) == golden["n_out"]


@pytest.mark.parametrize(
    ("published", "golden"),
    [
        ("dsrc", "dsrc_code_32of64/synth64"),
        ("robo3d_light", "robo3d_kitti_light_16/synth64"),
        ("robo3d_moderate", "robo3d_kitti_moderate_32/synth64"),
        ("robo3d_heavy", "robo3d_kitti_heavy_48/synth64"),
    ],
)
def test_missing_beams_remove_as_many_points_as_in_the_release(published: str, golden: str) -> None:
    points, ring, theirs = cloud("synth64"), arrays("synth64")["ring"], table("beam_missing")[golden]
    drawn = [missing_rings(PUBLISHED_BEAM_MISSING[published], 64, rng(seed)) for seed in SEEDS]
    left = [points[~np.isin(ring, missing)] for missing in drawn]
    assert agrees([len(p) for p in left], theirs["n"])
    assert agrees([by_range(p) for p in left], theirs["range_hist"])
    if "n_distinct_rings_dropped" in theirs:
        assert agrees([len(np.unique(missing)) for missing in drawn], theirs["n_distinct_rings_dropped"])
        assert agrees([missing.min() for missing in drawn], theirs["min_ring"])
        assert agrees([missing.max() for missing in drawn], theirs["max_ring"])


def test_robo3d_spares_the_first_and_last_rings_of_any_sensor() -> None:
    heavy = PUBLISHED_BEAM_MISSING["robo3d_heavy"]
    for rings, first, last in ((64, 4, 58), (32, 2, 28)):
        drawn = np.concatenate([missing_rings(heavy, rings, rng(seed)) for seed in range(100)])
        assert (drawn.min(), drawn.max(), len(drawn)) == (first, last, 100 * rings * 3 // 4)


def test_the_text_has_half_of_the_beams_missing_that_the_code_has() -> None:
    assert PaperBeamMissing() == PaperBeamMissing.severity(DEFAULT_SEVERITY) == PUBLISHED_BEAM_MISSING["dsrc_text"]
    assert len(missing_rings(PaperBeamMissing(), 64, rng())) == 16
    assert len(missing_rings(PUBLISHED_BEAM_MISSING["dsrc"], 64, rng())) == 32


def test_beams_missing_at_a_severity_are_missing_at_the_next() -> None:
    sweep = street()
    left = [set(beam_missing(sweep, PaperBeamMissing.severity(severity), rng()).ring) for severity in SEVERITIES]
    assert all(a > b for a, b in itertools.pairwise(left))


def test_missing_beams_are_missing_whole_and_the_rest_stays() -> None:
    sweep = street()
    out = beam_missing(sweep, PaperBeamMissing.severity(4), rng())
    assert same(out, sweep[np.isin(sweep.ring, np.unique(out.ring))])
    assert same(beam_missing(sweep, PaperBeamMissing(rings_of_64=0), rng()), sweep)


@pytest.mark.parametrize("deleted", [16, 32, 48])
def test_a_cross_sensor_keeps_the_points_of_the_release(deleted: int) -> None:
    data, golden = arrays("synth64"), arrays("cross_sensor")
    kept = kept_points(data["xyz"], data["ring"], 64, PaperCrossSensor(rings_of_64=deleted))
    assert (kept == mask(golden[f"keep_synth64_{deleted}"], len(kept))).all()


@pytest.mark.parametrize(("rings", "number"), [(64, 16), (64, 32), (64, 48), (32, 8), (32, 16), (32, 24)])
def test_a_cross_sensor_lacks_the_rings_of_the_release(rings: int, number: int) -> None:
    assert (deleted_rings(rings, number) == arrays("cross_sensor")[f"drop_{rings}beam_{number}"]).all()


@pytest.mark.parametrize("mode", ["32", "32^", "16", "16^"])
@pytest.mark.parametrize("golden", ["keep_synth64_", "keep_truering_synth64_"])
def test_lidar_distillation_keeps_the_points_of_its_release(mode: str, golden: str) -> None:
    data = arrays("synth64")
    kept = kept_points(data["xyz"], data["ring"], 64, PUBLISHED_CROSS_SENSOR[f"lidar_distillation_{mode}"])
    assert (kept == mask(arrays("lidar_distillation")[golden + mode], len(kept))).all()


def test_the_default_is_the_released_code() -> None:
    sweep = street()
    assert PaperCrossSensor() == PaperCrossSensor.severity(DEFAULT_SEVERITY)
    assert same(
        cross_sensor(sweep, PaperCrossSensor.severity(DEFAULT_SEVERITY), rng()), sweep[sweep.ring % 2 == 0][::2]
    )


@pytest.mark.parametrize("rings", [1, 2, 16, 40, 300])
def test_a_cross_sensor_exists_for_any_sensor(rings: int) -> None:
    sweep = street(spinning(rings, columns=60))
    kept = [len(cross_sensor(sweep, PaperCrossSensor.severity(severity), rng())) for severity in SEVERITIES]
    assert all(a >= b for a, b in itertools.pairwise(kept))
    for settings in PUBLISHED_CROSS_SENSOR.values():
        assert len(cross_sensor(sweep, settings, rng())) <= len(sweep)


def test_empty_sweeps_stay_empty() -> None:
    for spec in (None, spinning(), spinning(1)):
        empty = street(spec)[:0]
        assert (
            len(beam_missing(empty, PaperBeamMissing(), rng()))
            == len(cross_sensor(empty, PaperCrossSensor(), rng()))
            == 0
        )


def test_impossible_settings_are_refused() -> None:
    with pytest.raises(SettingsError, match="rings_of_64"):
        PaperBeamMissing(rings_of_64=65)
    with pytest.raises(SettingsError, match="first_of_64"):
        PaperBeamMissing(first_of_64=30, after_of_64=30)
    with pytest.raises(SettingsError, match="keep_one_of"):
        PaperCrossSensor(keep_one_of=0)
