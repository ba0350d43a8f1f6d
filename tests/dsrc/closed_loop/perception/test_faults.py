"""Faults of sensors and radio in the loop: they come, they act on whom they name, and they go without a trace."""

from typing import Any

import numpy as np
import pytest

from dsrc.closed_loop.perception.detector import DetectorPerception
from dsrc.closed_loop.perception.open import open_perception
from dsrc.closed_loop.types import Percept
from dsrc.data.sample import Sample
from dsrc.faults.fault import Fault, parse_faults
from dsrc.faults.kinds import CORRUPTION, KINDS
from sensors.corruptions import Condition
from sensors.frame import Frame
from sensors.sweep import POINT_FIELDS
from sim.errors import SettingsError
from tests.dsrc.closed_loop.perception.toy import EGO, HELPER, PLACES, SCENARIO, Knowing, build, instant

STEPS = 9
FROM, TO = 3, 6
"""First step of a fault, and the first without it again."""
SENSED = {
    "beam_missing": "beam_missing:5",
    "noise": "noise:5",
    "clock_offset": "clock_offset:5",
    "frame_drop": "frame_drop:1",
    "freeze": "freeze",
    "blocked": "blocked:180",
    "dirt": "dirt:0.8,growth_s=0",
    "misalignment": "misalignment:2,up_cm=10",
    "localisation_bias": "localisation_bias:2,aside_m=1",
}
RADIO = {
    "loss": "loss:1",
    "unequipped": "unequipped:1",
    "bursts": "bursts:0.99",
    "delay": "delay:0.2",
    "jitter": "jitter:5",
    "rate": "rate:1",
    "range": "range:5",
    "age": "age:0.05 {when} + delay:0.1",
}


@pytest.fixture(autouse=True)
def _world(monkeypatch: pytest.MonkeyPatch) -> None:
    build(monkeypatch)


def driven(text: str = "", **settings: Any) -> tuple[list[Percept], list[Frame], list[Sample]]:
    """Percepts, sweeps and samples of an episode of 9 steps with faults."""
    faults = parse_faults(text) if text else ()
    detector = Knowing(PLACES[2:])
    perception = DetectorPerception(detector, faults=faults, **settings)
    perception.reset(SCENARIO, EGO, 0)
    percepts, frames = [], []
    for step in range(STEPS):
        percepts.append(perception.perceive(instant(step, 5.0), instant(step + 1, 5.0), {}))
        assert perception.sensed is not None
        frames.append(perception.sensed)
    return percepts, frames, detector.seen


def differ(one: Frame, other: Frame) -> list[int]:
    """Agents whose sweeps differ."""
    return [
        ours.agent_id
        for ours, theirs in zip(one.agents, other.agents, strict=True)
        if any(getattr(ours.sweep, name).tobytes() != getattr(theirs.sweep, name).tobytes() for name in POINT_FIELDS)
        or not np.array_equal(ours.sweep.world_from_lidar, theirs.sweep.world_from_lidar)
    ]


def received(sample: Sample) -> tuple[Any, ...]:
    """What a detector gets of a sample."""
    return (
        sample.agent_ids,
        sample.ego_from_agent.tobytes(),
        *(cloud.tobytes() for cloud in sample.clouds),
        *(lost.tobytes() for lost in sample.lost),
    )


@pytest.mark.parametrize(
    ("kind", "who"),
    [
        (kind, who)
        for kind in SENSED
        for who in ("ego", "helpers", str(HELPER))
        if (kind, who) != ("clock_offset", "ego")
    ],
)
def test_a_sensors_fault_that_ends_leaves_the_rest_as_without_it(kind: str, who: str) -> None:
    text = f"{SENSED[kind]} from {FROM / 10} s to {TO / 10} s on {who}"
    (_, without, _), (_, frames, _) = driven(), driven(text)
    hit = [EGO] if who == "ego" else [HELPER]
    assert [differ(*pair) for pair in zip(frames, without, strict=True)] == [
        hit if FROM <= step < TO else [] for step in range(STEPS)
    ]
    again = driven(text)[1]
    assert not any(differ(*pair) for pair in zip(frames, again, strict=True))


@pytest.mark.parametrize("kind", [*RADIO])
def test_a_radio_fault_that_ends_leaves_the_rest_as_without_it(kind: str) -> None:
    when = f"from {FROM / 10} s to {TO / 10} s"
    text = RADIO[kind].format(when=when) if "{" in RADIO[kind] else f"{RADIO[kind]} {when}"
    base = text.partition(" + ")[2]
    without, found = driven(base), driven(text)
    ours, theirs = ([received(sample) for sample in one[2]] for one in (found, without))
    assert [a != b for a, b in zip(ours, theirs, strict=True)][:FROM] == [False] * FROM
    assert any(a != b for a, b in zip(ours[FROM:TO], theirs[FROM:TO], strict=True))
    assert ours[TO:] == theirs[TO:]
    assert [received(sample) for sample in driven(text)[2]] == ours
    assert not any(differ(*pair) for pair in zip(found[1], without[1], strict=True)), "sweeps stay"


