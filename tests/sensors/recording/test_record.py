from typing import Any

import numpy as np
import pytest

from sensors.presets import get_lidar
from sensors.recording.agent_selection import choose_agents
from sensors.recording.mounting import mount, place_roadside
from sensors.recording.record import Recording, record
from sensors.recording.rig import TRUTH_RANGE_M
from sensors.sweep import POINT_FIELDS
from sim.errors import ScenarioError, SettingsError
from sim.scenario import NetworkSpec, RoadsideUnit, Scenario
from tests.sensors.fakes import StraightTraffic, box, box_body, cars, ground, scene_of, toy_scenario

ROWS = [[0, 0, 0], [12, 3.5, 0], [-15, -3.5, np.pi], [60, 0, 0], [300, 0, 0]]
UNIT = RoadsideUnit(xyz_m=(20.0, 8.0, 5.0), yaw_deg=-90.0, pitch_deg=15.0, lidar="debug-16")


def recording_of(
    frames: int = 3, seed: int = 1, gone_at: dict[int, int] | None = None, scenario: Scenario | None = None, **more: Any
) -> Recording:
    traffic = StraightTraffic(cars(ROWS, speed=10.0), gone_at=gone_at)
    scenario = scenario or toy_scenario(roadside=(UNIT,))
    return record(traffic, ground(1000.0), scenario, seed, frames, body_mesh=box_body, **more)


def test_every_agent_has_every_frame_at_the_same_instant() -> None:
    recording = recording_of(frames=4)
    frames = list(recording)
    assert [f.index for f in frames] == [0, 1, 2, 3]
    np.testing.assert_allclose(np.diff([f.time_s for f in frames]), 0.1)
    for frame in frames:
        ids = [agent.agent_id for agent in frame.agents]
        assert ids == list(recording.agent_ids)
        assert ids[-1] == -1
        assert {agent.sweep.time_s for agent in frame.agents} == {frame.time_s}


def test_a_longer_drive_begins_with_the_same_traffic_and_may_have_another_ego() -> None:
    gone_at = {1000: 6, 1002: 6}
    short, long = (recording_of(frames=frames, seed=3, gone_at=gone_at) for frames in (3, 9))
    for first, second in zip(short.steps[:3], long.steps[:3], strict=True):
        assert np.array_equal(first.boxes.array, second.boxes.array)
    assert short.vehicles != long.vehicles and set(long.vehicles) == {1001, 1003}
    assert recording_of(frames=3, seed=3, gone_at=gone_at).vehicles == short.vehicles


def test_truth_holds_actors_near_any_agent_and_the_agents_themselves() -> None:
    frame = recording_of().frame(0)
    assert frame.truth.object_id.tolist() == [1000, 1001, 1002, 1003]
    agents = np.array([agent.world_from_body[:2, 3] for agent in frame.agents])
    nearest = np.linalg.norm(frame.truth.center[:, None, :2] - agents, axis=-1).min(axis=1)
    assert (nearest <= TRUTH_RANGE_M).all()
    for agent in frame.agents[:-1]:
        assert agent.agent_id in frame.truth.object_id


def test_counts_are_of_the_sweeps_and_zero_on_the_own_body() -> None:
    frame = recording_of().frame(1)
    for row, agent in enumerate(frame.agents):
        for column, object_id in enumerate(frame.truth.object_id):
            assert frame.points_on[row, column] == (agent.sweep.object_id == object_id).sum()
        own = frame.truth.object_id == agent.agent_id
        assert (frame.points_on[row, own] == 0).all()
    assert frame.points_on.sum() > 0


def test_a_frame_does_not_depend_on_the_frames_before_it() -> None:
    whole = list(recording_of(frames=3))
    resumed = recording_of(frames=3).frame(2)
    for agent, again in zip(whole[2].agents, resumed.agents, strict=True):
        for name in POINT_FIELDS:
            assert getattr(agent.sweep, name).tobytes() == getattr(again.sweep, name).tobytes()


