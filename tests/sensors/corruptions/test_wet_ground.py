"""Wet ground: darker by Fresnel and film, never brighter, and only the ground."""

import itertools
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sensors.corruptions.physics.ground import find_ground
from sensors.corruptions.physics.receiver import detection_threshold
from sensors.corruptions.spray import Spray
from sensors.corruptions.wet_ground import WetGround, corrupt, transmission
from sensors.optics.reflectance import wet_reflectivity
from sensors.sweep import ATTENUATED, KEPT, UNKNOWN_MATERIAL, Sweep
from sim.errors import SettingsError
from sim.mesh.materials import MATERIALS
from tests.sensors.corruptions.drives import MATERIAL, World, street_drive, worlds
from tests.sensors.corruptions.street import FIXTURES, same, spinning, street, synth16

DETECTS_ALL = float("inf")


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def road(reflectivity: float = 0.15, material: str = "asphalt") -> Sweep:
    """A street whose road has one material, measured by the law of diffuse surfaces."""
    steep = tuple(np.linspace(3.0, -89.0, 128).tolist())
    sweep = street(msgspec.structs.replace(spinning(128, columns=90), elevation_deg=steep))
    ground = find_ground(sweep)
    kind, cosine = np.full(len(sweep), MATERIAL["plaster"], np.uint8), np.ones(len(sweep), np.float32)
    kind[ground.rows], cosine[ground.rows] = MATERIAL[material], ground.cosine
    return replace(sweep, material=kind, cosine=cosine, intensity=(reflectivity * np.sqrt(cosine)).astype(np.float32))


