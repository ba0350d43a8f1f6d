"""Faults of sensors on sweeps: what each takes, moves and keeps."""

import math

import numpy as np
import pytest

from dsrc.faults.fault import parse_faults
from dsrc.faults.sweeps import SensorFaults
from sensors.frame import Frame

EGO, HELPER = 1, 2
TURN = np.linspace(-math.pi, math.pi, 3_600, endpoint=False)
RING = np.stack([50.0 * np.cos(TURN), 50.0 * np.sin(TURN), np.zeros(len(TURN))], axis=1)


def frame(index: int = 0, far_m: float = 0.0) -> Frame:
    clouds = {agent: (RING + np.array([far_m, 0.0, 0.0]), np.eye(4)) for agent in (EGO, HELPER)}
    return Frame.of_clouds(clouds, index=index, time_s=0.1 * index)


def cloud(text: str, index: int = 0, time_s: float = math.inf, agent: int = HELPER) -> np.ndarray:
    faults = SensorFaults(parse_faults(text), seed=4)
    return faults.apply(frame(index), EGO, time_s).agent(agent).sweep.points


def test_a_blocked_field_has_no_point_and_the_rest_has_all() -> None:
    left = cloud("blocked:60,middle_deg=90")
    angle = np.degrees(np.arctan2(left[:, 1], left[:, 0]))
    assert np.abs(angle - 90.0).min() > 29.9 and len(left) == pytest.approx(3_000, abs=2)
    assert len(cloud("blocked:360")) == 0 and len(cloud("blocked:0")) == len(RING)
    assert len(cloud("blocked:60 on ego", agent=EGO)) == pytest.approx(3_000, abs=2)
    assert len(cloud("blocked:60 on ego")) == len(RING)


def test_dirt_grows_to_its_share_and_keeps_what_it_covers() -> None:
    shares, before = [], np.zeros((0, 3))
    for time_s in (10.0, 7.5, 5.0, 2.5, 0.0):
        left = cloud("dirt:0.6,growth_s=8 from 2 s", time_s=time_s)
        assert {tuple(point) for point in before} <= {tuple(point) for point in left}, "cleaner before"
        before = left
        shares.append(1.0 - len(left) / len(RING))
    assert shares == sorted(shares, reverse=True) and shares[-1] == 0.0
    assert shares[0] == pytest.approx(0.6, abs=0.12)
    assert len(cloud("dirt:0.6")) == pytest.approx(0.4 * len(RING), rel=0.3), "without time it is grown"


def test_a_sensor_that_is_turned_by_2_degrees_is_off_by_1_75_m_in_50_m() -> None:
    turned = cloud("misalignment:2")
    np.testing.assert_allclose(np.linalg.norm(turned - RING, axis=1), 2 * 50.0 * math.sin(math.radians(1.0)), rtol=1e-4)
    shifted = cloud("misalignment:0,ahead_cm=30,up_cm=-10")
    np.testing.assert_allclose(shifted - RING, np.tile([-0.3, 0.0, 0.1], (len(RING), 1)), atol=1e-5)


def test_dropped_frames_are_as_many_as_they_should_be_and_more_of_them_are_the_same_ones() -> None:
    few, many = ([len(cloud(f"frame_drop:{share}", index)) == 0 for index in range(300)] for share in (0.2, 0.5))
    assert np.mean(few) == pytest.approx(0.2, abs=0.07) and np.mean(many) == pytest.approx(0.5, abs=0.08)
    assert all(more or not less for less, more in zip(few, many, strict=True))
    assert few != [len(cloud("frame_drop:0.2", index, agent=EGO)) == 0 for index in range(300)], "each its own"
    assert not any(len(cloud("frame_drop:0", index)) == 0 for index in range(20))


def test_a_frozen_sensor_repeats_the_sweep_before() -> None:
    faults = SensorFaults(parse_faults("freeze from 0.3 s to 0.6 s on helpers"), seed=0)
    shown = [faults.apply(frame(step, float(step)), EGO, 0.1 * step) for step in range(8)]
    at = [one.agent(HELPER).sweep.points[0, 0] - np.float32(RING[0, 0]) for one in shown]
    np.testing.assert_allclose(at, [0, 1, 2, 2, 2, 2, 6, 7], atol=1e-5)
    assert [one.agent(HELPER).sweep.time_s for one in shown] == pytest.approx([0.1 * step for step in range(8)])
    assert [one.agent(EGO).sweep.points[0, 0] - np.float32(RING[0, 0]) for one in shown] == pytest.approx(range(8))
