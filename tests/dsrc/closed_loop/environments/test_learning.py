"""Agents of stable-baselines3 run in the environments; without that package there is nothing to test."""

import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from dsrc.closed_loop.environments import ENVIRONMENTS

sb3 = pytest.importorskip("stable_baselines3")
pytestmark = pytest.mark.filterwarnings("default")

SCENARIO = "ima_building:no_conflict"


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_its_check_finds_nothing(name: str) -> None:
    from stable_baselines3.common.env_checker import check_env

    env = gym.make(name, scenario=SCENARIO, disable_env_checker=True).unwrapped
    with warnings.catch_warnings():
        # Advice for images and flat vectors: MlpPolicy flattens a table of vehicles itself.
        warnings.filterwarnings("error")
        warnings.filterwarnings("ignore", message=".*unconventional shape.*")
        check_env(env)
    env.close()


def test_a_policy_learns_is_saved_loads_and_drives(tmp_path: Path) -> None:
    env = gym.make("dsrc/Meta-v0", scenario=SCENARIO, policy_frequency=5)
    sb3.PPO("MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=1, seed=0).learn(32).save(tmp_path / "policy")
    policy = sb3.PPO.load(tmp_path / "policy", env=env)
    observed, _ = env.reset(seed=1)
    action, _ = policy.predict(observed, deterministic=True)
    assert np.isfinite(env.step(action)[1])
    env.close()


def test_a_policy_of_highway_env_s_intersection_drives_unchanged(tmp_path: Path) -> None:
    theirs = gym.make("intersection-v0", disable_env_checker=True)
    sb3.PPO("MlpPolicy", theirs, n_steps=16, batch_size=16, n_epochs=1, seed=0).learn(16).save(tmp_path / "policy")
    config = {key: theirs.unwrapped.config[key] for key in ("observation", "action", "policy_frequency")}
    theirs.close()
    ours = gym.make("dsrc/Meta-v0", scenario="four_way", origin="junction", config=config)
    policy = sb3.PPO.load(tmp_path / "policy", env=ours)
    observed, _ = ours.reset(seed=1)
    for _ in range(3):
        observed, reward, *_ = ours.step(policy.predict(observed, deterministic=True)[0])
        assert np.isfinite(reward)
    ours.close()
