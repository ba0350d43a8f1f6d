"""Snow as published."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from sensors.corruptions.physics.levels import DEFAULT_SEVERITY, SEVERITIES
from sensors.corruptions.published.ground import fit_plane, ground_of, noise_floor, noise_line
from sensors.corruptions.published.rings import elevation_bin
from sensors.corruptions.published.snow import (
    DIMMED,
    MOVED,
    PUBLISHED,
    UNTOUCHED,
    PaperSnow,
    _peaks,
    apply_snow,
    corrupt,
    read_calibration,
)
from sensors.corruptions.published.snow_discs import disc_sample
from sensors.sweep import ADDED, ATTENUATED, KEPT, POINT_FIELDS, SCATTERED
from sim.errors import DataError, SettingsError, notice
from tests.sensors.corruptions.published.goldens import cloud, table
from tests.sensors.corruptions.street import few_discs, on_a_ray, rows_of, same, shared, spinning, street

SNOWS = {"light": (0.5, 2.0), "moderate": (1.0, 1.6), "heavy": (2.5, 1.6)}
NO_FLOOR = PaperSnow(noise_factor=None)
VARIANTS = {
    "dsrc": NO_FLOOR,
    "dsrc_fixed_hard_power": PaperSnow(noise_factor=None, own_power=True),
    "hahner": PaperSnow(noise_factor=None, last_bin=True, darkest=True),
}


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def calibrated(settings: PaperSnow) -> PaperSnow:
    return replace(settings, calibration=str(shared("snow/hdl64_calib_focal.npz")))


def flake(range_m: float, share: float, divergence: float = 0.003) -> np.ndarray:
    """A disc on the x axis that takes a share of a beam along it."""
    return np.array([[range_m, 0.0, range_m * np.sin(0.5 * share * divergence)]])


def beam(
    range_m: float, intensity: float, discs: np.ndarray, settings: PaperSnow, channel: int = 10
) -> tuple[int, float, float]:
    """Return label, range and intensity of one point on the x axis."""
    out = apply_snow(np.array([[range_m, 0.0, 0.0, intensity]]), np.array([channel]), lambda _: discs, settings)
    return int(out.label[0]), float(out.cloud[0, 0]), float(out.cloud[0, 3])


def given(particles: np.ndarray, _: int) -> np.ndarray:
    return particles


@pytest.mark.parametrize("variant", VARIANTS)
def test_single_beams_come_out_as_published(variant: str) -> None:
    settings = calibrated(VARIANTS[variant])
    for case in json.loads(shared("snow/single_beam.json").read_text()):
        point, particles = np.array([case["point"][:4]]), np.array(case["particles"])
        out = apply_snow(point, np.array([case["channel"]]), partial(given, particles), settings)
        assert out.label[0] == case[variant]["label"]
        assert np.allclose(out.cloud[0], case[variant]["xyzI"], rtol=0, atol=1e-9)


def test_an_echo_has_the_published_power_in_every_bin() -> None:
    for case in table("snow_formulas")["received_power"]:
        amplitude = case["CA_P0"] * table("snow_formulas")["beta_0"] * case["ratio"] / case["r_j"] ** 2
        amplitude *= min(1.0, max(0.0, (case["r_j"] - 0.9) / 0.1))
        expected = np.array(case["power_start_to_end_inclusive"])
        power, peak = _peaks(np.array([0]), np.array([case["r_j"]]), np.array([amplitude]), True)
        assert np.isclose(power[0], expected.max(), rtol=1e-9) and peak[0] == case["start"] + expected.argmax()


def test_echoes_in_the_same_bins_add_up() -> None:
    near, far = (_peaks(np.array([0]), np.array([r]), np.array([1.0]), False)[0][0] for r in (20.0, 20.5))
    both = _peaks(np.array([0, 0, 1]), np.array([20.0, 20.5, 20.0]), np.ones(3), False)[0]
    assert max(near, far) < both[0] < near + far and both[1] == near


@pytest.mark.parametrize("snow", SNOWS)
@pytest.mark.parametrize("variant", ["dsrc", "dsrc_fixed_hard_power"])
def test_a_street_in_snow_has_the_published_statistics(snow: str, variant: str) -> None:
    # The flakes that the release hands out are one sample of 64 discs; ours are another, which spreads these numbers.
    theirs = table("snow")[f"{variant}_{snow}/synth64"]
    settings = replace(calibrated(VARIANTS[variant]), noise_factor=0.7)
    points = cloud("synth64").astype(np.float64)
    channel = elevation_bin(cloud("synth64"))
    points[:, 3] *= 255.0
    ground = ground_of(points, fit_plane(points, np.random.RandomState(0)))
    line = noise_line(ground, points[ground.rows, 3])
    assert line is not None
    some = points[::5]
    out = apply_snow(
        some,
        channel[::5],
        lambda c: disc_sample(*SNOWS[snow], "gunn", c),
        settings,
        floor=noise_floor(ground, line, 0.7),
    )
    label = np.bincount(out.label, minlength=3)
    assert np.allclose(label, theirs["n_label"]["mean"], rtol=[0.02, 0.04, 0.1])
    assert np.isclose(out.kept.sum(), theirs["n_out"]["mean"], rtol=0.01)
    dimmed, moved = out.label == DIMMED, out.label == MOVED
    assert np.isclose(some[dimmed, 3].mean(), theirs["attenuated_mean_intensity_in"]["mean"], rtol=0.03)
    assert np.isclose(out.cloud[dimmed, 3].mean(), theirs["attenuated_mean_intensity_out"]["mean"], rtol=0.03)
    assert np.isclose(out.cloud[moved, 3].mean(), theirs["scattered_mean_intensity"]["mean"], rtol=0.08)
    place = np.linalg.norm(out.cloud[moved, :3], axis=1)
    quantiles = theirs["scattered_new_range_quantiles_0_5_25_50_75_95_100"]["mean"]
    assert np.allclose(np.quantile(place, [0.25, 0.5, 0.75, 0.95]), quantiles[2:6], rtol=0.2)
    assert (place < np.linalg.norm(some[moved, :3], axis=1)).all() and place.min() >= 0.9


def test_as_released_a_target_behind_a_flake_does_not_matter() -> None:
    discs = flake(30.0, 0.01)
    seen = {beam(20.0 + 20.0, intensity, discs, NO_FLOOR) for intensity in (10.0, 100.0, 250.0)}
    assert len(seen) == 1
    own = [beam(40.0, intensity, discs, VARIANTS["dsrc_fixed_hard_power"]) for intensity in (10.0, 100.0, 250.0)]
    assert [round(i / 0.99) for _, _, i in own] == pytest.approx([10, 100, 250], abs=3)


def test_a_near_flake_hides_the_target() -> None:
    label, place, _ = beam(40.0, 50.0, flake(5.0, 0.5), NO_FLOOR)
    assert label == MOVED and abs(place - 5.0) < 0.15
    assert beam(40.0, 50.0, flake(60.0, 0.5), NO_FLOOR) == (UNTOUCHED, 40.0, 50.0)


def test_weak_lasers_have_less_to_give() -> None:
    discs = flake(1.0, 1.0)
    strong, weak = (beam(40.0, 50.0, discs, NO_FLOOR, channel)[2] for channel in (52, 53))
    assert weak / strong == pytest.approx(230 / 255, abs=0.01)


@pytest.mark.parametrize(("range_m", "share"), [(40.0, 1.0), (0.8, 0.5)])
def test_a_beam_without_any_echo_lands_behind_the_sensor_as_released(range_m: float, share: float) -> None:
    # In a power of zeros the first bin is the strongest, and its range is half a pulse less.
    label, place, intensity = beam(range_m, 50.0, flake(0.5, share), NO_FLOOR)
    assert (label, intensity) == (MOVED, 0.0) and place == pytest.approx(-0.5 * 299_792_458.0 * 1e-8)


def test_far_targets_keep_their_place() -> None:
    label, place, _ = beam(240.0, 200.0, flake(60.0, 0.001), VARIANTS["dsrc_fixed_hard_power"])
    assert label == DIMMED and place == 240.0


def test_the_noise_floor_removes_untouched_points_too() -> None:
    points = np.array([[20.0, 0.0, 0.0, 9.4], [20.0, 1.0, 0.0, 9.6], [20.0, 2.0, 0.0, 30.0]])
    nothing = np.zeros((0, 3))
    out = apply_snow(points, np.zeros(3, int), lambda _: nothing, PaperSnow(), floor=np.array([0.0, 0.0, 9.0]))
    assert out.kept.tolist() == [False, True, True] and (out.label == UNTOUCHED).all()
    free = apply_snow(points, np.zeros(3, int), lambda _: nothing, NO_FLOOR)
    assert free.kept.all()


def test_intensities_like_carla_s_drown_in_the_noise_floor_without_any_snow() -> None:
    points = cloud("synth64").astype(np.float64)
    reach = np.linalg.norm(points[:, :3], axis=1)
    points[:, 3] = 255.0 * np.exp(-0.004 * reach)
    nothing = np.zeros((0, 3))
    out = apply_snow(points, np.zeros(len(points), int), lambda _: nothing, PaperSnow(), rng())
    assert out.kept.mean() < 0.6 and not out.kept[reach < 9].any()


def test_a_sweep_keeps_its_rays_and_marks_fates() -> None:
    sweep = street()
    out = corrupt(sweep, replace(NO_FLOOR, snowfall_mm_h=2.5, fall_speed_mps=1.6), rng())
    assert len(out) == len(sweep)
    moved, dimmed, kept = (out.fate == fate for fate in (SCATTERED, ATTENUATED, KEPT))
    assert moved.any() and dimmed.any() and kept.any()
    assert (out.points[~moved] == sweep.points[~moved]).all() and ((out.object_id == ADDED) == moved).all()
    assert np.linalg.norm(np.cross(out.points[moved], sweep.points[moved]), axis=1).max() < 1e-3
    assert (out.range[moved] < sweep.range[moved]).all() and out.range[moved].min() > 0.85
    assert np.allclose(255 * out.intensity, np.round(255 * out.intensity), atol=1e-3)


def test_the_noise_floor_takes_points_off_a_sweep() -> None:
    sweep = street()
    out = corrupt(sweep, PaperSnow.severity(DEFAULT_SEVERITY), rng())
    assert 0 < len(out) < len(sweep)
    row = rows_of(out, sweep)
    stays = out.fate != SCATTERED
    assert (out.points[stays] == sweep.points[row][stays]).all()


def test_more_snow_moves_more_points_and_touches_fewer() -> None:
    sweep = street(spinning(16))
    counts = []
    for severity in SEVERITIES:
        out = corrupt(sweep, replace(PaperSnow.severity(severity), noise_factor=None), rng())
        counts.append([(out.fate == SCATTERED).sum(), (out.fate != KEPT).sum()])
    moved, touched = np.array(counts).T
    assert moved[-1] > moved[2] > moved[0] and touched[-1] < touched[2] < touched[0]
    assert PaperSnow() == PaperSnow.severity(DEFAULT_SEVERITY) == PUBLISHED["dsrc"]


def test_one_seed_gives_one_snow_and_no_snow_is_no_change() -> None:
    sweep = street(spinning(16))
    assert same(
        corrupt(sweep, PaperSnow.severity(DEFAULT_SEVERITY), rng(4)),
        corrupt(sweep, PaperSnow.severity(DEFAULT_SEVERITY), rng(4)),
    )
    assert not same(
        corrupt(sweep, PaperSnow.severity(DEFAULT_SEVERITY), rng(4)),
        corrupt(sweep, PaperSnow.severity(DEFAULT_SEVERITY), rng(5)),
    )
    assert same(corrupt(sweep, PaperSnow(snowfall_mm_h=0.0), rng()), sweep)
    with pytest.raises(SettingsError, match="fall_speed_mps"):
        PaperSnow(fall_speed_mps=0.0)


@pytest.mark.parametrize("severity", [1, 5])
def test_hardly_any_points_are_legal(severity: int) -> None:
    for few in (street(spinning(16))[:0], street(spinning(16))[:1], on_a_ray(np.array([0.0, 0.5, 300.0]))):
        out = corrupt(few, PaperSnow.severity(severity), rng())
        assert len(out) <= len(few) and np.isfinite(out.points).all()
        assert all(getattr(out, name).dtype == getattr(few, name).dtype for name in POINT_FIELDS)


def test_snow_without_its_calibration_says_so_once(caplog: pytest.LogCaptureFixture) -> None:
    notice.cache_clear()
    with few_discs():
        corrupt(street(), NO_FLOOR, rng())  # without a floor nothing falls below it
        assert not caplog.records
        for _ in range(2):
            corrupt(street(), PaperSnow(), rng())
    (record,) = caplog.records
    assert record.getMessage().startswith("snow, paper: expected PaperSnow.calibration, an npz file of the HDL-64E's")
    assert "about 22 % of the points are lost where the release, which has it, loses 5 %" in record.getMessage()


def test_without_its_calibration_snow_takes_a_fifth_of_the_published_street() -> None:
    some, channel = cloud("synth64").astype(np.float64), elevation_bin(cloud("synth64"))
    some[:, 3] *= 255.0
    ground = ground_of(some, fit_plane(some, np.random.RandomState(0)))
    line = noise_line(ground, some[ground.rows, 3])
    assert line is not None
    lost = []
    for settings in (calibrated(PaperSnow()), PaperSnow()):
        floor = noise_floor(ground, line, 0.7)
        out = apply_snow(some[::5], channel[::5], lambda c: disc_sample(0.5, 2.0, "gunn", c), settings, floor=floor)
        lost.append(1 - out.kept.mean())
    assert lost == pytest.approx([0.05, 0.22], abs=0.01)


def test_a_calibration_must_be_one(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="calibration"):
        read_calibration(str(tmp_path / "none.npz"))
    np.savez(tmp_path / "other.npz", focal_distance_m=np.ones(3), focal_slope=np.ones(3), min_intensity=np.ones(3))
    with pytest.raises(DataError, match="64 lasers"):
        read_calibration(str(tmp_path / "other.npz"))
    np.savez(
        tmp_path / "own.npz", focal_distance_m=np.full(64, 10.0), focal_slope=np.ones(64), min_intensity=np.ones(64)
    )
    own = read_calibration(str(tmp_path / "own.npz"))
    assert own.focus(np.array([3]), np.array([120.0]))[0] == pytest.approx((1 - 1000 / 13100) ** 2)