def test_a_loss_of_0_equals_no_radio_fault() -> None:
    for text in ("loss:0", "bursts:0 from 0.2 s", "delay:0 + jitter:0", "loss:0 on 1001"):
        assert [received(sample) for sample in driven(text)[2]] == [received(sample) for sample in driven()[2]], text


def test_a_radio_fault_acts_on_the_senders_that_it_names() -> None:
    assert all(sample.agent_ids == (EGO,) for sample in driven("loss:1")[2])
    assert all(sample.agent_ids == (EGO,) for sample in driven(f"loss:1 on {HELPER}")[2])
    assert all(sample.agent_ids == (EGO,) for sample in driven("unequipped:1")[2])
    ages = [percept.links[0].age_s for percept in driven("loss:1 from 0.3 s to 0.5 s")[0]]
    assert ages == pytest.approx([0, 0, 0, 0.1, 0.2, 0, 0, 0, 0]), "what came before is used"


def test_faults_act_one_after_another_and_a_condition_is_the_first() -> None:
    once, both = driven("noise:5 + beam_missing:5")[1], driven("beam_missing:5 + noise:5")[1]
    assert any(differ(*pair) for pair in zip(once, both, strict=True)), "noise is drawn for the points that are left"
    told = driven("noise:5", condition=Condition("beam_missing", 5))[1]
    assert not any(differ(*pair) for pair in zip(told, both, strict=True))


def test_an_unknown_agent_and_a_fault_beside_itself_are_told_in_one_line() -> None:
    with pytest.raises(SettingsError, match=r"fault 'fog:3 on 1777': expected ids among the agents \[1000, 1001\]"):
        driven("fog:3 on 1777")
    with pytest.raises(SettingsError, match=r"fault 'loss:1 from 2 s on 7': expected ids among the agents"):
        driven("loss:1 from 2 s on 7")
    with pytest.raises(SettingsError, match="one fault of the kind 'fog' at a time"):
        driven(f"fog:3 on ego + fog:2 on {EGO}")


def test_a_perception_without_a_sensor_or_a_detector_takes_no_fault_of_one() -> None:
    for text in ("fog:3", "loss:0.5 from 2 s"):
        with pytest.raises(SettingsError, match="'truth' is without a sensor; leave out --fault"):
            open_perception("truth", fault=text)
    with pytest.raises(SettingsError, match="one fault of the kind 'fog' at a time"):
        open_perception("team", corruption="fog", fault="fog:2 from 3 s")


def test_every_kind_of_sensor_and_radio_is_tested_here() -> None:
    told = {name for name, kind in KINDS.items() if kind.place in ("sensor", "radio")}
    assert told <= SENSED.keys() | RADIO.keys()
    assert Fault(kind="fog", settings=CORRUPTION.settings()).text == "fog:3"


def test_an_ego_that_believes_to_be_elsewhere_finds_all_it_sees_there() -> None:
    (clean, *_), (moved, *_) = (driven(text, cooperative=False)[0] for text in ("", "localisation_bias:2,aside_m=-1"))
    np.testing.assert_allclose(moved.boxes.center - clean.boxes.center, [[2.0, -1.0, 0.0]], atol=1e-6)
    drift = [one.boxes.center[0, 0] for one in driven("localisation_drift:1 from 0.2 s to 0.5 s", cooperative=False)[0]]
    np.testing.assert_allclose(np.array(drift) - drift[0], [0, 0, 0, 0.1, 0.2, 0, 0, 0, 0], atol=1e-6)


def test_a_helper_that_believes_to_be_elsewhere_is_there_for_the_ego() -> None:
    for text, off in (("localisation_bias:2 on helpers", [-2.0, 0.0]), ("localisation_bias:2 on ego", [-2.0, 0.0])):
        places = [sample.ego_from_agent[1, :2, 3] for sample in (driven()[2][0], driven(text)[2][0])]
        np.testing.assert_allclose(places[1] - places[0], off, atol=1e-4, err_msg=text)


def test_noise_of_helpers_is_the_radios_and_of_the_ego_its_own() -> None:
    noisy, (clean, *_) = driven("localisation_noise:0.5"), driven()[2]
    placed = [sample.ego_from_agent[1].tobytes() for sample in noisy[2]]
    assert len(set(placed)) == STEPS and clean.ego_from_agent[1].tobytes() not in placed
    assert {tuple(differ(*pair)) for pair in zip(noisy[1], driven()[1], strict=True)} == {(EGO,)}
