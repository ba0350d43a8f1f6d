"""Fog, snow and rain alike: reported returns, their places and marks."""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from types import ModuleType

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sensors.corruptions import fog, rain, snow
from sensors.corruptions.apply import count_lost
from sensors.corruptions.check import sweep_problems
from sensors.corruptions.fog import Fog
from sensors.corruptions.physics.medium import Echo, rays_of, report
from sensors.corruptions.physics.receiver import OVERLAP_START_M, detection_threshold
from sensors.corruptions.rain import Rain
from sensors.corruptions.snow import Snow
from sensors.deskew import deskew
from sensors.motion import Path
from sensors.optics.beams import beams_of
from sensors.spec import LidarSpec
from sensors.sweep import (
    ADDED,
    ATTENUATED,
    KEPT,
    MOTIONS,
    MOVED,
    SCATTERED,
    UNKNOWN_MATERIAL,
    Motion,
    Sweep,
    make_sweep,
)
from sim.geometry import pose_matrix
from tests.sensors.corruptions.street import on_a_ray, rows_of, same, spinning, street, synth16

Medium = tuple[ModuleType, Callable[[int], Fog | Snow | Rain]]

MEDIA: dict[str, Medium] = {
    "fog": (fog, Fog.severity),
    "snow": (snow, Snow.severity),
    "rain": (rain, Rain.severity),
}
all_media = pytest.mark.parametrize("medium", MEDIA)


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def through(medium: str, sweep: Sweep, level: int, seed: int = 1) -> Sweep:
    module, of = MEDIA[medium]
    return module.corrupt(sweep, of(level), rng(seed))


def beam_of(sweep: Sweep) -> np.ndarray:
    assert sweep.spec is not None
    return sweep.ring.astype(np.int64) * sweep.spec.columns + sweep.column


def in_open_beams(out: Sweep, clean: Sweep) -> np.ndarray:
    """Mask of points in beams that are open in clear air."""
    return ~np.isin(beam_of(out), beam_of(clean))


