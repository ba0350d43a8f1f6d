"""Corruptions of single points as published."""

import itertools
from collections.abc import Callable

import numpy as np
import pytest

from sensors.corruptions.physics.levels import PAPER, SEVERITIES
from sensors.corruptions.published import points
from sensors.corruptions.published.points import (
    PUBLISHED_CROSSTALK,
    PUBLISHED_MOTION_BLUR,
    Crosstalk,
    FieldOfView,
    MotionBlur,
    Noise,
    PointDropping,
    Sunlight,
    ahead,
    blurred,
    mistaken,
    remaining,
    shaken,
)
from sensors.sweep import ADDED, KEPT, MOVED, POINT_FIELDS, SCATTERED, UNKNOWN_MATERIAL, Sweep
from tests.sensors.corruptions.published.goldens import agrees, arrays, by_range, cloud, equals, table
from tests.sensors.corruptions.street import same, spinning, street

SEEDS, OTHER_SEEDS = range(20), range(100, 120)
KINDS = ("motion_blur", "crosstalk", "sunlight", "noise", "point_dropping", "field_of_view")
SETTINGS = (MotionBlur, Crosstalk, Sunlight, Noise, PointDropping, FieldOfView)


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def legacy() -> np.random.RandomState:
    return np.random.RandomState(1205)


def test_a_legacy_generator_blurs_as_the_release() -> None:
    out = blurred(cloud("synth16"), PUBLISHED_MOTION_BLUR["dsrc"], legacy())
    assert (out[::5].astype(np.float32) == arrays("motion_blur")["every_5th"]).all()


def test_a_legacy_generator_mistakes_the_points_of_the_release() -> None:
    before, golden = cloud("synth16"), arrays("crosstalk")
    out, touched = mistaken(before, PUBLISHED_CROSSTALK["dsrc"], legacy())
    assert (touched == golden["index"]).all()
    assert (out[touched].astype(np.float32) == golden["touched"]).all()
    untouched = np.delete(np.arange(len(before)), touched)
    assert (out[untouched] == before[untouched]).all()


@pytest.mark.parametrize(
    ("published", "golden"),
    [
        ("dsrc", "dsrc_std0.2"),
        ("robo3d_semantickitti_light", "robo3d_semantickitti_light_0.2"),
        ("robo3d_semantickitti_moderate", "robo3d_semantickitti_moderate_0.25"),
        ("robo3d_semantickitti_heavy", "robo3d_semantickitti_heavy_0.3"),
    ],
)
def test_motion_blur_draws_as_the_release(published: str, golden: str) -> None:
    before, theirs = cloud("synth64").astype(np.float64), table("motion_blur")[golden + "/synth64"]
    after = [blurred(before, PUBLISHED_MOTION_BLUR[published], np.random.RandomState(seed)) for seed in SEEDS]
    shift = [out - before for out in after]
    assert equals([s.mean(axis=0) for s in shift], theirs["dmean_xyzi"], 1e-6)
    assert equals([s.std(axis=0) for s in shift], theirs["dstd_xyzi"])
    assert equals([by_range(out) for out in after], theirs["range_hist"], 0.2)
    assert equals([(out[:, 3] < 0).sum() for out in after], theirs["n_intensity_neg"])


@pytest.mark.parametrize(("level", "deviation"), [("light", 0.04), ("moderate", 0.08), ("heavy", 0.1)])
def test_motion_blur_spreads_as_published(level: str, deviation: float) -> None:
    before = cloud("synth64").astype(np.float64)
    theirs = table("motion_blur")[f"robo3d_kitti_{level}_{deviation}/synth64"]
    after = [blurred(before, PUBLISHED_MOTION_BLUR[f"robo3d_kitti_{level}"], rng(seed)) for seed in OTHER_SEEDS]
    shift = [out - before for out in after]
    assert agrees([s.mean(axis=0) for s in shift], theirs["dmean_xyzi"])
    assert agrees([s.std(axis=0) for s in shift], theirs["dstd_xyzi"])
    assert agrees([by_range(out) for out in after], theirs["range_hist"])


