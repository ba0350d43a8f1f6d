"""Motion blur and crosstalk as published."""

import itertools
from collections.abc import Callable

import numpy as np
import pytest

from sensors.corruptions.physics.levels import DEFAULT_SEVERITY, SEVERITIES
from sensors.corruptions.published import points
from sensors.corruptions.published.cloud import RandomSource
from sensors.corruptions.published.points import (
    PUBLISHED_CROSSTALK,
    PUBLISHED_MOTION_BLUR,
    PaperCrosstalk,
    PaperMotionBlur,
    apply_motion_blur,
    crosstalk_noise,
)
from sensors.sweep import ADDED, KEPT, MOVED, SCATTERED, UNKNOWN_MATERIAL, Sweep
from tests.sensors.corruptions.published.goldens import agrees, arrays, by_range, cloud, equals, table
from tests.sensors.corruptions.street import same, spinning, street

SEEDS, OTHER_SEEDS = range(20), range(100, 120)


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def legacy() -> np.random.RandomState:
    return np.random.RandomState(1205)


def apply_crosstalk(cloud: np.ndarray, settings: PaperCrosstalk, draws: RandomSource) -> tuple[np.ndarray, np.ndarray]:
    """Return a cloud with crosstalk, and the displaced rows in the order of drawing."""
    touched, shake = crosstalk_noise(cloud.shape, settings, draws)
    out = cloud.astype(np.float64)
    out[touched] += shake
    return out, touched


def test_a_legacy_generator_blurs_as_the_release() -> None:
    out = apply_motion_blur(cloud("synth16"), PUBLISHED_MOTION_BLUR["dsrc"], legacy())
    assert (out[::5].astype(np.float32) == arrays("motion_blur")["every_5th"]).all()


def test_a_legacy_generator_mistakes_the_points_of_the_release() -> None:
    before, golden = cloud("synth16"), arrays("crosstalk")
    out, touched = apply_crosstalk(before, PUBLISHED_CROSSTALK["dsrc"], legacy())
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
    after = [apply_motion_blur(before, PUBLISHED_MOTION_BLUR[published], np.random.RandomState(seed)) for seed in SEEDS]
    shift = [out - before for out in after]
    assert equals([s.mean(axis=0) for s in shift], theirs["dmean_xyzi"], 1e-6)
    assert equals([s.std(axis=0) for s in shift], theirs["dstd_xyzi"])
    assert equals([by_range(out) for out in after], theirs["range_hist"], 0.2)
    assert equals([(out[:, 3] < 0).sum() for out in after], theirs["n_intensity_neg"])


@pytest.mark.parametrize(("level", "deviation"), [("light", 0.04), ("moderate", 0.08), ("heavy", 0.1)])
def test_motion_blur_spreads_as_published(level: str, deviation: float) -> None:
    before = cloud("synth64").astype(np.float64)
    theirs = table("motion_blur")[f"robo3d_kitti_{level}_{deviation}/synth64"]
    after = [
        apply_motion_blur(before, PUBLISHED_MOTION_BLUR[f"robo3d_kitti_{level}"], rng(seed)) for seed in OTHER_SEEDS
    ]
    shift = [out - before for out in after]
    assert agrees([s.mean(axis=0) for s in shift], theirs["dmean_xyzi"])
    assert agrees([s.std(axis=0) for s in shift], theirs["dstd_xyzi"])
    assert agrees([by_range(out) for out in after], theirs["range_hist"])


def test_crosstalk_draws_as_the_release() -> None:
    before, theirs = cloud("synth64").astype(np.float64), table("crosstalk")["dsrc_p0.01/synth64"]
    after = [apply_crosstalk(before, PUBLISHED_CROSSTALK["dsrc"], np.random.RandomState(seed)) for seed in SEEDS]
    assert equals([(out - before)[touched].std(axis=0) for out, touched in after], theirs["dstd_changed_xyzi"])
    assert equals([by_range(out) for out, _ in after], theirs["range_hist"])
    assert equals([(out[:, 3] < 0).sum() for out, _ in after], theirs["n_intensity_neg"])
    assert equals([(out[:, 3] > 1).sum() for out, _ in after], theirs["n_intensity_gt1"])


@pytest.mark.parametrize(("level", "share"), [("light", 0.006), ("moderate", 0.008), ("heavy", 0.01)])
def test_crosstalk_spreads_as_published(level: str, share: float) -> None:
    before = cloud("synth64").astype(np.float64)
    theirs = table("crosstalk")[f"robo3d_kitti_{level}_{share}/synth64"]
    after = [apply_crosstalk(before, PUBLISHED_CROSSTALK[f"robo3d_{level}"], rng(seed)) for seed in OTHER_SEEDS]
    assert agrees([len(touched) for _, touched in after], theirs["n_changed"])
    assert agrees([(out - before)[touched].std(axis=0) for out, touched in after], theirs["dstd_changed_xyzi"])
    assert agrees([by_range(out) for out, _ in after], theirs["range_hist"])
    assert agrees([(out[:, 3] < 0).sum() for out, _ in after], theirs["n_intensity_neg"])
    assert agrees([(out[:, 3] > 1).sum() for out, _ in after], theirs["n_intensity_gt1"])


def test_the_text_blurs_coordinates_only() -> None:
    sweep = street()
    out = points.motion_blur(sweep, PaperMotionBlur.severity(DEFAULT_SEVERITY), rng())
    assert (out.intensity == sweep.intensity).all() and (out.fate == MOVED).all()
    assert np.allclose((out.points - sweep.points).std(axis=0), 0.2, rtol=0.03)
    released = points.motion_blur(sweep, PUBLISHED_MOTION_BLUR["dsrc"], rng())
    assert (released.intensity != sweep.intensity).mean() > 0.9


def test_displaced_points_are_on_no_object() -> None:
    sweep = street()
    out = points.crosstalk(sweep, PaperCrosstalk.severity(DEFAULT_SEVERITY), rng())
    touched = out.fate == SCATTERED
    assert touched.sum() == int(0.01 * len(sweep))
    assert (out.object_id[touched] == ADDED).all() and (out.material[touched] == UNKNOWN_MATERIAL).all()
    assert same(out[~touched], sweep[~touched])


@pytest.mark.parametrize(("kind", "settings"), [("motion_blur", PaperMotionBlur), ("crosstalk", PaperCrosstalk)])
def test_the_default_is_severity_3(kind: str, settings: type) -> None:
    assert settings() == settings.severity(DEFAULT_SEVERITY)
    sweep = street(spinning(16))
    make: Callable[..., Sweep] = getattr(points, kind)
    assert same(make(sweep, settings(), rng()), make(sweep, settings.severity(DEFAULT_SEVERITY), rng()))


def test_points_displaced_at_a_severity_are_displaced_at_the_next() -> None:
    sweep = street(spinning(16))
    lost = []
    for severity in SEVERITIES:
        out = points.crosstalk(sweep, PaperCrosstalk.severity(severity), rng())
        untouched = {row.tobytes() for row in out.points[out.fate == KEPT]}
        lost.append({row for row, p in enumerate(sweep.points) if p.tobytes() not in untouched})
    assert all(a < b for a, b in itertools.pairwise(lost))


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        ("motion_blur", PaperMotionBlur(deviation_m=0.0)),
        ("crosstalk", PaperCrosstalk(share=0.0)),
    ],
)
def test_no_strength_is_no_change(kind: str, settings: object) -> None:
    sweep = street(spinning(16))
    make: Callable[..., Sweep] = getattr(points, kind)
    assert same(make(sweep, settings, rng()), sweep)
