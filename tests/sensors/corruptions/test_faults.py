"""Beam missing, motion blur, crosstalk, cross sensor."""

import itertools
from types import ModuleType

import numpy as np
import pytest

from sensors.corruptions import beam_missing, cross_sensor, crosstalk, motion_blur
from sensors.corruptions.beam_missing import BeamMissing
from sensors.corruptions.cross_sensor import CrossSensor, removed_rings
from sensors.corruptions.crosstalk import Crosstalk
from sensors.corruptions.motion_blur import MotionBlur
from sensors.sweep import ADDED, KEPT, MOVED, SCATTERED, make_sweep
from sim.errors import DataError, SettingsError
from tests.sensors.corruptions.street import same, shared, spinning, street, synth16, synth64


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.mark.parametrize(("rings", "lost"), [(64, 16), (32, 8), (16, 4), (40, 10), (300, 75)])
def test_a_quarter_of_the_beams_is_missing_on_any_sensor(rings: int, lost: int) -> None:
    sweep = street(spinning(rings, columns=90))
    present = len(np.unique(sweep.ring))
    out = beam_missing.corrupt(sweep, 3, rng())
    # Rings that only see the sky may be among the missing ones.
    assert present - lost <= len(np.unique(out.ring)) <= present - lost + (rings - present)


def test_missing_beams_take_all_their_points_and_no_others() -> None:
    sweep = street()
    out = beam_missing.corrupt(sweep, 3, rng())
    assert same(out, sweep[np.isin(sweep.ring, np.unique(out.ring))])


def test_every_beam_is_equally_likely_to_be_missing() -> None:
    sweep = synth16()
    times = np.zeros(16)
    for seed in range(400):
        times[np.unique(beam_missing.corrupt(sweep, 3, rng(seed)).ring)] += 1
    assert abs(times / 400 - 0.75).max() < 0.1


def test_beams_missing_at_a_severity_are_missing_at_the_next() -> None:
    sweep = street()
    left = [set(beam_missing.corrupt(sweep, severity, rng()).ring) for severity in range(1, 6)]
    assert all(a > b for a, b in itertools.pairwise(left))


@pytest.mark.parametrize("module", [beam_missing, cross_sensor])
def test_points_that_do_not_know_their_rings_are_refused(module: ModuleType) -> None:
    with pytest.raises(DataError, match="expected points with their rings"):
        module.corrupt(make_sweep(street().points), 3, rng())


def test_no_or_all_beams_can_be_missing() -> None:
    sweep = street()
    assert same(beam_missing.corrupt(sweep, BeamMissing(rings_of_64=0), rng()), sweep)
    assert len(beam_missing.corrupt(sweep, BeamMissing(rings_of_64=64), rng())) == 0


@pytest.mark.parametrize(("severity", "deviation"), [(1, 0.05), (3, 0.2), (5, 0.4)])
def test_motion_blur_has_its_deviation_on_each_coordinate(severity: int, deviation: float) -> None:
    sweep = synth16()
    shift = motion_blur.corrupt(sweep, severity, rng()).points - sweep.points
    assert np.allclose(shift.std(axis=0), deviation, rtol=0.03)
    assert np.abs(shift.mean(axis=0)).max() < 5 * deviation / np.sqrt(len(sweep))
    assert np.abs(np.corrcoef(shift.T) - np.eye(3)).max() < 0.05


def test_motion_blur_moves_points_and_nothing_else() -> None:
    sweep = street()
    out = motion_blur.corrupt(sweep, 5, rng())
    assert (out.intensity == sweep.intensity).all() and (out.object_id == sweep.object_id).all()
    assert (out.fate == MOVED).all()
    assert same(motion_blur.corrupt(sweep, MotionBlur(deviation_m=0.0), rng()), sweep)


def test_motion_blur_displaces_like_the_reference() -> None:
    golden = np.load(shared("motion_blur/exact_seed1205.npz"))
    sweep = synth16()
    reference = _moved(golden, len(sweep))[:, :3] - sweep.points
    ours = motion_blur.corrupt(sweep, 3, rng()).points - sweep.points
    assert np.allclose(
        np.percentile(np.abs(ours), [25, 50, 75, 95]), np.percentile(np.abs(reference), [25, 50, 75, 95]), rtol=0.03
    )


@pytest.mark.parametrize(("severity", "share"), [(1, 0.002), (3, 0.01), (5, 0.04)])
def test_crosstalk_touches_exactly_its_share(severity: int, share: float) -> None:
    sweep = synth16()
    out = crosstalk.corrupt(sweep, severity, rng())
    touched = (out.points != sweep.points).any(axis=1)
    assert touched.sum() == int(share * len(sweep))
    assert ((out.fate == SCATTERED) == touched).all() and ((out.object_id == ADDED) == touched).all()
    assert (out.fate[~touched] == KEPT).all()
    assert (out.intensity == sweep.intensity).all()