def test_crosstalk_draws_as_the_release() -> None:
    before, theirs = cloud("synth64").astype(np.float64), table("crosstalk")["dsrc_p0.01/synth64"]
    after = [mistaken(before, PUBLISHED_CROSSTALK["dsrc"], np.random.RandomState(seed)) for seed in SEEDS]
    assert equals([(out - before)[touched].std(axis=0) for out, touched in after], theirs["dstd_changed_xyzi"])
    assert equals([by_range(out) for out, _ in after], theirs["range_hist"])
    assert equals([(out[:, 3] < 0).sum() for out, _ in after], theirs["n_intensity_neg"])
    assert equals([(out[:, 3] > 1).sum() for out, _ in after], theirs["n_intensity_gt1"])


@pytest.mark.parametrize(("level", "share"), [("light", 0.006), ("moderate", 0.008), ("heavy", 0.01)])
def test_crosstalk_spreads_as_published(level: str, share: float) -> None:
    before = cloud("synth64").astype(np.float64)
    theirs = table("crosstalk")[f"robo3d_kitti_{level}_{share}/synth64"]
    after = [mistaken(before, PUBLISHED_CROSSTALK[f"robo3d_{level}"], rng(seed)) for seed in OTHER_SEEDS]
    assert agrees([len(touched) for _, touched in after], theirs["n_changed"])
    assert agrees([(out - before)[touched].std(axis=0) for out, touched in after], theirs["dstd_changed_xyzi"])
    assert agrees([by_range(out) for out, _ in after], theirs["range_hist"])
    assert agrees([(out[:, 3] < 0).sum() for out, _ in after], theirs["n_intensity_neg"])
    assert agrees([(out[:, 3] > 1).sum() for out, _ in after], theirs["n_intensity_gt1"])


def test_the_text_blurs_coordinates_only() -> None:
    sweep = street()
    out = points.motion_blur(sweep, PAPER, rng())
    assert (out.intensity == sweep.intensity).all() and (out.fate == MOVED).all()
    assert np.allclose((out.points - sweep.points).std(axis=0), 0.2, rtol=0.03)
    released = points.motion_blur(sweep, PUBLISHED_MOTION_BLUR["dsrc"], rng())
    assert (released.intensity != sweep.intensity).mean() > 0.9


def test_mistaken_points_belong_to_nothing() -> None:
    sweep = street()
    out = points.crosstalk(sweep, PAPER, rng())
    touched = out.fate == SCATTERED
    assert touched.sum() == int(0.01 * len(sweep))
    assert (out.object_id[touched] == ADDED).all() and (out.material[touched] == UNKNOWN_MATERIAL).all()
    assert same(out[~touched], sweep[~touched])


@pytest.mark.parametrize("severity", SEVERITIES)
def test_noise_has_its_size_on_every_column(severity: int) -> None:
    before = cloud("synth64").astype(np.float64)
    size = 0.02 * severity
    gaussian = shaken(before, Noise.severity(severity, "gaussian"), rng())[0] - before
    assert np.allclose(gaussian.std(axis=0), size, rtol=0.02)
    uniform = shaken(before, Noise.severity(severity, "uniform"), rng())[0] - before
    assert np.allclose(np.abs(uniform).max(axis=0), size, rtol=1e-3)
    assert np.allclose(uniform.std(axis=0), size / np.sqrt(3), rtol=0.02)


@pytest.mark.parametrize(("severity", "one_of"), zip(SEVERITIES, (30, 25, 20, 15, 10), strict=True))
def test_impulses_hit_their_share_by_a_decimetre(severity: int, one_of: int) -> None:
    before = cloud("synth64").astype(np.float64)
    shift = shaken(before, Noise.severity(severity, "impulse"), rng())[0] - before
    hit = shift.any(axis=1)
    assert hit.sum() == len(before) // one_of
    assert np.allclose(np.abs(shift[hit]), 0.1)
    assert np.allclose((shift[hit] > 0).mean(axis=0), 0.5, atol=0.04)


