"""Faults of frames: what a text means where time has no meaning."""

import math

import numpy as np
import pytest

from dsrc.data.sample import SampleRequest, make_sample
from dsrc.evaluation.config import Case
from dsrc.faults.condition import condition_of, faults_of, frame_condition, radio_faults
from dsrc.models.settings import ModelSettings
from sensors.corruptions import Condition
from sim.errors import DataError, SettingsError
from sim.radio import PRESETS
from tests.dsrc.training.drive import frame

GRID = ModelSettings().grid


def test_a_corruption_or_a_radio_fault_decides_what_its_older_spelling_decides() -> None:
    fog = frame_condition("fog:4 on helpers", "evaluate")
    assert fog.decisive() == Condition("fog", 4, agents="helpers").decisive()
    sweeps = [fog.apply(frame(0), seed=3).agents, Condition("fog", 4, agents="helpers").apply(frame(0), seed=3).agents]
    for one, other in zip(*sweeps, strict=True):
        np.testing.assert_array_equal(one.sweep.points, other.sweep.points)
    lossy = Case("DSRC", 0, "test", frame_condition("loss:0.3 + delay:0.1", "evaluate"), "its-g5-27")
    assert lossy.condition.decisive() == Condition().decisive()
    assert lossy.spec().decisive() == Case("", 0, "", Condition(), "its-g5-27,loss=0.3,delay_s=0.1").spec().decisive()
    some = frame_condition("loss:0.3 on 1003", "evaluate")
    assert some.decisive() != Condition().decisive(), "the channel cannot say it"
    sent_with = radio_faults(faults_of(some), PRESETS["ideal"], 0.1, ego_id=1001)
    # Frames of a drive are counted from 0.
    assert [sent_with(index, 1003).packet_loss for index in (0, 7)] == [0.3, 0.3]
    assert sent_with(7, 1002).packet_loss == 0.0


def test_a_fault_is_read_again_from_its_kind_and_a_corruption_is_none() -> None:
    both = frame_condition("blocked:60,middle_deg=90 on helpers + loss:0.3", "evaluate")
    assert condition_of(both.kind, 0, "physical", "all") == both and both.label == both.kind
    assert condition_of("fog", 2, "physical", "ego") == Condition("fog", 2, agents="ego")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("fog:3 from 4 s to 9 s", "'fog:3 from 4 s to 9 s': expected none of from, to and for"),
        ("dirt:0.5 from 2 s", "expected none of from, to and for"),
        (
            "freeze",
            "'freeze': expected a fault that acts in a single frame, found freeze",
        ),
        ("localisation_drift:1", "found localisation_drift"),
        ("speed_reading:0.5", "found speed_reading"),
        ("latency:0.2", "found latency"),
        ("fog + control_delay:0.2", "'control_delay:0.2': expected a fault that acts"),
        ("brake_gain:0.5", "found brake_gain"),
        ("replay:2", "fault 'replay:2': expected a fault that acts in a single frame, found replay; it has a meaning"),
        ("steering_gain:0.5", "found steering_gain"),
        ("ghost for 5 s", "fault 'ghost for 5 s': expected none of from, to and for"),
        ("foggy", "expected a kind of fault, found foggy"),
    ],
)
def test_what_means_nothing_in_a_frame_is_refused_by_name(text: str, said: str) -> None:
    with pytest.raises(SettingsError, match=said) as caught:
        frame_condition(text, "evaluate")
    assert str(caught.value).startswith("evaluate: ") and "\n" not in str(caught.value)


def test_an_unknown_agent_is_refused_and_an_ego_is_no_helper() -> None:
    ids = [agent.agent_id for agent in frame(0).agents]
    with pytest.raises(DataError, match=r"fault 'frame_drop:1 on 77': expected ids among the agents .*, found 77"):
        frame_condition("frame_drop:1 on 77", "evaluate").apply(frame(0), 0)
    with pytest.raises(DataError, match=f"loss:0.5 on {ids[0]}.*found {ids[0]}"):
        frame_condition(f"loss:0.5 on {ids[0]}", "evaluate").apply(frame(0), 0)


def test_an_ego_that_errs_about_its_place_sees_others_where_they_are_and_helpers_elsewhere() -> None:
    clean, request = frame(0), SampleRequest(GRID)
    lost = frame_condition("localisation_bias:2,aside_m=1,turn_deg=3 on ego", "evaluate").apply(clean, 0)
    before, after = make_sample(clean, None, request), make_sample(lost, None, request, recorded=clean)
    np.testing.assert_allclose(after.boxes.center, before.boxes.center)
    far = [cloud[np.hypot(*cloud[:, :2].T) > 6.0] for cloud in (before.clouds[0], after.clouds[0])]
    np.testing.assert_array_equal(*far)
    moved = after.ego_from_agent[1] @ np.linalg.inv(before.ego_from_agent[1])
    turn = math.atan2(moved[1, 0], moved[0, 0])
    assert math.degrees(turn) == pytest.approx(-3.0) and np.hypot(*moved[:2, 3]) == pytest.approx(math.hypot(2, 1))


def test_noise_of_a_place_is_new_in_every_frame_and_as_large_as_said() -> None:
    noisy = frame_condition("localisation_noise:0.5 on ego", "evaluate")
    errors = []
    for index in range(200):
        clean = frame(0)
        clean = type(clean)(**{**{n: getattr(clean, n) for n in clean.__dataclass_fields__}, "time_s": 0.1 * index})
        poses = (one.agents[0].sweep.world_from_lidar for one in (clean, noisy.apply(clean, 5)))
        errors.append(np.linalg.norm(np.diff([pose[:2, 3] for pose in poses], axis=0)))
    assert len(set(errors)) == 200 and np.mean(np.square(errors)) == pytest.approx(2 * 0.5**2, rel=0.25)
