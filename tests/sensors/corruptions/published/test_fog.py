"""Fog as published."""

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from sensors.corruptions.physics.levels import DEFAULT_SEVERITY, SEVERITIES
from sensors.corruptions.published import fog
from sensors.corruptions.published.fog import (
    BACKSCATTER_FIXED,
    EXTINCTIONS,
    PUBLISHED,
    PaperFog,
    apply_fog,
    backscatter_of,
    compute_table,
    corrupt,
    fog_table,
    hahner,
)
from sensors.sweep import ADDED, ATTENUATED, POINT_FIELDS, SCATTERED
from sim.errors import SettingsError
from tests.sensors.corruptions.published.goldens import agrees, arrays, cloud, mask, table
from tests.sensors.corruptions.street import on_a_ray, same, spinning, street

# alpha -> range of the peak (m) and integral (1e-9 s/m^2) beyond 4.8 m, as read from the published tables.
FAR = {
    0.0: (4.7024, 4.6446),
    0.005: (4.7024, 4.5680),
    0.01: (4.7024, 4.4928),
    0.02: (4.7024, 4.3466),
    0.03: (4.7024, 4.2058),
    0.06: (4.6023, 3.8156),
    0.1: (4.6023, 3.3621),
    0.12: (4.6023, 3.1584),
    0.15: (4.6023, 2.8786),
    0.2: (4.5023, 2.4760),
}
MOVES_BEYOND_M = {
    0.008: (92.6, 66.9, 54.6, 41.7, 34.6, 24.1),
    0.05: (37.1, 31.9, 28.4, 23.8, 20.9, 15.9),
    0.2: (18.6, 17.2, 16.1, 14.4, 13.2, 10.8),
}


@pytest.fixture(autouse=True, scope="module")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DSRC_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def on_255(points: np.ndarray) -> np.ndarray:
    out = points.astype(np.float64)
    out[:, 3] = np.round(255.0 * out[:, 3])
    return out


@pytest.mark.parametrize("alpha", FAR)
def test_the_table_is_the_published_one(alpha: float) -> None:
    found = compute_table(alpha, 2e-8)
    place, integral = FAR[alpha]
    assert len(found.range_m) == len(found.integral) == 2001
    assert np.allclose(found.range_m[48:], place, atol=6e-5)
    assert np.allclose(found.integral[48:], integral * 1e-9, rtol=2e-5)
    assert (found.integral[:11] == 0).all() and (found.range_m[:11] == 0).all()  # nothing below 1.1 m
    assert (np.diff(found.integral) >= 0).all() and (found.range_m <= np.arange(2001) * 0.1 + 1e-9).all()


def test_a_table_is_computed_once_and_read_from_then_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DSRC_CACHE", str(tmp_path))
    first = fog_table(0.0123)
    assert list(tmp_path.rglob("*.npz"))
    fog_table.cache_clear()
    monkeypatch.setattr(fog, "compute_table", lambda *_: pytest.fail("computed again"))
    again = fog_table(0.0123)
    assert all((a == b).all() for a, b in zip(first, again, strict=True))


def golden_cases() -> list[str]:
    return sorted(key.removesuffix("_fogmask") for key in arrays("fog_pointwise") if key.endswith("_fogmask"))


@pytest.mark.parametrize("case", golden_cases())
def test_the_points_of_the_release_move_and_have_its_intensities(case: str) -> None:
    golden = arrays("fog_pointwise")
    before = cloud("synth64")[golden["synth64_index"]]
    alpha = float(case.split("_a")[1].split("_")[0])
    if case.startswith("dsrc"):
        settings = PaperFog(extinction=alpha, backscatter=float(case.split("_b")[1]), noise=0.0)
    else:
        settings, before = replace(hahner(alpha), noise=0.0), on_255(before)
    out, moved = apply_fog(before, settings, rng())
    assert (moved == mask(golden[f"{case}_fogmask"], len(before))).all()
    assert (out[~moved, :3] == before[~moved, :3]).all()
    if f"{case}_intensity" in golden:
        assert np.allclose(out[:, 3], golden[f"{case}_intensity"], rtol=1e-6, atol=1e-6)
    if f"{case}_xyzi" in golden:
        assert np.allclose(out, golden[f"{case}_xyzi"], atol=2e-6)


