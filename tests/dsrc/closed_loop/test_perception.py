"""A detector at the wheel: what it finds in the sweeps is put where it is in the world."""

from dataclasses import replace as changed

import numpy as np
import pytest
from msgspec.structs import replace

from dsrc.closed_loop.env import choose_ego
from dsrc.closed_loop.episodes import make_perception
from dsrc.closed_loop.perception import DetectorPerception
from dsrc.data.sample import Sample
from sim.boxes import Boxes
from sim.catalog.load import load_scenario
from sim.errors import SettingsError
from sim.radio import PRESETS
from sim.traffic.base import Actors
from sim.traffic.sumo.traffic import SumoTraffic
from tests.dsrc.evaluation.fakes import PointCounter

SCENARIO, SEED = load_scenario("four_way"), 3


@pytest.fixture(scope="module")
def world() -> tuple[int, Actors, Actors]:
    """The ego of a junction, and the actors of two instants in a row."""
    with SumoTraffic(SCENARIO, SEED) as traffic:
        ego = choose_ego(traffic, SCENARIO)
        before = traffic.actors
        return ego, before, traffic.step()


def look(world: tuple[int, Actors, Actors], cooperative: bool, corruption: str = "clean") -> tuple[Boxes, Sample]:
    ego, before, now = world
    detector = PointCounter(need=5)
    eyes = DetectorPerception(detector, cooperative, corruption)
    eyes.reset(SCENARIO, ego, SEED)
    return eyes.perceive(before, now), detector.seen[-1]


def test_boxes_come_back_where_they_are_in_the_world(world: tuple[int, Actors, Actors]) -> None:
    ego, _, now = world
    boxes, _ = look(world, cooperative=True)
    truth = now.boxes[now.boxes.object_id != ego]
    assert len(boxes) >= 2
    apart = np.linalg.norm(boxes.center[:, None] - truth.center[None], axis=2).min(axis=1)
    assert apart.max() < 1e-3


def test_the_ego_alone_hears_nobody_and_sees_no_more_than_all_together(world: tuple[int, Actors, Actors]) -> None:
    alone, own = look(world, cooperative=False)
    together, shared = look(world, cooperative=True)
    assert own.agent_ids == (world[0],)
    assert shared.agent_ids[0] == world[0]
    assert len(shared.agent_ids) > 1
    np.testing.assert_array_equal(own.clouds[0], shared.clouds[0])
    assert len(alone) <= len(together)


def test_a_corruption_changes_the_sweeps_the_same_way_each_time(world: tuple[int, Actors, Actors]) -> None:
    clean, fog, again = (look(world, True, kind)[1].clouds[0] for kind in ("clean", "fog", "fog"))
    np.testing.assert_array_equal(fog, again)
    assert not np.array_equal(clean, fog)


def test_a_late_channel_shows_the_collaborators_as_they_were(world: tuple[int, Actors, Actors]) -> None:
    ego, before, now = world
    clouds: dict[str, list[tuple[np.ndarray, ...]]] = {}
    for name in ("ideal", "paper"):
        detector = PointCounter(need=5)
        spec = replace(PRESETS[name], position_error_m=0.0, heading_error_deg=0.0)
        eyes = DetectorPerception(detector, channel=spec)
        eyes.reset(SCENARIO, ego, SEED)
        eyes.perceive(changed(before, time_s=before.time_s - 0.1), before)
        eyes.perceive(before, now)
        clouds[name] = [sample.clouds for sample in detector.seen]
        assert all(link.heard for link in eyes.links)
    first, second = clouds["paper"]
    assert len(first) == 1 < len(second)  # nothing had arrived when the drive began
    assert len(clouds["ideal"][1]) == len(second)
    np.testing.assert_array_equal(clouds["ideal"][1][0], second[0])
    assert not all(map(np.array_equal, clouds["ideal"][1][1:], second[1:]))


def test_a_channel_needs_messages() -> None:
    with pytest.raises(SettingsError, match="channel: expected 'ideal' with perception 'ego'"):
        make_perception("ego", None, channel="paper")
