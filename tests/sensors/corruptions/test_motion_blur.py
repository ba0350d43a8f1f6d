"""Motion blur: uncompensated motion, vibration, and objects smeared by a slower sweep."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from sensors.corruptions.motion_blur import MotionBlur, SceneVelocities, corrupt, in_frame
from sensors.deskew import deskew, deskew_objects
from sensors.motion import Path
from sensors.sweep import KEPT, MOVED, SCATTERED, Sweep, make_sweep
from sim.errors import DataError, SettingsError
from tests.sensors.corruptions.drives import CAR_ID, one_car_frame, street_drive
from tests.sensors.corruptions.street import on_a_ray, same, spinning, street, synth16

UNSHAKEN = MotionBlur(missed_motion=1.0, slower=0.0, shake_m=0.0, shake_deg_s=0.0)
STILL = MotionBlur(missed_motion=0.0, slower=0.0, shake_m=0.0, shake_deg_s=0.0)


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def driven(sweep: Sweep, speed: float = 10.0, yaw_rate: float = 0.4) -> Sweep:
    times = np.linspace(-0.06, 0.06, 13)
    rotation = yaw_rate * times
    xyz = np.stack([speed * times, 0.5 * speed * yaw_rate * times**2, 0.0 * times], axis=1)
    return replace(sweep, path=Path(times, xyz, np.stack([rotation, 0.0 * rotation, 0.0 * rotation], axis=1)))


def shift_of(out: Sweep, sweep: Sweep) -> np.ndarray:
    return np.linalg.norm(out.points.astype(np.float64) - sweep.points, axis=1)


def test_odometry_that_misses_everything_leaves_the_raw_sweep() -> None:
    sweep = driven(street())
    out = corrupt(sweep, UNSHAKEN, rng())
    assert np.abs(out.points - deskew(sweep, "raw").points).max() < 0.01
    assert shift_of(out, sweep).max() > 0.4


def test_odometry_that_misses_a_part_leaves_that_part() -> None:
    sweep = driven(street(), yaw_rate=0.0)
    for share in (0.25, 0.5):
        part = corrupt(sweep, replace_(UNSHAKEN, missed_motion=share), rng())
        assert np.allclose(
            part.points - sweep.points, share * 10.0 * -sweep.time_offset[:, None] * [1, 0, 0], atol=2e-3
        )


def replace_(settings: MotionBlur, **changes: float) -> MotionBlur:
    return MotionBlur(**{name: getattr(settings, name) for name in settings.__struct_fields__} | changes)


def test_points_fired_at_the_reference_time_lie_where_they_were() -> None:
    sweep = driven(street(spinning(columns=3600)))
    middle = np.abs(sweep.time_offset) < 1e-4
    assert middle.any() and shift_of(corrupt(sweep, UNSHAKEN, rng()), sweep)[middle].max() < 0.01


def test_shaking_has_its_size() -> None:
    sweep = street(spinning(64, columns=1800))
    shaken = [corrupt(sweep, replace_(STILL, shake_m=0.1), rng(seed)).points - sweep.points for seed in range(30)]
    assert np.allclose(np.sqrt(np.mean([(s**2).mean(axis=0) for s in shaken], axis=0)), 0.1, rtol=0.15)
    turned = on_a_ray(np.full(3600, 50.0), spec=None)
    turned = replace(turned, time_offset=np.linspace(-0.5, 0.5, 3600).astype(np.float32))
    rates = []
    for seed in range(30):
        out = corrupt(turned, replace_(STILL, shake_deg_s=10.0), rng(seed)).points.astype(np.float64)
        # Seen from the sensor two of three axes turn a point aside.
        rates.append(np.diff(out[::20], axis=0) / np.diff(turned.time_offset[::20])[:, None] / 50.0)
    rms = np.sqrt((np.concatenate(rates) ** 2).sum(axis=1).mean() / 2.0)
    assert np.degrees(rms) == pytest.approx(10.0, rel=0.15)


def test_neighbours_in_time_shake_together() -> None:
    sweep = street(spinning(64, columns=1800))
    shift = corrupt(sweep, MotionBlur.severity(5), rng()).points - sweep.points
    ring = np.flatnonzero(sweep.ring == 60)
    along = shift[ring][np.argsort(sweep.time_offset[ring])]
    assert np.abs(np.diff(along, axis=0)).max() < 0.02 < np.ptp(along, axis=0).max()


def test_a_raw_sweep_only_shakes() -> None:
    raw = deskew(driven(street()), "raw")
    assert same(corrupt(raw, UNSHAKEN, rng()), raw)
    assert shift_of(corrupt(raw, MotionBlur.severity(3), rng()), raw).max() > 0.0


def test_a_slower_sweep_smears_moving_objects_only() -> None:
    sweep = street()
    sweep = replace(sweep, object_id=np.where(sweep.ring == 40, 1000, -1).astype(np.int32))
    velocities = SceneVelocities(np.zeros(3), np.array([1000]), np.array([[8.0, -3.0, 0.0]]))
    out = corrupt(sweep, replace_(STILL, slower=1.0), rng(), velocities)
    on = sweep.object_id == 1000
    assert np.allclose((out.points - sweep.points)[on], sweep.time_offset[on, None] * [8.0, -3.0, 0.0], atol=1e-5)
    assert same(out[~on], sweep[~on])


def test_a_frame_gives_the_velocities() -> None:
    clean = one_car_frame(street(spinning(16)))
    on = clean.agents[1].sweep
    sweep = replace(on, object_id=np.where(on.ring == 10, CAR_ID, -1).astype(np.int32))
    clean = clean.with_sweeps([clean.agents[0].sweep, sweep])
    out = in_frame(clean, 1, replace_(STILL, slower=1.0), rng())
    # One sweep more of smear: the object is where a sweep of twice the duration sees it.
    back = deskew_objects(
        replace(out, object_id=sweep.object_id),
        np.array([CAR_ID]),
        Path(np.array([-0.1, 0.1]), np.array([[[-1.4, 0, 0], [1.4, 0, 0]]]), np.zeros((1, 2, 3))),
    )
    assert np.abs(back.points - sweep.points).max() < 1e-4
    assert shift_of(out, sweep)[sweep.object_id == CAR_ID].max() > 0.5
    # Without a path the agent's speed says how the sensor moves.
    lost = clean.with_sweeps([clean.agents[0].sweep, replace(sweep, path=None)])
    assert shift_of(in_frame(lost, 1, UNSHAKEN, rng()), sweep).max() == pytest.approx(9.0 * 0.05, rel=0.1)


def test_sweeps_without_firing_times_are_given_them() -> None:
    frozen = street(spinning(16, rolling_shutter=False))
    assert not frozen.time_offset.any()
    velocities = SceneVelocities(np.array([10.0, 0.0, 0.0]), np.zeros(0, np.int64), np.zeros((0, 3)))
    for sweep in (frozen, replace(frozen, spec=None, column=np.zeros(len(frozen), np.int32))):
        shift = (corrupt(sweep, UNSHAKEN, rng(), velocities).points - sweep.points)[:, 0]
        azimuth = np.arctan2(sweep.points[:, 1], sweep.points[:, 0])
        assert np.allclose(shift, -10.0 * azimuth / (2 * np.pi) * 0.1, atol=5e-3)


@pytest.mark.parametrize("severity", range(1, 6))
def test_only_places_change(severity: int) -> None:
    sweep = street()
    out = corrupt(sweep, MotionBlur.severity(severity), rng())
    assert (out.intensity == sweep.intensity).all() and (out.object_id == sweep.object_id).all()
    assert (out.fate[shift_of(out, sweep) > 0] == MOVED).all() and len(out) == len(sweep)
    clouded = replace(sweep, fate=np.full(len(sweep), SCATTERED, np.uint8))
    assert (corrupt(clouded, MotionBlur.severity(severity), rng()).fate == SCATTERED).all()


def test_displacements_grow_with_severity_point_by_point() -> None:
    for agent in street_drive()[1].agents:
        shifts = [
            shift_of(corrupt(agent.sweep, MotionBlur.severity(severity), rng()), agent.sweep).mean()
            for severity in range(1, 6)
        ]
        assert all(a < b for a, b in itertools.pairwise(shifts))


def test_level_3_is_as_strong_as_the_jitter_of_the_paper() -> None:
    sweep = driven(street(spinning(64, columns=900)), yaw_rate=0.0)
    near = np.abs(sweep.range - 20.0) < 5.0
    rms = [
        np.sqrt((shift_of(corrupt(sweep, MotionBlur.severity(3), rng(seed)), sweep)[near] ** 2).mean())
        for seed in range(20)
    ]
    assert np.mean(rms) == pytest.approx(0.2, rel=0.25)


def test_no_motion_no_points_and_nonsense() -> None:
    sweep = street()
    assert same(corrupt(sweep, STILL, rng()), sweep) and (corrupt(sweep, STILL, rng()).fate == KEPT).all()
    assert (
        len(corrupt(sweep[:0], MotionBlur.severity(5), rng())) == 0
        and len(corrupt(sweep[:1], MotionBlur.severity(5), rng())) == 1
    )
    assert len(corrupt(synth16(), MotionBlur.severity(3), rng())) == len(synth16())
    with pytest.raises(DataError, match="time_offset: expected finite firing times"):
        corrupt(make_sweep(np.ones((2, 3)), time_offset=[np.nan, 0.0]), MotionBlur.severity(3), rng())
    with pytest.raises(SettingsError, match="shake_m: expected 0 to 10, found -1"):
        MotionBlur(shake_m=-1.0)