def test_gain_makes_the_brightest_point_255() -> None:
    golden = arrays("fog_pointwise")
    before = cloud("synth64")[golden["synth64_index"]]
    out, _ = apply_fog(before, PaperFog(extinction=0.06, backscatter=0.2, noise=0.0, gain=True), rng())
    assert np.allclose(out[:, 3], golden["dsrc_synth64_a0.06_b0.2_gain_intensity"], rtol=1e-6)


@pytest.mark.parametrize("coupling", ["betafix", "betamor"])
@pytest.mark.parametrize("scale", ["255", "01"])
@pytest.mark.parametrize("alpha", [0.005, 0.01, 0.02, 0.03, 0.06, 0.1, 0.12, 0.15, 0.2])
def test_beta_fixed_or_coupled_moves_as_many_points(alpha: float, scale: str, coupling: str) -> None:
    golden = table("fog_pointwise")[f"hahner_synth64_{scale}_a{alpha}_{coupling}"]
    before = cloud("synth64")[arrays("fog_pointwise")["synth64_index"]]
    settings = replace(hahner(alpha, coupled=coupling == "betamor"), noise=0.0)
    out, moved = apply_fog(on_255(before) if scale == "255" else before, settings, rng())
    assert np.isclose(settings.backscatter, golden["beta"], rtol=1e-12)
    assert moved.sum() == golden["n_fog"]
    assert np.isclose(out[:, 3].mean(), golden["mean_int"], rtol=1e-6)


def test_beta_is_stuck_at_one_extinction() -> None:
    assert np.isclose(BACKSCATTER_FIXED, arrays("fog_theory")["beta_default"], rtol=1e-12)
    assert backscatter_of(0.03) == pytest.approx(BACKSCATTER_FIXED / 2)


@pytest.mark.parametrize("beta", MOVES_BEYOND_M)
def test_all_beyond_one_range_moves_however_bright(beta: float) -> None:
    reach = np.arange(5.0, 110.0, 0.1)
    for alpha, limit in zip(EXTINCTIONS, MOVES_BEYOND_M[beta], strict=True):
        for intensity in (0.02, 1.0):
            points = np.column_stack([reach, 0 * reach, 0 * reach, np.full(len(reach), intensity)])
            moved = apply_fog(points, PaperFog(extinction=alpha, backscatter=beta), rng()).moved
            assert abs(reach[moved.argmax()] - limit) < 0.1 and (np.diff(moved.astype(int)) >= 0).all()


def noise_cases() -> list[str]:
    return [key for key in table("fog_noise") if "noise10" in key]


@pytest.mark.parametrize("case", noise_cases())
def test_noise_spreads_the_fog_as_published(case: str) -> None:
    theirs, before = table("fog_noise")[case], cloud("synth64")[::4]
    alpha, variant = float(case.split("_a")[1].split("_")[0]), case.split("noise10_")[1][:2]
    if case.startswith("dsrc"):
        beta = float(case.split("_b")[1].split("_")[0])
        settings = PaperFog(extinction=alpha, backscatter=beta, variant=variant)  # type: ignore[arg-type]
    else:
        settings, before = hahner(alpha), on_255(before)
    reach = np.linalg.norm(before[:, :3].astype(np.float64), axis=1)
    counts, middle = [], []
    for seed in range(20):
        out, moved = apply_fog(before, settings, rng(seed))
        ahead = np.sign((out[:, :3] * before[:, :3]).sum(axis=1))
        place = ahead * np.linalg.norm(out[:, :3], axis=1)
        counts.append([moved.sum(), (place[moved] < 0).sum(), (place[moved] > reach[moved]).sum()])
        if moved.any():
            middle.append(np.quantile(place[moved], [0.05, 0.25, 0.5, 0.75, 0.95]))
    for k, name in enumerate(("n_fog", "n_fog_flipped", "n_fog_beyond_orig")):
        assert agrees([c[k] for c in counts], theirs[name])
    if middle:
        # The golden's quantiles are those of 0, 1, 5, 25, 50, 75, 95, 99 and 100 %.
        quantiles = {key: theirs["fog_signed_range_quantiles"][key][2:7] for key in ("mean", "std")}
        assert agrees(middle, quantiles)