def test_crosstalk_is_3_m_on_each_coordinate() -> None:
    sweep = synth16()
    out = crosstalk.corrupt(sweep, Crosstalk(share=0.5), rng())
    shift = (out.points - sweep.points)[out.fate == SCATTERED]
    assert np.allclose(shift.std(axis=0), 3.0, rtol=0.04)


def test_crosstalk_displaces_as_many_as_far_as_the_reference() -> None:
    golden = np.load(shared("crosstalk/exact_seed1205.npz"))
    sweep = synth16()
    reference = _moved(golden, len(sweep))[:, :3] - sweep.points
    ours = crosstalk.corrupt(sweep, 3, rng()).points - sweep.points
    touched = [(np.abs(shift) > 0).any(axis=1) for shift in (reference, ours)]
    assert touched[0].sum() == touched[1].sum()
    assert np.isclose(reference[touched[0]].std(), ours[touched[1]].std(), rtol=0.15)


def test_crosstalk_along_the_ray_keeps_directions_and_ranges_legal() -> None:
    sweep = street(spinning(range_min_m=1.0))
    out = crosstalk.corrupt(sweep, Crosstalk(share=1.0, along_ray=True), rng())
    before, after = sweep.points.astype(np.float64), out.points.astype(np.float64)
    cosine = (before * after).sum(axis=1) / np.linalg.norm(before, axis=1) / np.linalg.norm(after, axis=1)
    assert cosine.min() > 1.0 - 1e-9
    assert out.range.min() >= 1.0 - 1e-4 and out.range.max() <= sweep.spec.range_max_m + 1e-3
    assert 2.5 < (out.range - sweep.range).std() < 3.1


def test_cross_sensor_halves_beams_and_firings() -> None:
    sweep = street()
    out = cross_sensor.corrupt(sweep, 3, rng())
    assert set(out.ring) == {ring for ring in set(sweep.ring) if ring % 2 == 0}
    assert (out.column % 2 == 0).all()
    assert same(out, sweep[(sweep.ring % 2 == 0) & (sweep.column % 2 == 0)])


def test_cross_sensor_doubles_the_azimuth_step_within_every_ring() -> None:
    sweep = street(spinning(32, columns=720))
    out = cross_sensor.corrupt(sweep, 3, rng())
    for ring in np.unique(out.ring):
        steps = [np.median(np.diff(np.unwrap(np.arctan2(*s.points[s.ring == ring, 1::-1].T)))) for s in (sweep, out)]
        assert np.isclose(steps[1], 2 * steps[0], rtol=1e-3)


def test_cross_sensor_without_columns_thins_every_ring() -> None:
    sweep = synth16()
    out = cross_sensor.corrupt(sweep, 3, rng())
    for ring in np.unique(out.ring):
        assert (out.ring == ring).sum() == -(-(sweep.ring == ring).sum() // 2)


@pytest.mark.parametrize("severity", range(1, 5))
def test_cross_sensor_keeps_less_of_what_it_kept_before(severity: int) -> None:
    sweep = street()
    more, less = ({tuple(p) for p in cross_sensor.corrupt(sweep, s, rng()).points} for s in (severity, severity + 1))
    assert less < more


@pytest.mark.parametrize("rings_of_64", [16, 32])
def test_cross_sensor_by_index_is_the_reference_exactly(rings_of_64: int) -> None:
    sweep = synth64()
    packed = np.load(shared("cross_sensor/keep_masks.npz"))[f"keep_synth64_{rings_of_64}"]
    kept = np.unpackbits(packed)[: len(sweep)].astype(bool)
    settings = CrossSensor(rings_of_64=rings_of_64, thin_by="index")
    assert same(cross_sensor.corrupt(sweep, settings, rng()), sweep[kept])


@pytest.mark.parametrize(("rings", "removed"), [(64, 16), (64, 32), (64, 48), (16, 12), (40, 30), (300, 225), (5, 4)])
def test_removed_rings_are_distinct_and_leave_the_first(rings: int, removed: int) -> None:
    gone = removed_rings(rings, removed)
    assert len(set(gone)) == removed and gone.min() == 1 and gone.max() < rings


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: BeamMissing(rings_of_64=65), "rings_of_64: expected 0 to 64, found 65"),
        (lambda: MotionBlur(deviation_m=-1.0), "deviation_m"),
        (lambda: Crosstalk(share=1.5), "share: expected 0 to 1, found 1.5"),
        (lambda: CrossSensor(keep_one_of=0), "keep_one_of"),
    ],
)
def test_a_setting_that_cannot_be_is_one_line(make: object, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        make()  # type: ignore[operator]


def _moved(golden: object, count: int) -> np.ndarray:
    """The (P, 4) output in a golden archive."""
    return next(golden[name] for name in golden.files if golden[name].shape == (count, 4))  # type: ignore[attr-defined, index]