def left(sweep: Sweep, water_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the ground and what is left of their intensity, nothing lost."""
    out = corrupt(sweep, WetGround(water_mm=water_mm, range_10_m=DETECTS_ALL), rng())
    rows = np.flatnonzero(out.fate == ATTENUATED)
    return rows, out.intensity[rows] / sweep.intensity[rows]


def test_transmission_is_fresnels() -> None:
    golden = np.load(Path(FIXTURES) / "fresnel.npz")
    expected = 0.5 * (golden["fresnel_pow_ts"] + golden["fresnel_pow_tp"])
    assert np.allclose(transmission(np.cos(golden["angle"])), expected, rtol=0, atol=1e-9)
    reflected = 0.5 * (golden["fresnel_pow_rs"] + golden["fresnel_pow_rp"])
    assert np.allclose(transmission(np.cos(golden["angle"])) + reflected, 1.0, atol=1e-9)


def test_a_full_film_at_normal_incidence_darkens_as_by_lekner_and_dorf() -> None:
    sweep = road()
    rows, share = left(sweep, 3.0)
    square = np.abs(sweep.cosine[rows]) > 0.8
    absorbed = np.exp(-2.0 * 0.0068 * 3.0)
    assert square.any() and np.allclose(share[square], absorbed * wet_reflectivity(0.15) / 0.15, rtol=0.03)


def test_grazing_light_is_mirrored_away() -> None:
    sweep = road()
    rows, share = left(sweep, 3.0)
    order = np.argsort(sweep.cosine[rows])
    assert (np.diff(share[order]) > -1e-3).all()
    assert share[order][0] < 0.1 < 0.5 < share[order][-1]


def test_water_hides_the_beads_of_lane_paint() -> None:
    sweep = road(0.55, "marking")
    rows, share = left(sweep, 3.0)
    glancing = sweep.cosine[rows] < 0.1
    paint = wet_reflectivity(MATERIALS[MATERIAL["marking"]].reflectivity) / MATERIALS[MATERIAL["marking"]].reflectivity
    # What beads add at a glancing angle, cosine^-0.25, is gone.
    assert (share[glancing] < paint * sweep.cosine[rows][glancing] ** 0.25).all()


@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(world=worlds, severity=st.integers(1, 5), seed=st.integers(0, 100))
def test_only_the_ground_changes_and_none_of_it_is_brighter(world: World, severity: int, seed: int) -> None:
    sweep = world.sweep()
    out = corrupt(sweep, WetGround.severity(severity), rng(seed))
    ground = np.zeros(len(sweep), bool)
    ground[find_ground(sweep).rows] = True
    everything = corrupt(sweep, WetGround.severity(severity), rng(seed))
    assert same(out, everything)
    whole = corrupt(sweep, WetGround(water_mm=WetGround.severity(severity).water_mm, range_10_m=DETECTS_ALL), rng(seed))
    assert len(whole) == len(sweep) and same(whole[~ground], sweep[~ground])
    assert (whole.intensity <= sweep.intensity).all() and (whole.points == sweep.points).all()
    assert (whole.fate[ground] == ATTENUATED).all()
    assert len(out) >= (~ground).sum()


def test_more_water_keeps_fewer_and_darker_points() -> None:
    for sweep in (road(), synth16(), street_drive()[1].agents[0].sweep):
        outs = [corrupt(sweep, WetGround.severity(severity), rng()) for severity in range(1, 6)]
        kept = [{tuple(p) for p in out.points} for out in outs]
        assert all(a >= b for a, b in itertools.pairwise(kept))
        light = [float(out.intensity.sum()) for out in outs]
        assert all(a > b for a, b in itertools.pairwise(light))
    assert len(kept[0]) > len(kept[-1]) or len(outs[0]) == len(sweep)


def test_returns_below_the_detection_threshold_are_lost() -> None:
    sweep = road()
    out = corrupt(sweep, WetGround.severity(5), rng())
    assert len(out) < len(sweep)
    seen = sweep[sweep.intensity / sweep.range**2 > detection_threshold(sweep.spec)]
    out = corrupt(seen, WetGround.severity(5), rng())
    power = out.intensity / out.range.astype(np.float64) ** 2
    assert power[out.fate == ATTENUATED].min() >= detection_threshold(sweep.spec) * (1 - 1e-5)
    assert out.range[out.fate == ATTENUATED].max() < 0.9 * seen.range[seen.material == MATERIAL["asphalt"]].max()


def test_ground_of_uninformative_intensity_is_lost_by_chance() -> None:
    sweep = replace(road(), intensity=np.zeros(len(road()), np.float32))
    ground = sweep.material == MATERIAL["asphalt"]
    share = left(road(), 1.2)[1].mean()
    out = corrupt(sweep, WetGround(water_mm=1.2), rng())
    assert (out.material == MATERIAL["asphalt"]).sum() == pytest.approx(share * ground.sum(), rel=0.05)


def test_files_without_materials_lose_the_same_points() -> None:
    sweep = road()
    bare = replace(
        sweep, material=np.full(len(sweep), UNKNOWN_MATERIAL, np.uint8), cosine=np.zeros(len(sweep), np.float32)
    )
    (rows, share), (found, guessed) = left(sweep, 1.2), left(bare, 1.2)
    both = np.intersect1d(rows, found)
    assert len(both) > 0.98 * len(rows)
    assert np.allclose(share[np.isin(rows, both)], guessed[np.isin(found, both)], atol=0.01)


def test_no_water_no_ground_and_no_points() -> None:
    sweep = street()
    assert corrupt(sweep, WetGround(water_mm=0.0), rng()) is sweep
    sky = sweep[sweep.points[:, 2] > 0.0]
    assert same(corrupt(sky, WetGround.severity(5), rng()), sky)
    assert (
        len(corrupt(sweep[:0], WetGround.severity(5), rng())) == 0
        and len(corrupt(sweep[:1], WetGround.severity(5), rng())) == 1
    )
    assert (corrupt(synth16(), WetGround.severity(1), rng()).fate == KEPT).any()
    with pytest.raises(SettingsError, match="water_mm: expected 0 to 100, found -1"):
        WetGround(water_mm=-1.0)
    assert WetGround(water_mm=1.0).scaled(1.1).water_mm == pytest.approx(1.1)


@pytest.mark.parametrize("kind", [WetGround, Spray])
def test_weather_that_drifts_stays_within_its_bound(kind: type[WetGround] | type[Spray]) -> None:
    assert kind(water_mm=100.0).scaled(1.15) == kind(water_mm=100.0)
    assert kind(water_mm=1.0).scaled(1.15).water_mm == pytest.approx(1.15)
