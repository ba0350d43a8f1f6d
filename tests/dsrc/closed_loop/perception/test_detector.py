"""A detector in the loop: from sweeps to boxes in the world, without a look at the truth."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from msgspec.structs import replace as changed
from numpy.typing import NDArray

from dsrc.closed_loop.loop import ClosedLoop, LoopSettings
from dsrc.closed_loop.perception.detector import DetectorPerception
from dsrc.closed_loop.perception.senses import Senses
from dsrc.closed_loop.types import Percept
from dsrc.data.sample import Sample, SampleDetector
from dsrc.ops.detections import Detections
from sensors.corruptions import Condition
from sensors.corruptions.apply import CorruptedAgents
from sensors.recording.record import record
from sensors.sweep import POINT_FIELDS
from sim.boxes import CLASSES, Boxes
from sim.errors import SettingsError
from sim.radio import PRESETS, ChannelSpec
from sim.scenario import RoadsideUnit
from tests.dsrc.closed_loop.perception.toy import EGO, HELPER, PLACES, SCENARIO, Knowing, build, instant, show
from tests.dsrc.evaluation.fakes import PointCounter
from tests.sensors.fakes import StraightTraffic, cars, ground, rows_of, toy_scenario

OTHERS = PLACES[2:]


@pytest.fixture(autouse=True)
def _world(monkeypatch: pytest.MonkeyPatch) -> None:
    build(monkeypatch)


def started(detector: SampleDetector | None = None, **settings: Any) -> DetectorPerception:
    perception = DetectorPerception(detector or Knowing(OTHERS), **settings)
    perception.reset(SCENARIO, EGO, 0)
    return perception


def perceive(perception: DetectorPerception, step: int = 0) -> Percept:
    return perception.perceive(instant(step), instant(step + 1), {})


def percepts(perception: DetectorPerception, interval_s: float, steps: int) -> list[Percept]:
    """Return the percepts of traffic of 0.1 s steps; between them the perception overhears."""
    found = []
    for step in range(steps):
        if step % round(interval_s / 0.1) == 0:
            found.append(perceive(perception, step))
        else:
            perception.overhear(instant(step), instant(step + 1), {})
    return found


def test_boxes_come_back_where_they_are_in_the_world_with_scores_and_no_ids() -> None:
    percept = perceive(started())
    np.testing.assert_allclose(np.sort(percept.boxes.center[:, :2], axis=0), np.sort([p[:2] for p in OTHERS], axis=0))
    assert percept.boxes.object_id.tolist() == [-1, -1]
    assert percept.score.dtype == np.float64 and (np.diff(percept.score) <= 0).all() and (percept.score < 1).all()
    assert np.isnan(percept.velocity).all() and percept.velocity.shape == (2, 2)
    assert percept.time_s == pytest.approx(0.1)


def test_the_ego_alone_sees_less_than_together_with_its_helper() -> None:
    together, alone = perceive(started()), perceive(started(cooperative=False))
    assert [len(percept.boxes) for percept in (together, alone)] == [2, 1]
    assert [len(percept.links) for percept in (together, alone)] == [1, 0]


@pytest.mark.parametrize("late", [False, True])
def test_a_range_that_lies_ahead_moves_what_is_seen_and_not_where_it_is(late: bool) -> None:
    channel = changed(PRESETS["ideal"], medium="fixed", delay_s=0.1 if late else 0.0)
    reach_m = Knowing(OTHERS).settings.grid.range_m[3]
    speed_mps = np.sqrt(14.0 * (reach_m - 8.0))  # it stops within its range, but not after a second
    moving = [replace(instant(step), velocity=np.array([[speed_mps, 0], [0, 0], [0, 0], [0, 0]])) for step in range(3)]
    seen, shifts = [], []
    for look_ahead_s in (0.0, 1.0, 1e3):
        perception = started(channel=channel, look_ahead_s=look_ahead_s)
        for step in (0, 1):
            percept = perception.perceive(moving[step], moving[step + 1], {})
        seen.append(percept.boxes.center)
        (*_, sample) = perception.detector.seen
        shifts.append(-sample.ego_from_agent[0, 0, 3])
        # The helper's place and points, late or not, are in the same frame as the ego's.
        np.testing.assert_allclose(sample.ego_from_agent[1, :2, 3] + [shifts[-1], 0.0], [29.0, 14.0], atol=1e-9)
    assert shifts == pytest.approx([0.0, min(speed_mps - 8.0, 0.5 * reach_m), 0.5 * reach_m])
    assert shifts[1] > 1.0
    assert len(seen[0]) == 2
    for moved in seen[1:]:
        np.testing.assert_allclose(moved, seen[0], atol=1e-9)


def test_a_shifted_range_is_said_once_and_not_for_every_network() -> None:
    shifted, around = started(look_ahead_s=1.0), started()
    assert ClosedLoop(SCENARIO, shifted).settings.look_ahead_s == 1.0
    assert ClosedLoop(SCENARIO, around).settings.look_ahead_s == 0.0
    with pytest.raises(SettingsError, match="look_ahead_s: expected that of the perception, 0, or 0, found 1"):
        ClosedLoop(SCENARIO, around, settings=LoopSettings(look_ahead_s=1.0))
    own = Knowing(OTHERS)
    own.settings = SimpleNamespace(own_frame=True)
    for wrong in (-1.0, float("nan"), float("inf")):
        with pytest.raises(SettingsError, match="look_ahead_s: expected seconds >= 0"):
            started(look_ahead_s=wrong)
    with pytest.raises(SettingsError, match="own frames, found 1"):
        started(own, look_ahead_s=1.0)


def test_no_truth_reaches_a_detector() -> None:
    detector = PointCounter(need=0)
    assert len(perceive(started(detector)).boxes) == 0
    (sample,) = detector.seen
    assert sample.agent_ids == (EGO, HELPER)
    assert [len(boxes) for boxes in (sample.boxes, *sample.agent_boxes)] == [0, 0, 0]
    assert sample.other_clouds == sample.corrupted == ()


def test_a_network_runs_on_one_thread_and_the_process_keeps_its_own_number() -> None:
    """The number of threads changes the last digits of a network's numbers, and so an episode."""
    seen = []

    class Counting(Knowing):
        def detect(self, sample: Sample) -> Detections:
            seen.append(torch.get_num_threads())
            return super().detect(sample)

    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        perceive(started(Counting(OTHERS)))
        assert (seen, torch.get_num_threads()) == ([1], 2)
    finally:
        torch.set_num_threads(before)


