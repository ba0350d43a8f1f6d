"""Environments of the closed loop: gymnasium's checks, highway-env's spaces, perceived tracks instead of the truth."""

import subprocess
import sys
import warnings
from importlib.metadata import entry_points
from typing import Any

import gymnasium as gym
import highway_env
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dsrc.closed_loop.environments import ENVIRONMENTS
from dsrc.closed_loop.environments.driving import DrivingEnv
from dsrc.closed_loop.loop import ClosedLoop
from dsrc.closed_loop.types import Outcome, Percept, Perception
from sim.boxes import Boxes
from sim.errors import SettingsError, TrafficError
from sim.scenario import Scenario
from sim.traffic.base import Actors

SCENARIO = "ima_building:no_conflict"


class Blind:
    """Perceives nothing."""

    cooperative = False

    def reset(self, scenario: Scenario, ego_id: int, seed: int) -> None:
        pass

    def perceive(self, before: Actors, now: Actors, claims: dict[str, Actors]) -> Percept:
        return Percept(now.time_s, Boxes.zeros(), np.zeros(0), np.zeros((0, 2)))


def drive(env: DrivingEnv, action: Any, steps: int = 400) -> list[tuple]:
    env.reset(seed=3)
    taken = []
    for _ in range(steps):
        taken.append(env.step(action))
        if taken[-1][2] or taken[-1][3]:
            break
    env.close()
    return taken