@pytest.mark.parametrize(
    ("rule", "field"),
    [
        ({"lidar": "debug16"}, r"agents\.lidar"),
        ({"roadside": (UNIT, RoadsideUnit(xyz_m=(0.0, 0.0, 5.0), lidar="debug16"))}, r"agents\.roadside\[1\]\.lidar"),
    ],
)
def test_an_unknown_sensor_is_reported_with_its_field(rule: dict[str, Any], field: str) -> None:
    with pytest.raises(ScenarioError, match=rf"toy: {field}: expected a LiDAR preset, found debug16; .*'debug-16'"):
        recording_of(scenario=toy_scenario(**rule))


def test_noise_differs_between_agents_frames_and_seeds() -> None:
    recording = recording_of()
    first, second = recording.frame(0), recording.frame(1)
    other = recording_of(seed=2).frame(0)
    assert first.agents[-1].sweep.points.tobytes() != second.agents[-1].sweep.points.tobytes()
    assert first.agents[-1].sweep.points.tobytes() != other.agents[-1].sweep.points.tobytes()


def test_a_vehicle_that_leaves_is_no_agent() -> None:
    scenario = toy_scenario(vehicles=3)
    recording = recording_of(gone_at={1001: 2}, scenario=scenario)
    assert sorted(recording.agent_ids) == [1000, 1002, 1003]


def test_too_few_vehicles_is_one_clear_line() -> None:
    with pytest.raises(ScenarioError, match=r"agents.vehicles: expected 5 .* found 4; 5 stay for 2 frames"):
        recording_of(frames=5, gone_at={1001: 2}, scenario=toy_scenario(vehicles=5))


def test_partners_are_the_vehicles_that_stay_near() -> None:
    drive = [cars(ROWS)] * 2
    chosen = choose_agents(drive, toy_scenario(vehicles=3, within_m=40.0), np.random.default_rng(0))
    assert sorted(chosen) == [1000, 1001, 1002]


def test_vehicles_outside_the_area_carry_no_lidar() -> None:
    import msgspec

    scenario = toy_scenario(vehicles=1)
    scenario = msgspec.structs.replace(scenario, network=NetworkSpec(area_m=(50.0, -20.0, 70.0, 20.0)))
    assert choose_agents([cars(ROWS)], scenario, np.random.default_rng(0)) == [1003]


@pytest.mark.parametrize(("height", "z"), [(1.5, 1.9), (3.2, 3.4)])
def test_the_sensor_clears_the_roof(height: float, z: float) -> None:
    assert mount(get_lidar("opv2v-64"), height)[2, 3] == pytest.approx(z)


def test_a_roadside_unit_stands_on_the_ground_and_looks_down() -> None:
    agent = recording_of().frame(0).agent(-1)
    assert agent.kind == "roadside"
    np.testing.assert_allclose(agent.world_from_body[:3, 3], [20.0, 8.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(agent.sweep.world_from_lidar[:3, 3], [20.0, 8.0, 5.0], atol=1e-3)
    assert agent.sweep.world_from_lidar[2, 0] < 0.0


def test_a_roadside_unit_inside_a_building_is_warned_about(caplog: pytest.LogCaptureFixture) -> None:
    place_roadside(scene_of(ground()), (UNIT,))
    assert not caplog.records
    place_roadside(scene_of(ground() + box((1.5, 1.5, 12.0), (20.0, 8.0, 6.0))), (UNIT,))
    assert "roadside unit -1 at (20, 8, 5) stands in or before a wall" in caplog.text


@pytest.mark.parametrize(("frames", "interval_s"), [(0, 0.1), (2, 0.15), (2, float("nan")), (2, float("inf"))])
def test_impossible_frames_and_intervals_are_refused(frames: int, interval_s: float) -> None:
    with pytest.raises(SettingsError):
        recording_of(frames=frames, interval_s=interval_s)


def test_interval_may_skip_traffic_steps() -> None:
    times = [frame.time_s for frame in recording_of(frames=2, interval_s=0.3)]
    np.testing.assert_allclose(np.diff(times), 0.3)
