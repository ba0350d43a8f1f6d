"""A detector at the wheel: what it finds in the sweeps is put where it is in the world."""

from dataclasses import replace as changed

import numpy as np
import pytest
from msgspec.structs import replace

from dsrc.closed_loop.env import choose_ego
from dsrc.closed_loop.episodes import make_perception
from dsrc.closed_loop.former_perception import DetectorPerception
from dsrc.data.sample import Sample, make_sample
from sensors.recording.record import record
from sensors.sweep import POINT_FIELDS
from sim.boxes import Boxes
from sim.catalog.load import load_scenario
from sim.errors import SettingsError
from sim.radio import PRESETS
from sim.scenario import RoadsideUnit
from sim.traffic.base import Actors
from sim.traffic.sumo.traffic import SumoTraffic
from tests.dsrc.evaluation.fakes import PointCounter
from tests.sensors.fakes import StraightTraffic, box_body, cars, ground, rows_of, toy_scenario

SCENARIO, SEED = load_scenario("four_way"), 3


@pytest.fixture(scope="module")
def world() -> tuple[int, Actors, Actors]:
    """The ego of a junction, and the actors of two instants in a row."""
    with SumoTraffic(SCENARIO, SEED) as traffic:
        ego = choose_ego(traffic, SCENARIO)
        before = traffic.actors
        return ego, before, traffic.step()


class Labelled(PointCounter):
    """Detects the boxes that it was given, where they hold enough points."""

    boxes = Boxes.zeros()

    def detect(self, sample: Sample):
        return super().detect(changed(sample, boxes=self.boxes))


def perceive(world: tuple[int, Actors, Actors], cooperative: bool, corruption: str = "clean") -> tuple[Boxes, Sample]:
    ego, before, now = world
    detector = Labelled(need=5)
    perception = DetectorPerception(detector, cooperative, corruption)
    perception.reset(SCENARIO, ego, SEED)
    detector.boxes = make_sample(perception.sense(before, now), ego, detector.settings.grid).boxes
    perception.reset(SCENARIO, ego, SEED)
    return perception.perceive(before, now), detector.seen[-1]


def test_boxes_come_back_where_they_are_in_the_world(world: tuple[int, Actors, Actors]) -> None:
    ego, _, now = world
    boxes, _ = perceive(world, cooperative=True)
    truth = now.boxes[now.boxes.object_id != ego]
    assert len(boxes) >= 2
    apart = np.linalg.norm(boxes.center[:, None] - truth.center[None], axis=2).min(axis=1)
    assert apart.max() < 1e-3


def test_the_ego_alone_receives_nothing_and_detects_no_more_than_all_together(
    world: tuple[int, Actors, Actors],
) -> None:
    alone, own = perceive(world, cooperative=False)
    together, shared = perceive(world, cooperative=True)
    assert own.agent_ids == (world[0],)
    assert shared.agent_ids[0] == world[0]
    assert len(shared.agent_ids) > 1
    np.testing.assert_array_equal(own.clouds[0], shared.clouds[0])
    assert len(alone) <= len(together)


def test_a_detector_gets_no_ground_truth(world: tuple[int, Actors, Actors]) -> None:
    ego, before, now = world
    detector = PointCounter(need=0)
    perception = DetectorPerception(detector)
    perception.reset(SCENARIO, ego, SEED)
    assert len(perception.perceive(before, now)) == 0
    (sample,) = detector.seen
    assert len(sample.agent_ids) == len(sample.agent_boxes) > 1
    assert [len(boxes) for boxes in (sample.boxes, *sample.agent_boxes)] == [0] * (1 + len(sample.agent_ids))


def test_the_live_sweeps_are_those_of_the_recorded_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sim.bodies.choice.body_mesh", box_body)
    monkeypatch.setattr("sim.world.build.build_world", lambda scenario, seed: ground(1000.0))
    unit = RoadsideUnit(xyz_m=(20.0, 8.0, 5.0), yaw_deg=-90.0, pitch_deg=15.0, lidar="debug-16")
    scenario = toy_scenario(vehicles=3, roadside=(unit,), mount_xyz_m=(0.5, 0.0, 2.1))
    start = cars([[0, 0, 0], [12, 3.5, 0], [-15, -3.5, 0], [300, 0, 0]], speed=10.0)
    recording = record(StraightTraffic(start), ground(1000.0), scenario, SEED, 4)
    traffic = StraightTraffic(start)
    perception = DetectorPerception(PointCounter())
    perception.reset(scenario, recording.vehicles[0], SEED)
    for index in (1, 2, 3):
        live, recorded = perception.sense(traffic.actors, traffic.step()), recording.frame(index)
        assert live.index == index and [a.agent_id for a in live.agents] == list(recording.agent_ids)
        for ours, theirs in zip(live.agents, recorded.agents, strict=True):
            for name in POINT_FIELDS:
                assert getattr(ours.sweep, name).tobytes() == getattr(theirs.sweep, name).tobytes()


def test_collaborators_stay_the_same_and_one_that_leaves_is_not_replaced(world: tuple[int, Actors, Actors]) -> None:
    ego, before, now = world
    perception = DetectorPerception(PointCounter())
    perception.reset(SCENARIO, ego, SEED)
    first = [agent.agent_id for agent in perception.sense(before, now).agents]
    gone = next(agent for agent in first if agent >= 0 and agent != ego)
    rows = [row for row, key in enumerate(now.boxes.object_id) if key != gone]
    later = changed(rows_of(now, rows), time_s=now.time_s + SCENARIO.step_s)
    assert [agent.agent_id for agent in perception.sense(now, later).agents] == [a for a in first if a != gone]


def test_a_corruption_changes_the_sweeps_the_same_way_each_time(world: tuple[int, Actors, Actors]) -> None:
    clean, fog, again = (perceive(world, True, kind)[1].clouds[0] for kind in ("clean", "fog", "fog"))
    np.testing.assert_array_equal(fog, again)
    assert not np.array_equal(clean, fog)


def test_a_late_channel_shows_the_collaborators_as_they_were(world: tuple[int, Actors, Actors]) -> None:
    ego, before, now = world
    clouds: dict[str, list[tuple[np.ndarray, ...]]] = {}
    for name in ("ideal", "paper"):
        detector = PointCounter(need=5)
        spec = replace(PRESETS[name], position_error_m=0.0, heading_error_deg=0.0)
        perception = DetectorPerception(detector, channel=spec)
        perception.reset(SCENARIO, ego, SEED)
        perception.perceive(changed(before, time_s=before.time_s - 0.1), before)
        perception.perceive(before, now)
        clouds[name] = [sample.clouds for sample in detector.seen]
        assert all(link.received for link in perception.links)
    first, second = clouds["paper"]
    assert len(first) == 1 < len(second)  # nothing had arrived when the drive began
    assert len(clouds["ideal"][1]) == len(second)
    np.testing.assert_array_equal(clouds["ideal"][1][0], second[0])
    assert not all(map(np.array_equal, clouds["ideal"][1][1:], second[1:]))


def test_a_channel_needs_messages() -> None:
    with pytest.raises(SettingsError, match="channel: expected 'ideal' with perception 'ego'"):
        make_perception("ego", None, channel="paper")