def cosine(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    a, b = a.astype(np.float64), b.astype(np.float64)
    return (a * b).sum(axis=1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)


def uneven(rings: int, columns: int = 40, **changes: object) -> LidarSpec:
    """A sensor whose beams are denser towards the horizon, some of them above it."""
    share = np.linspace(-0.7, 1.0, rings)
    elevation = -25.0 * np.sign(share) * np.abs(share) ** 1.7
    return msgspec.structs.replace(spinning(rings, columns, **changes), elevation_deg=tuple(elevation.tolist()))


@all_media
@pytest.mark.parametrize("level", [1, 3, 5])
def test_echoes_lie_on_the_ray_before_the_target_on_no_object(medium: str, level: int) -> None:
    sweep = street()
    sweep = replace(sweep, material=np.full(len(sweep), 3, np.uint8), cosine=np.ones(len(sweep), np.float32))
    out = through(medium, sweep, level)
    out = out[~in_open_beams(out, sweep)]
    clean = sweep[rows_of(out, sweep)]
    added = out.fate == SCATTERED
    assert added.any() or level == 1
    assert (out.range[added] < clean.range[added]).all() and (out.range[added] >= OVERLAP_START_M - 1e-3).all()
    assert (cosine(out.points[added], clean.points[added]) > 1.0 - 1e-9).all()
    assert (out.object_id[added] == ADDED).all() and (out.material[added] == UNKNOWN_MATERIAL).all()
    assert (out.cosine[added] == 0.0).all()
    for name in ("object_id", "material", "cosine", "return_number"):
        assert (getattr(out, name)[~added] == getattr(clean, name)[~added]).all()


@pytest.mark.parametrize("medium", sorted(set(MEDIA) - {"rain"}))
def test_remaining_targets_keep_their_place(medium: str) -> None:
    sweep = street()
    out = through(medium, sweep, 4)
    seen = out[out.fate != SCATTERED]
    assert (seen.points == sweep.points[rows_of(seen, sweep)]).all()


@all_media
@pytest.mark.parametrize("level", [1, 5])
def test_no_target_is_brighter_and_dimmed_ones_are_marked(medium: str, level: int) -> None:
    sweep = street()
    out = through(medium, sweep, level)
    seen = out[out.fate != SCATTERED]
    before = sweep.intensity[rows_of(seen, sweep)]
    assert (seen.intensity <= before).all()
    assert ((seen.fate == ATTENUATED) == (seen.intensity < before)).all()


@all_media
def test_the_mark_of_an_earlier_corruption_stays(medium: str) -> None:
    sweep = street()
    earlier = np.arange(len(sweep)) % 3
    marks = np.array([KEPT, MOVED, SCATTERED], np.uint8)[earlier]
    sweep = replace(sweep, fate=marks, object_id=np.where(earlier == 2, ADDED, 1234).astype(np.int32))
    out = through(medium, sweep, 3)
    out = out[~in_open_beams(out, sweep)]
    clean = sweep[rows_of(out, sweep)]
    real = out.object_id == 1234
    assert (out.fate[real & (clean.fate == MOVED)] == MOVED).all()
    assert set(np.unique(out.fate[real & (clean.fate == KEPT)])) <= {KEPT, ATTENUATED}
    assert (out.fate[clean.fate == SCATTERED] == SCATTERED).all()
    assert (out.object_id[clean.fate == SCATTERED] == ADDED).all()


@all_media
def test_no_weather_is_the_identity_and_scaling_goes_there(medium: str) -> None:
    sweep = street()
    module, of = MEDIA[medium]
    assert same(module.corrupt(sweep, of(5).scaled(0.0), rng()), sweep)


@all_media
def test_scaled_weather_is_between_its_severities(medium: str) -> None:
    sweep = street(spinning(64, columns=720))
    module, of = MEDIA[medium]
    kept = [(module.corrupt(sweep, of(4).scaled(f), rng()).fate != SCATTERED).sum() for f in (0.85, 1.0, 1.15)]
    assert kept[0] > kept[1] > kept[2]


@all_media
def test_scaled_weather_is_bounded(medium: str) -> None:
    of = MEDIA[medium][1]
    assert isinstance(of(5).scaled(1e6), type(of(5)))


@all_media
def test_a_higher_severity_takes_more_points_and_adds_more_echoes(medium: str) -> None:
    sweep = street(spinning(64, columns=720))
    out = [through(medium, sweep, level) for level in range(1, 6)]
    real = [(o.object_id != ADDED).sum() for o in out]
    echoes = [(o.fate == SCATTERED).sum() for o in out]
    assert real[0] < len(sweep)
    assert all(a > b for a, b in itertools.pairwise(real)), real
    assert all(a < b for a, b in itertools.pairwise(echoes)), echoes


@all_media
def test_points_lost_stay_lost_as_the_weather_worsens(medium: str) -> None:
    sweep = street(spinning(64, columns=720))
    left = [set(beam_of(o[o.object_id != ADDED]).tolist()) for o in (through(medium, sweep, n) for n in range(1, 6))]
    for better, worse in itertools.pairwise(left):
        # As particles grow the loudest lies elsewhere, at times behind the target.
        assert len(worse - better) <= (0 if medium == "fog" else 0.01 * len(sweep))


@pytest.mark.parametrize("medium", ["fog", "snow", "rain"])
def test_a_beam_is_independent_of_the_targets_of_others(medium: str) -> None:
    sweep = street()
    some = rng().random(len(sweep)) < 0.5
    whole, part = through(medium, sweep, 5), through(medium, sweep[some], 5)
    part = part[np.isin(beam_of(part), beam_of(sweep[some]))]
    assert same(part, whole[np.isin(beam_of(whole), beam_of(sweep[some]))])


@all_media
@pytest.mark.parametrize("rings", [16, 300])
def test_open_beams_of_any_sensor_return_echoes(medium: str, rings: int) -> None:
    sweep = street(uneven(rings, range_10_m=60.0, range_max_m=60.0))
    out = through(medium, sweep, 5)
    empty = in_open_beams(out, sweep)
    assert empty.any() and (out.fate[empty] == SCATTERED).all()
    assert len(np.unique(beam_of(out))) == len(out)
    assert (np.diff(beam_of(out)) > 0).all()  # ring by ring, column by column
    axis = beams_of(uneven(rings), 0.0).axis[:, out.ring[empty], out.column[empty]].T
    assert (cosine(out.points[empty], axis) > 1.0 - 1e-9).all()
    assert (out.range[empty] >= OVERLAP_START_M - 1e-3).all() and out.range[empty].max() <= 60.0
    assert sweep.spec is not None
    assert (out.time_offset == sweep.spec.time_offset[out.ring, out.column].astype(np.float32)).all()


@all_media
@settings(max_examples=12, deadline=None)
@given(
    st.sampled_from([1, 2, 16, 40, 64, 128]),
    st.integers(1, 40),
    st.floats(20.0, 300.0),
    st.floats(0.0, 0.01),
    st.floats(2e-9, 5e-8),
    st.floats(0.0, 3.0),
    st.sampled_from(["strongest", "last", "dual"]),
    st.sampled_from(["reflectivity", "distance", "power"]),
    st.integers(1, 5),
    st.integers(0, 2**32 - 1),
)
def test_any_sweep_of_any_sensor_stays_legal(
    medium: str,
    rings: int,
    columns: int,
    range_10_m: float,
    divergence: float,
    pulse_s: float,
    nearest: float,
    returns: str,
    law: str,
    level: int,
    seed: int,
) -> None:
    spec = uneven(
        rings,
        columns,
        range_10_m=range_10_m,
        divergence_rad=divergence,
        pulse_s=pulse_s,
        range_min_m=nearest,
        returns=returns,
        intensity_law=law,
    )
    sweep = street(spec)
    sweep = sweep[rng(seed).random(len(sweep)) < rng(seed + 1).random()]
    out = through(medium, sweep, level, seed)
    assert sweep_problems(sweep, count_lost(sweep, out)) == []
    assert (out.range[out.fate == SCATTERED] >= max(OVERLAP_START_M, nearest) - 1e-3).all()
    assert out.range.max(initial=0.0) <= 120.0 + 1e-3 or medium == "rain"


@all_media
def test_empty_and_single_point_sweeps_are_legal(medium: str) -> None:
    assert len(through(medium, make_sweep(np.zeros((0, 3))), 5)) == 0
    assert len(through(medium, make_sweep(np.zeros((0, 3)), spec=spinning(4, range_10_m=0.3)), 5)) == 0
    sky = through(medium, make_sweep(np.zeros((0, 3)), spec=spinning(4)), 5)
    assert len(sky) > 0 and (sky.fate == SCATTERED).all()
    lonely = street()[1000:1001]
    assert len(through(medium, lonely, 1)) >= 1
    assert len(through(medium, replace(lonely, spec=None), 5)) <= 1


@all_media
def test_points_of_unknown_beams_have_no_open_beams(medium: str) -> None:
    cloud = synth16()
    out = through(medium, cloud, 5)
    assert 0 < len(out) <= len(cloud)
    columns_lost = replace(street(), column=np.zeros(len(street()), np.int32))
    assert len(through(medium, columns_lost, 5)) <= len(columns_lost)


@all_media
def test_a_sensor_that_drops_beams_drops_their_echoes(medium: str) -> None:
    spec = spinning(16, 400, range_10_m=120.0, dropoff_rate=0.3)
    sweep = street(spec)
    dropped = rng(5).random(16 * 400) < 0.3
    out = through(medium, sweep[~dropped[beam_of(sweep)]], 5)
    silent = 16 * 400 - len(np.unique(beam_of(out)))
    assert silent >= 0.25 * 16 * 400


@pytest.mark.parametrize("motion", MOTIONS)
def test_echoes_of_open_beams_start_where_the_sensor_was(motion: Motion) -> None:
    spec = spinning(8, 90)
    poses = pose_matrix(np.array([[0.0, 0.0, 0.0], [3.0, 0.5, 0.0]]), np.array([0.0, 0.2]))
    path = Path.through([9.9, 10.1], poses)
    at = path.at(np.array([10.0]))[0]
    sky = deskew(replace(make_sweep(np.zeros((0, 3)), at, 10.0, spec), path=path), motion)
    out = fog.corrupt(sky, msgspec.structs.replace(Fog.of_visibility(20.0), range_10_m=150.0), rng())
    assert out.motion == motion and len(out) == 8 * 90
    raw = deskew(out, "raw")
    assert (cosine(raw.points, beams_of(spec, 10.0).axis[:, raw.ring, raw.column].T) > 1.0 - 1e-9).all()
    assert (np.diff(out.ring) >= 0).all()


def test_a_sensor_of_last_returns_keeps_detected_targets() -> None:
    reach = np.arange(5.0, 100.0, 0.1)
    thick = msgspec.structs.replace(Fog.of_visibility(150.0), range_10_m=400.0)
    out = {}
    for returns in ("strongest", "last", "dual"):
        sweep = on_a_ray(reach, 0.1, spinning(returns=returns))
        out[returns] = fog.corrupt(sweep, thick, rng())
    assert (out["strongest"].fate == SCATTERED).sum() > 100
    assert (out["last"].fate == ATTENUATED).sum() > (out["strongest"].fate == ATTENUATED).sum() + 100
    assert same(out["last"], out["dual"])


def test_the_stronger_of_target_and_echo_is_reported_if_it_is_detected() -> None:
    spec = spinning(range_10_m=50.0)
    threshold = detection_threshold(spec)
    sweep = on_a_ray(np.full(4, 20.0), np.float32(1000.0 * threshold), spec)
    rays = rays_of(sweep, None, rng())
    hard = rays.power[0]
    assert hard > 2.0 * threshold
    power = np.zeros(len(rays))
    power[:4] = 0.6 * hard, 0.4 * hard, 2.0 * threshold, 0.9 * threshold
    dim = np.array([0.5, 0.5, 0.0, 0.0])
    out = report(rays, dim, Echo(np.full(len(rays), 7.0), power))
    assert out.fate.tolist() == [SCATTERED, ATTENUATED, SCATTERED]
    assert np.allclose(out.range, [7.0, 20.0, 7.0])
    assert np.allclose(out.intensity, [0.6 * hard * 49.0, 500.0 * threshold, 2.0 * threshold * 49.0], rtol=1e-5)


def test_faint_points_stay_with_the_probability_of_the_transmission() -> None:
    # Real files give intensity 0 to much that their sensor saw.
    sweep = on_a_ray(np.full(20_000, 60.0), 0.0)
    rays = rays_of(sweep, None, rng())
    out = report(rays, np.full(20_000, 0.7), Echo(np.zeros(20_000), np.zeros(20_000)))
    assert math.isclose(len(out) / 20_000, 0.7, abs_tol=0.015)
    assert same(report(rays, np.ones(20_000), Echo(np.zeros(20_000), np.zeros(20_000))), sweep)


@pytest.mark.parametrize(
    ("law", "expected"),
    [
        ("reflectivity", lambda power, reach: power * reach**2),
        ("power", lambda power, reach: 100.0 * power),
        ("distance", lambda power, reach: np.exp(-0.004 * reach)),
    ],
)
def test_an_echo_gets_the_intensity_of_the_sensor_s_own_law(law: str, expected: Callable) -> None:
    sweep = on_a_ray(np.full(3, 30.0), 0.5, spinning(intensity_law=law))
    rays = rays_of(sweep, None, rng())
    reach, power = np.array([2.0, 5.0, 9.0]), np.array([1e-4, 1e-3, 2e-3])
    place, loud = np.zeros(len(rays)), np.zeros(len(rays))
    place[:3], loud[:3] = reach, power
    out = report(rays, np.zeros(3), Echo(place, loud))
    assert np.allclose(out.intensity, expected(power, reach), rtol=1e-5)