@pytest.mark.parametrize(
    "name", [name if "Free" in name else pytest.param(name, marks=pytest.mark.slow) for name in ENVIRONMENTS]
)
def test_gymnasium_finds_nothing_to_complain_about(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gym.make(name, scenario=SCENARIO, render_mode="rgb_array", disable_env_checker=True)
        check_env(env.unwrapped, skip_render_check=False)
        env.close()


@pytest.mark.parametrize(("perception", "sees"), [("truth", True), (Blind(), False)])
def test_an_agent_may_look_at_the_seen_space(perception: str | Perception, sees: bool) -> None:
    env = gym.make("dsrc/Rail-v0", scenario=SCENARIO, perception=perception).unwrapped
    assert isinstance(env, DrivingEnv)
    env.reset(seed=3)
    place = env.loop.tick.ego.box.center[:, :2]
    assert (env.seen is not None) == sees
    if env.seen is not None:
        assert env.seen.sees(place).all() and not env.seen.sees(place + 1000.0).any()
    env.close()


@pytest.mark.slow
def test_an_id_is_known_to_make_by_its_module() -> None:
    code = "import gymnasium; print(gymnasium.make('dsrc.closed_loop.environments:dsrc/Rail-v0').spec.id)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["dsrc/Rail-v0"]


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_configuration_changes_the_action_of_an_id_only_where_it_has_one(name: str) -> None:
    of_id, configured = gym.make(name, scenario=SCENARIO), gym.make(name, config={"scenario": SCENARIO})
    assert of_id.action_space == configured.action_space
    assert configured.unwrapped.config["scenario"] == SCENARIO
    steered = {"type": "ContinuousAction", "lateral": True}
    for settings in ({"config": {"action": steered}}, {"action": steered}):
        assert gym.make(name, **settings).action_space.shape == (2,)


@pytest.mark.parametrize("scenario", ["four_way", SCENARIO])
def test_slower_is_slower_in_town_down_to_a_stop(scenario: str) -> None:
    env = gym.make("dsrc/Meta-v0", scenario=scenario, perception=Blind(), policy_frequency=5).unwrapped
    env.reset(seed=1)
    speeds = [env.loop.tick.ego.speed_mps]
    slower = {name: number for number, name in env.action_type.actions.items()}["SLOWER"]
    while env.loop.outcome is None and len(speeds) < 60:
        env.step(slower)
        speeds.append(env.loop.tick.ego.speed_mps)
    assert speeds[0] > 4.0 and (np.diff(speeds) < 0.05).all() and speeds[-1] < 0.1
    env.close()


def test_a_return_is_at_most_1_where_an_episode_ends_within_an_action() -> None:
    env = DrivingEnv(scenario=SCENARIO, policy_frequency=1)
    taken = drive(env, np.array([1.0], np.float32))
    assert taken[-1][4]["outcome"] == Outcome.ARRIVED.value
    assert 0.5 < sum(step[1] for step in taken) <= 1.0


def test_the_entry_point_registers_the_ids() -> None:
    (point,) = entry_points(group="gymnasium.envs", name="__root__").select(module="dsrc.closed_loop.environments")
    point.load()()
    assert set(ENVIRONMENTS) <= set(gym.registry)


def test_one_seed_is_one_episode_and_another_seed_another() -> None:
    env = DrivingEnv(scenario="four_way", duration=2.0)

    def rewards(seed: int) -> list[float]:
        env.reset(seed=seed)
        return [env.step(np.array([0.2], np.float32))[1] for _ in range(15)]

    assert rewards(1) == rewards(1) != rewards(2)
    env.close()


def test_a_full_throttle_arrives_and_a_full_brake_does_not() -> None:
    env = DrivingEnv(scenario=SCENARIO)
    arrived = drive(env, np.array([1.0], np.float32))
    assert arrived[-1][4]["outcome"] == Outcome.ARRIVED.value and arrived[-1][2]
    stuck = drive(env, np.array([-1.0], np.float32))
    assert stuck[-1][4]["outcome"] == Outcome.STUCK.value
    assert sum(step[1] for step in arrived) > sum(step[1] for step in stuck) + 0.3


def test_a_blind_driver_crashes_into_what_it_does_not_perceive() -> None:
    env = DrivingEnv(scenario="stalled_after_curve", perception=Blind())
    taken = drive(env, np.array([0.3], np.float32))
    assert taken[-1][4]["outcome"] == Outcome.CRASHED.value and taken[-1][2]
    assert taken[-1][1] == min(step[1] for step in taken)
    assert all((step[0][1:, 0] == 0.0).all() for step in taken)  # no track is present


def test_arriving_earns_more_than_creeping_and_creeping_more_than_crashing() -> None:
    earned = {}
    for name, scenario, perception, speed in (
        (Outcome.ARRIVED, SCENARIO, "truth", 15.0),
        (Outcome.TIMEOUT, SCENARIO, "truth", 0.5),
        (Outcome.CRASHED, "stalled_after_curve", Blind(), 15.0),
    ):
        env = DrivingEnv(scenario=scenario, perception=perception)
        env.reset(seed=3)
        over, total = False, 0.0
        while not over:
            action = np.clip([0.2 * (speed - env.vehicle.speed)], -1.0, 1.0).astype(np.float32)
            _, reward, terminated, truncated, info = env.step(action)
            assert set(info["rewards"]) == {"collision_reward", "progress_reward", "comfort_reward"}
            over, total = terminated or truncated, total + reward
        assert info["outcome"] == name.value
        earned[name] = total
        env.close()
    assert 1.0 >= earned[Outcome.ARRIVED] > 0.5 > earned[Outcome.TIMEOUT] > 0.0 > earned[Outcome.CRASHED] >= -1.2


def test_a_reward_that_is_not_normalized_counts_steps_at_the_speed_limit() -> None:
    rewards = []
    for normalize in (True, False):
        env = DrivingEnv(scenario="four_way", normalize_reward=normalize, duration=20.0)
        env.reset(seed=1)
        rewards.append(env.step(np.array([0.2], np.float32))[1])
        env.close()
    assert 0.0 < rewards[1] <= 1.0 and rewards[1] == pytest.approx(200.0 * rewards[0])


def test_the_truth_is_observed_where_it_is() -> None:
    env = DrivingEnv(scenario="four_way")
    observed, _ = env.reset(seed=1)
    tick = env.loop.tick
    offset = tick.tracks.boxes.center[:, :2] - tick.ego.box.center[0, :2]
    shown = 100.0 * observed[1:][observed[1:, 0] == 1.0, 1:3] * [1.0, -1.0]
    near = offset[(np.abs(offset) < 100.0).all(axis=1)]
    for row in shown[(np.abs(shown) < 99.9).all(axis=1)]:
        assert np.linalg.norm(near - row, axis=1).min() < 1e-3
    env.close()


@pytest.mark.parametrize(
    "observation",
    [
        {"type": "OccupancyGrid"},
        {"type": "LidarObservation", "cells": 32},
        {"type": "TimeToCollision", "horizon": 10},
    ],
    ids=lambda observation: observation["type"],
)
def test_observations_of_highway_env_are_there(observation: dict) -> None:
    action = ENVIRONMENTS["dsrc/Meta-v0"]
    env = DrivingEnv(scenario="four_way", observation=observation, action=action, policy_frequency=5)
    observed, _ = env.reset(seed=1)
    assert env.observation_space.contains(observed)
    assert env.observation_space.contains(env.step(1)[0])
    env.close()


def test_spaces_of_highway_env_s_intersection_are_ours_under_its_settings() -> None:
    highway_env.register_highway_envs() if hasattr(highway_env, "register_highway_envs") else None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs = gym.make("intersection-v0", disable_env_checker=True)
    config = {key: theirs.unwrapped.config[key] for key in ("observation", "action")}
    ours = DrivingEnv(scenario="four_way", policy_frequency=1, **config)
    observed, _ = ours.reset(seed=1)
    assert theirs.observation_space == ours.observation_space and theirs.action_space == ours.action_space
    assert ours.observation_space.contains(observed)
    ours.close()
    theirs.close()


@pytest.mark.parametrize("scenario", [SCENARIO, "four_way"])
def test_environments_run_in_processes(scenario: str) -> None:
    envs = gym.make_vec("dsrc/Rail-v0", num_envs=2, vectorization_mode="async", scenario=scenario)
    observed, _ = envs.reset(seed=[1, 2])
    assert observed.shape == (2, 16, 7)
    assert not np.array_equal(observed[0], observed[1])
    observed, rewards, *_ = envs.step(np.zeros((2, 1), np.float32))
    assert rewards.shape == (2,)
    envs.close()


def test_environments_of_encounters_run_side_by_side_in_one_process_those_of_sumo_say_that_they_do_not() -> None:
    envs = gym.make_vec("dsrc/Rail-v0", num_envs=2, vectorization_mode="sync", scenario=SCENARIO)
    envs.reset(seed=[1, 2])
    assert envs.step(np.zeros((2, 1), np.float32))[1].shape == (2,)
    envs.close()
    envs = gym.make_vec("dsrc/Rail-v0", num_envs=2, vectorization_mode="sync", scenario="four_way")
    with pytest.raises(TrafficError, match=r"already runs in this process and libsumo .* another process"):
        envs.reset(seed=[1, 2])
    envs.close()


@pytest.mark.parametrize(
    ("name", "action"), [("dsrc/Rail-v0", [np.nan]), ("dsrc/Free-v0", [0.0, np.nan]), ("dsrc/Free-v0", [np.inf, 0.0])]
)
def test_an_action_that_is_not_finite_is_refused(name: str, action: list[float]) -> None:
    env = DrivingEnv(scenario=SCENARIO, action=ENVIRONMENTS[name])
    env.reset(seed=1)
    with pytest.raises(ValueError, match="action must be finite"):
        env.step(np.array(action, np.float32))
    env.close()


@pytest.mark.parametrize(
    ("name", "action", "message"),
    [
        ("dsrc/Rail-v0", np.zeros(7), r"the shape \(1,\), got \(7,\)"),
        ("dsrc/Rail-v0", 0.5, r"the shape \(1,\), got \(\)"),
        ("dsrc/Meta-v0", 7, r"of Discrete\(\d\), got 7"),
        ("dsrc/Meta-v0", 1.5, "got 1.5"),
    ],
)
def test_an_action_out_of_its_space_is_refused(name: str, action: Any, message: str) -> None:
    env = DrivingEnv(scenario=SCENARIO, action=ENVIRONMENTS[name])
    env.reset(seed=1)
    with pytest.raises(ValueError, match=f"action must .*{message}"):
        env.step(action)
    env.close()


def test_a_step_after_the_end_earns_nothing() -> None:
    env = DrivingEnv(scenario=SCENARIO, policy_frequency=1)
    taken = drive(env, np.array([1.0], np.float32))
    assert taken[-1][2]
    env.reset(seed=3)
    for _ in taken:
        env.step(np.array([1.0], np.float32))
    _, reward, terminated, *_ = env.step(np.array([1.0], np.float32))
    assert terminated and reward == 0.0
    env.close()


def test_a_wrong_setting_is_named() -> None:
    with pytest.raises(SettingsError, match="scenery"):
        DrivingEnv(scenery="four_way")
    with pytest.raises(SettingsError, match="origin: expected 'world' or 'junction', found moon"):
        DrivingEnv(origin="moon")
    with pytest.raises(SettingsError, match="policy_frequency"):
        DrivingEnv(scenario=SCENARIO, policy_frequency=7).reset(seed=1)


def free(scenario: str, action: list[float], steps: int = 150) -> DrivingEnv:
    env = DrivingEnv(scenario=scenario, perception=Blind(), action=ENVIRONMENTS["dsrc/Free-v0"])
    env.reset(seed=3)
    for _ in range(steps):
        if any(env.step(np.array(action, np.float32))[2:4]):
            break
    return env


@pytest.mark.parametrize(
    "scenario",
    ["ima_building:no_conflict", "four_way", pytest.param("highway_env_two_way", marks=pytest.mark.slow)],
)
def test_an_ego_that_steers_off_the_road_has_left_it_or_hit_something(scenario: str) -> None:
    env = free(scenario, [0.0, 0.3])
    assert env.loop.outcome in (Outcome.LEFT, Outcome.CRASHED)
    env.close()


@pytest.mark.parametrize("scenario", ["four_way", "highway_env_intersection"])
def test_an_ego_that_drives_off_at_right_angles_has_left_the_lanes(scenario: str) -> None:
    loop = ClosedLoop(scenario, Blind())
    loop.start(1)
    for step in range(60):
        loop.advance(0.0, -0.8 if step < 5 else 0.0)
        if loop.outcome is not None:
            break
    assert loop.outcome is Outcome.LEFT
    loop.close()


def test_a_steered_ego_is_where_its_bicycle_model_is() -> None:
    env = DrivingEnv(scenario="four_way", action=ENVIRONMENTS["dsrc/Free-v0"])
    env.reset(seed=1)
    for _ in range(5):
        before = env.vehicle.position.copy()
        env.step(np.array([0.1, 0.02], np.float32))
        box = env.loop.tick.ego.box
        moved = np.linalg.norm(env.vehicle.position - before)
        assert moved == pytest.approx(env.vehicle.speed * 0.1, abs=0.1)
        assert np.allclose(env.vehicle.position, box.center[0, :2] * [1.0, -1.0])
        assert env.vehicle.heading == pytest.approx(-float(box.yaw[0]))
    env.close()


def test_a_steered_ego_gains_no_more_speed_than_its_engine_gives() -> None:
    env = free(SCENARIO, [-1.0, 0.0], 5)
    gains = []
    for _ in range(10):
        before = env.loop.tick.ego
        env.step(np.array([1.0, 0.0], np.float32))
        gains.append((env.loop.tick.ego.speed_mps - before.speed_mps) / env.loop.scenario.step_s)
    assert max(gains) == pytest.approx(before.limits.acceleration_mps2, abs=0.05)
    env.close()


@pytest.mark.parametrize("scenario", ["four_way", "ima_building:no_conflict"])
def test_brakes_stop_a_steered_ego_and_never_drive_it_back(scenario: str) -> None:
    env = DrivingEnv(scenario=scenario, perception=Blind(), action=ENVIRONMENTS["dsrc/Free-v0"])
    env.reset(seed=0)
    speeds, progress = [env.loop.tick.ego.speed_mps], [0.0]
    while env.loop.outcome is None and len(speeds) < 60:
        env.step(np.array([-1.0, 0.0], np.float32))
        speeds.append(env.loop.tick.ego.speed_mps)
        progress.append(env.loop.tick.ego.progress_m)
    assert speeds[0] > 5.0 and min(speeds) == speeds[-1] == 0.0
    assert (np.diff(speeds) <= 1e-6).all() and (np.diff(progress) >= -1e-6).all()
    env.close()


def test_an_ego_that_is_driven_back_makes_no_progress() -> None:
    loop = ClosedLoop("ima_building:no_conflict", Blind())
    start = loop.start(0).ego
    x, y = start.box.center[0, :2]
    yaw = float(start.box.yaw[0])
    before = loop.traffic.actors
    loop.traffic.place(loop.ego_id, np.array([x - np.cos(yaw), y - np.sin(yaw)]), yaw, 0.0)
    loop.traffic.step()
    moved = loop.arrive(before).ego
    assert moved.progress_m == pytest.approx(-1.0, abs=1e-6)
    loop.close()


def test_another_configuration_ends_the_simulation_and_can_be_taken_back() -> None:
    env = DrivingEnv(scenario="four_way", perception=Blind())
    world, _ = env.reset(seed=1)
    junction, _ = env.reset(seed=1, options={"config": {"origin": "junction"}})
    again, _ = env.reset(seed=1, options={"config": {"origin": "world"}})
    assert not np.array_equal(world, junction) and np.array_equal(world, again)
    env.close()
