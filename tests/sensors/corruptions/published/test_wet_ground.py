"""Wet ground as published."""

import itertools

import numpy as np
import pytest

from sensors.corruptions.physics.levels import DEFAULT_SEVERITY, SEVERITIES
from sensors.corruptions.published.ground import FittedGround, Plane, fit_plane, ground_of, labelled_ground
from sensors.corruptions.published.wet_ground import (
    AIR,
    PUBLISHED,
    WATER,
    PaperWetGround,
    apply_wet_ground,
    corrupt,
    film,
    fresnel,
)
from sensors.sweep import ATTENUATED, KEPT, POINT_FIELDS
from sim.errors import SettingsError
from tests.sensors.corruptions.published.goldens import arrays, by_range, cloud, mask, table
from tests.sensors.corruptions.street import rows_of, same, spinning, street

GROUND_LABELS = (40, 44, 48, 49)


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def on_255(name: str) -> np.ndarray:
    points = cloud(name.split("_")[0]).astype(np.float64)
    if "carla" in name:
        points[:, 3] = np.exp(-0.004 * np.linalg.norm(points[:, :3], axis=1))
    points[:, 3] = np.round(255.0 * points[:, 3])
    return points


def settings_of(case: str) -> PaperWetGround:
    """Read `..._wh0.001_nf0.7...`: height of the water in m, factor of the noise."""
    water, factor = case.split("_wh" if "_wh" in case else "wh")[1].split("/")[0].split("_nf")
    return PaperWetGround(water_mm=1e3 * float(water), noise_factor=float(factor))


def test_amplitudes_are_the_published_ones() -> None:
    golden = arrays("fresnel")
    for name, reflected in zip("sp", fresnel(golden["angle"], AIR, WATER), strict=True):
        assert np.allclose(reflected, golden[f"fresnel_amp_r{name}"], atol=1e-12)
        assert np.allclose(reflected**2, golden[f"fresnel_pow_r{name}"], atol=1e-12)
        assert np.allclose(1 - reflected**2, golden[f"fresnel_pow_t{name}"], atol=1e-12)


def test_the_film_scatters_as_published() -> None:
    golden = arrays("fresnel")
    found = film(golden["angle"], golden["rho"][:, None])
    for name, values in zip(("ts", "tp"), found, strict=True):
        assert np.allclose(np.broadcast_to(values, (8, 17)), golden[f"total_{name}"], rtol=1e-9)


def exact_cases() -> list[str]:
    return sorted(key.removesuffix("_int_kept") for key in arrays("wet_ground") if key.endswith("_int_kept"))


@pytest.mark.parametrize("given", [True, False])
@pytest.mark.parametrize("case", exact_cases())
def test_the_points_of_the_release_stay_and_have_its_intensities(case: str, given: bool) -> None:
    golden, before = arrays("wet_ground"), on_255("synth16")
    ground = ground_of(before, Plane(golden["plane"][:3], golden["plane"][3]))
    # The golden's noise line has its factor of 0.7 in it.
    line = np.polyfit(ground.range_m, golden["adaptive_threshold"] / 0.7, 1)
    fits = {"intensity_fit": golden["linear_fit"], "noise_fit": line} if given else {}
    wet = apply_wet_ground(before, settings_of(case), ground, **fits)
    assert (wet.ground == mask(golden["ground"], len(before))).all()
    assert (wet.kept[wet.ground] == mask(golden[f"{case}_kept_of_ground"], wet.ground.sum())).all()
    assert np.allclose(wet.intensity[wet.ground & wet.kept], golden[f"{case}_int_kept"], atol=1e-4)
    assert wet.kept[~wet.ground].all() and (wet.intensity[~wet.ground] == before[~wet.ground, 3]).all()


@pytest.mark.parametrize("case", [case for case in table("wet_ground") if case.startswith("hahner")])
def test_a_whole_cloud_loses_the_same_points_as_in_the_release(case: str) -> None:
    theirs, before = table("wet_ground")[case], on_255(case.split("/")[1])
    wet = apply_wet_ground(before, settings_of(case), ground_of(before, fit_plane(before, np.random.RandomState(0))))
    left = wet.ground & wet.kept
    assert (wet.ground.sum(), left.sum(), wet.kept.sum()) == (
        theirs["n_ground"],
        theirs["n_ground_kept"],
        theirs["n_out"],
    )
    assert by_range(before[left]).tolist() == theirs["ground_kept_by_range"]
    if left.any():
        assert np.isclose(wet.intensity[left].mean(), theirs["mean_int_ground_kept_out"], rtol=1e-6)