def test_the_class_is_that_of_the_detector() -> None:
    class Vans(Knowing):
        def detect(self, sample: Sample) -> Detections:
            found = super().detect(sample)
            label = np.full(len(found), CLASSES.index("van"))
            return Detections(Boxes.from_array(found.boxes.array, label=label, object_id=label), found.score)

    boxes = perceive(started(Vans(OTHERS))).boxes
    assert boxes.label.tolist() == [CLASSES.index("van")] * 2
    assert boxes.object_id.tolist() == [-1, -1]


@pytest.mark.parametrize("answer", [None, [], (np.zeros((0, 7)), np.zeros(0))])
def test_something_else_than_detections_is_an_error_that_says_so(answer: object) -> None:
    detector = PointCounter()
    detector.detect = lambda sample: answer
    with pytest.raises(TypeError, match=r"PointCounter\.detect: expected Detections, found"):
        perceive(started(detector))


def test_the_live_sweeps_are_those_of_the_recorded_drive() -> None:
    unit = RoadsideUnit(xyz_m=(20.0, 8.0, 5.0), yaw_deg=-90.0, pitch_deg=15.0, lidar="debug-16")
    scenario = toy_scenario(vehicles=3, roadside=(unit,), mount_xyz_m=(0.5, 0.0, 2.1))
    start = cars([[0, 0, 0], [12, 3.5, 0], [-15, -3.5, 0], [300, 0, 0]], speed=10.0)
    from sim.world.build import build_world

    recording = record(StraightTraffic(start), build_world(scenario, 3), scenario, 3, 4)
    traffic, senses = StraightTraffic(start), Senses(Condition(), cooperative=True)
    senses.reset(scenario, recording.vehicles[0], 3)
    for index in (1, 2, 3):
        live, recorded = senses.frame(traffic.actors, traffic.step(), {}), recording.frame(index)
        assert live.index == index and [a.agent_id for a in live.agents] == list(recording.agent_ids)
        for ours, theirs in zip(live.agents, recorded.agents, strict=True):
            for name in POINT_FIELDS:
                assert getattr(ours.sweep, name).tobytes() == getattr(theirs.sweep, name).tobytes()


def test_a_helper_that_leaves_is_not_replaced() -> None:
    senses = Senses(Condition(), cooperative=True)
    senses.reset(SCENARIO, EGO, 0)
    first = senses.frame(instant(0), instant(1), {})
    later = replace(rows_of(instant(2), [0, 2, 3]), time_s=0.2)
    assert [agent.agent_id for agent in first.agents] == [EGO, HELPER]
    assert [agent.agent_id for agent in senses.frame(instant(1), later, {}).agents] == [EGO]


@pytest.mark.parametrize(("who", "hit"), [("ego", [EGO]), ("helpers", [HELPER]), ((HELPER,), [HELPER]), ("all", None)])
def test_only_those_asked_for_are_corrupted(who: CorruptedAgents, hit: list[int] | None) -> None:
    frames = []
    for condition in (Condition(), Condition("beam_missing", 5, agents=who)):
        senses = Senses(condition, cooperative=True)
        senses.reset(SCENARIO, EGO, 0)
        frames.append(senses.frame(instant(0), instant(1), {}))
    clean, faulty = frames
    fewer = [a.agent_id for a, b in zip(clean.agents, faulty.agents, strict=True) if len(b.sweep) < len(a.sweep)]
    assert fewer == ([EGO, HELPER] if hit is None else hit)