@pytest.mark.parametrize(("severity", "left"), zip(SEVERITIES, (101760, 95265, 88770, 82275, 75779), strict=True))
def test_density_deletes_its_share(severity: int, left: int) -> None:
    assert remaining(cloud("synth64"), PointDropping.severity(severity), rng()).sum() == left


@pytest.mark.parametrize(("severity", "cuts"), zip(SEVERITIES, (2, 3, 5, 7, 10), strict=True))
def test_cuts_delete_whole_neighbourhoods(severity: int, cuts: int) -> None:
    before = cloud("synth64")
    left = remaining(before, PointDropping.severity(severity, "cutout"), rng())
    assert (~left).sum() == cuts * int(0.02 * len(before))


def test_a_cut_takes_the_nearest_points() -> None:
    before = cloud("synth64").astype(np.float64)
    gone = ~remaining(before, PointDropping(law="cutout", cuts=1), rng())
    row = int(rng().random() * len(before))
    distance = np.linalg.norm(before - before[row], axis=1)
    assert gone[row] and distance[gone].max() <= distance[~gone].min() + 1e-4


def test_the_field_of_view_looks_along_y_unless_told_otherwise() -> None:
    angle = np.radians(np.arange(-179.5, 180.0))
    circle = np.column_stack([np.sin(angle), np.cos(angle), np.zeros(360)])  # angle from +y
    assert (ahead(circle, FieldOfView.severity(5)) == (np.abs(np.degrees(angle)) <= 45)).all()
    ahead_x = ahead(circle, FieldOfView(half_deg=45.0, ahead="x"))
    assert ahead_x.sum() == 90 and circle[ahead_x, 0].min() > 0.7


@pytest.mark.parametrize(("kind", "settings"), zip(KINDS, SETTINGS, strict=True))
def test_the_default_is_severity_3(kind: str, settings: type) -> None:
    assert settings() == settings.severity(PAPER)
    sweep = street(spinning(16))
    make: Callable[..., Sweep] = getattr(points, kind)
    assert same(make(sweep, settings(), rng()), make(sweep, PAPER, rng()))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("severity", SEVERITIES)
def test_sweeps_stay_sweeps(kind: str, severity: int) -> None:
    make: Callable[..., Sweep] = getattr(points, kind)
    sweep = street(spinning(16))
    for name in POINT_FIELDS:
        getattr(sweep, name).flags.writeable = False
    out = make(sweep, severity, rng())
    assert all(getattr(out, name).dtype == getattr(sweep, name).dtype for name in POINT_FIELDS)
    assert out.intensity.min() >= 0.0 and out.intensity.max() <= 1.0
    assert ((out.object_id == ADDED) == (out.fate == SCATTERED)).all()
    assert same(out, make(sweep, severity, rng()))
    for few in (sweep[:0], sweep[:1]):
        assert len(make(few, severity, rng())) <= len(few)


@pytest.mark.parametrize("kind", ["crosstalk", "sunlight", "point_dropping", "field_of_view"])
def test_what_is_lost_at_a_severity_is_lost_at_the_next(kind: str) -> None:
    sweep = street(spinning(16))
    make: Callable[..., Sweep] = getattr(points, kind)
    lost = []
    for severity in SEVERITIES:
        out = make(sweep, severity, rng())
        untouched = {row.tobytes() for row in out.points[out.fate == KEPT]}
        lost.append({row for row, p in enumerate(sweep.points) if p.tobytes() not in untouched})
    assert all(a < b for a, b in itertools.pairwise(lost))


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        ("motion_blur", MotionBlur(deviation_m=0.0)),
        ("crosstalk", Crosstalk(share=0.0)),
        ("noise", Noise(size_m=0.0)),
        ("point_dropping", PointDropping(fraction=0.0)),
        ("point_dropping", PointDropping(law="cutout", cuts=0)),
        ("field_of_view", FieldOfView(half_deg=180.0)),
    ],
)
def test_no_strength_is_no_change(kind: str, settings: object) -> None:
    sweep = street(spinning(16))
    make: Callable[..., Sweep] = getattr(points, kind)
    assert same(make(sweep, settings, rng()), sweep)