@pytest.mark.parametrize("level", ["light", "moderate", "heavy"])
def test_labelled_ground_loses_the_same_points_as_in_robo3d(level: str) -> None:
    settings = PUBLISHED[f"robo3d_semantickitti_{level}"]
    case = f"robo3d_semkitti_{level}_wh{settings.water_mm / 1e3:g}_nf{settings.noise_factor}/synth64"
    label, before = arrays("synth64")["label"], cloud("synth64").astype(np.float64)
    wet = apply_wet_ground(before, settings, labelled_ground(before, np.isin(label, GROUND_LABELS)))
    counts = {key: int((wet.kept & (label == int(key))).sum()) for key in ("40", "48")}
    assert counts == {key: table("wet_ground")[case]["class_counts"][key] for key in ("40", "48")}
    assert wet.kept.sum() == table("wet_ground")[case]["n"]


@pytest.mark.parametrize("level", ["light", "moderate", "heavy"])
def test_ground_by_plane_loses_as_many_points_as_in_robo3d(level: str) -> None:
    settings = PUBLISHED[f"robo3d_kitti_{level}"]
    case = f"robo3d_kitti_{level}_wh{settings.water_mm / 1e3:g}_nf{settings.noise_factor}/synth64"
    before = cloud("synth64").astype(np.float64)
    left = apply_wet_ground(before, settings, ground_of(before, fit_plane(before, rng()))).kept.sum()
    assert abs(left / table("wet_ground")[case]["n"] - 1) < 0.005  # their plane's draws are not known


def test_only_ground_is_touched_and_never_brightened() -> None:
    sweep = street(spinning(columns=720))
    out = corrupt(sweep, PaperWetGround.severity(DEFAULT_SEVERITY), rng())
    row = rows_of(out, sweep)
    touched = out.fate == ATTENUATED
    assert touched.any() and len(out) < len(sweep)
    assert (out.points == sweep.points[row]).all()
    assert (out.intensity <= sweep.intensity[row] + 1e-6).all()
    assert (out.intensity[~touched] == sweep.intensity[row][~touched]).all() and (out.fate[~touched] == KEPT).all()
    assert np.abs(out.points[touched, 2] + 1.9).max() < 0.6


def test_behind_a_lorry_only_known_ground_gets_wet() -> None:
    sweep = street(spinning(columns=720))
    ahead = (sweep.points[:, 0] > 8.0) & (np.abs(sweep.points[:, 1]) < 3.5)
    sweep = sweep[~ahead]
    assert same(corrupt(sweep, PaperWetGround(), rng()), sweep)
    out = corrupt(sweep, PaperWetGround(labelled=True), rng())
    touched = out.fate == ATTENUATED
    assert touched.sum() > 1000 and np.abs(out.points[touched, 2] + 1.9).max() < 0.6
    assert {name for name, settings in PUBLISHED.items() if settings.labelled} == {
        f"robo3d_{data}_{level}" for data in ("semantickitti", "nuscenes") for level in ("light", "moderate", "heavy")
    }


def test_more_water_takes_more() -> None:
    sweep = street(spinning(columns=720))
    left = [corrupt(sweep, PaperWetGround.severity(severity), rng()) for severity in SEVERITIES]
    kept = [set(rows_of(out, sweep).tolist()) for out in left]
    assert all(a >= b for a, b in itertools.pairwise(kept)) and len(kept[0]) > len(kept[-1])
    assert PaperWetGround() == PaperWetGround.severity(DEFAULT_SEVERITY) == PUBLISHED["hahner"]


def test_little_ground_stays_dry() -> None:
    points = np.tile([20.0, 0.0, -1.8, 100.0], (999, 1))
    flat = FittedGround(np.ones(999, bool), np.full(999, 20.08), np.full(999, 0.09))
    wet = apply_wet_ground(points, PaperWetGround(), flat)
    assert wet.kept.all() and (wet.intensity == 100.0).all()


def test_no_water_and_no_points_are_legal() -> None:
    sweep = street(spinning(16))
    assert same(corrupt(sweep, PaperWetGround(water_mm=0.0), rng()), sweep)
    for few in (sweep[:0], sweep[:1]):
        out = corrupt(few, PaperWetGround.severity(5), rng())
        assert len(out) == len(few)
        assert all(getattr(out, name).dtype == getattr(few, name).dtype for name in POINT_FIELDS)
    with pytest.raises(SettingsError, match="water_mm"):
        PaperWetGround(water_mm=-1.0)