def test_a_corrupted_id_may_leave_but_not_be_unknown() -> None:
    senses = Senses(Condition("fog", 3, agents=(HELPER,)), cooperative=True)
    senses.reset(SCENARIO, EGO, 0)
    senses.frame(instant(0), instant(1), {})
    senses.frame(instant(1), rows_of(instant(2), [0, 2, 3]), {})
    unknown = Senses(Condition("fog", 3, agents=(1777,)), cooperative=True)
    unknown.reset(SCENARIO, EGO, 0)
    with pytest.raises(
        SettingsError, match=r"fault '.* on 1777': expected ids among the agents \[1000, 1001\], found 1777"
    ):
        unknown.frame(instant(0), instant(1), {})


def test_a_late_channel_shows_the_helper_as_it_was_and_counts_in_percepts() -> None:
    late = changed(PRESETS["ideal"], medium="fixed", delay_s=0.2)
    arrived = {}
    for interval_s in (0.1, 0.2):
        perception = started(channel=late, interval_s=interval_s)
        arrived[interval_s] = [len(percept.boxes) for percept in percepts(perception, interval_s, steps=5)]
    assert arrived == {0.1: [1, 1, 2, 2, 2], 0.2: [1, 2, 2]}


@pytest.mark.parametrize(("interval_s", "delay_s", "age_s"), [(0.1, 0.05, 0.1), (0.2, 0.05, 0.1), (0.3, 0.15, 0.2)])
def test_a_message_is_as_old_as_its_delay_and_a_turn_of_its_sensor_however_seldom_the_ego_detects(
    interval_s: float, delay_s: float, age_s: float
) -> None:
    perception = started(channel=changed(PRESETS["ideal"], medium="fixed", delay_s=delay_s), interval_s=interval_s)
    (*_, last) = percepts(perception, interval_s, steps=10)
    assert [link.age_s for link in last.links] == pytest.approx([age_s])
    at_once = started(interval_s=interval_s)
    percepts(at_once, interval_s, steps=10)
    assert len(at_once._past) == len(range(0, 10, round(interval_s / 0.1))), "nothing is late: none between percepts"


@pytest.mark.parametrize("channel", [{"medium": "fixed", "delay_s": 0.05}, {"packet_loss": 0.0, "jitter_s": 1e-9}])
@pytest.mark.parametrize("interval_s", [0.1, 0.2])
def test_the_radio_changes_no_point_of_a_sweep(channel: dict[str, Any], interval_s: float) -> None:
    def clouds(spec: ChannelSpec) -> list[NDArray[np.float32]]:
        perception = started(channel=spec, interval_s=interval_s)
        percepts(perception, interval_s, steps=7)
        times = np.arange(1, 8, round(interval_s / 0.1)) / 10
        kept = [frame for frame in reversed(perception._past) if np.isclose(frame.time_s, times).any()]
        return [agent.sweep.points for frame in kept for agent in frame.agents]

    clean, faulty = clouds(PRESETS["ideal"]), clouds(changed(PRESETS["ideal"], **channel))
    assert len(clean) == len(faulty) == 2 * len(range(0, 7, round(interval_s / 0.1)))
    assert all(np.array_equal(one, other) for one, other in zip(clean, faulty, strict=True))


def test_an_episode_begins_anew_with_reset() -> None:
    perception = started()
    first = [perceive(perception, step) for step in range(2)]
    perception.reset(SCENARIO, EGO, 0)
    for before, again in zip(first, [perceive(perception, step) for step in range(2)], strict=True):
        np.testing.assert_array_equal(before.boxes.array, again.boxes.array)
        np.testing.assert_array_equal(before.score, again.score)


def test_the_world_is_built_once_for_all_perceptions_of_an_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    built = []
    show(monkeypatch, lambda scenario, seed: built.append(seed) or ground())
    for perception in (started(), started(cooperative=False)):
        perception.reset(SCENARIO, EGO, 0)
        perception.reset(SCENARIO, EGO, 1)
    assert built == [0, 1]


def test_messages_have_the_interval_of_the_loop_or_it_is_said() -> None:
    radio = DetectorPerception(PointCounter(), channel=PRESETS["its-g5-6"], interval_s=0.1)
    with pytest.raises(SettingsError, match=r"detect_every_s: expected that of the perception, 0\.1 .*, found 0\.5"):
        ClosedLoop(SCENARIO, radio, settings=LoopSettings(detect_every_s=0.5))
    assert ClosedLoop(SCENARIO, radio).settings.detect_every_s == 0.1
    for without in ({"channel": PRESETS["ideal"]}, {"channel": PRESETS["its-g5-6"], "cooperative": False}):
        at_once = DetectorPerception(PointCounter(), interval_s=0.1, **without)
        assert ClosedLoop(SCENARIO, at_once, settings=LoopSettings(detect_every_s=0.5)).settings.detect_every_s == 0.5