def test_each_moved_point_takes_one_draw_in_order() -> None:
    before = cloud("synth16").astype(np.float64)
    settings = PaperFog(extinction=0.06, backscatter=0.05)
    out, moved = apply_fog(before, settings, rng())
    in_turn, reach = rng(), np.linalg.norm(before[:, :3], axis=1)
    for row in np.flatnonzero(moved)[:200]:
        place = fog_table(0.06).range_m[2000 if reach[row] > 200 else round(reach[row] * 10)]
        factor = place / in_turn.uniform(reach[row] - 10.0, reach[row] + 10.0)
        assert np.allclose(out[row, :3], before[row, :3] * factor, rtol=1e-12)


def test_a_sweep_keeps_its_points_on_their_rays() -> None:
    sweep = street(spinning(16))
    out = corrupt(sweep, PaperFog(extinction=0.06, backscatter=0.05, noise=0.0), rng())
    moved = out.fate == SCATTERED
    assert len(out) == len(sweep) and 0 < moved.sum() < len(sweep)
    assert (out.fate[~moved] == ATTENUATED).all() and (out.points[~moved] == sweep.points[~moved]).all()
    assert ((out.object_id == ADDED) == moved).all() and out.intensity.max() <= 1.0
    cross = np.cross(out.points[moved], sweep.points[moved])
    assert np.linalg.norm(cross, axis=1).max() < 1e-3
    assert (out.range[moved] < sweep.range[moved]).all()


def test_agents_draw_their_own_extinction_unless_one_is_set() -> None:
    sweep = on_a_ray(np.full(50, 10.0), 0.5)
    seen = {
        round(float(corrupt(sweep, PaperFog.severity(DEFAULT_SEVERITY), rng(seed)).intensity[0]), 6)
        for seed in range(60)
    }
    assert seen == {round(0.5 * float(np.exp(-20.0 * alpha)), 6) for alpha in EXTINCTIONS}


def test_fog_takes_more_at_each_severity() -> None:
    sweep = street(spinning(16))
    taken = [corrupt(sweep, PaperFog.severity(severity), rng(3)).fate == SCATTERED for severity in SEVERITIES]
    assert all((b >= a).all() for a, b in itertools.pairwise(taken)) and taken[-1].sum() > taken[0].sum()
    assert PaperFog() == PaperFog.severity(DEFAULT_SEVERITY) == PUBLISHED["dsrc"]


def test_scaled_intensities_come_back() -> None:
    sweep = street(spinning(16))
    out = corrupt(sweep, hahner(0.01), rng())
    kept = out.fate == ATTENUATED
    expected = np.round(255.0 * sweep.intensity * np.exp(-0.02 * sweep.range)) / 255.0
    assert np.allclose(out.intensity[kept], expected[kept], atol=1.01 / 255)


def test_no_fog_and_no_points_are_legal() -> None:
    sweep = street(spinning(16))
    assert same(corrupt(sweep, PaperFog(extinction=0.0, backscatter=0.0), rng()), sweep)
    for few in (sweep[:0], sweep[:1], on_a_ray(np.array([0.0, 0.5, 300.0]))):
        out = corrupt(few, PaperFog.severity(5), rng())
        assert len(out) == len(few) and np.isfinite(out.points).all()
        assert all(getattr(out, name).dtype == getattr(few, name).dtype for name in POINT_FIELDS)
    with pytest.raises(SettingsError, match="backscatter"):
        PaperFog(backscatter=-1.0)
