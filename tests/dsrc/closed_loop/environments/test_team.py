"""PettingZoo's parallel API over several egos: its own test, and the gymnasium environment of one ego beside it."""

import sys
import warnings

import numpy as np
import pytest

from dsrc.closed_loop.environments.driving import DrivingEnv
from dsrc.closed_loop.environments.parallel import parallel_env
from sim.errors import SettingsError

SHORT = {"duration": 1.0}


def test_the_extra_is_named_where_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pettingzoo", None)
    monkeypatch.delitem(sys.modules, "dsrc.closed_loop.environments.team", raising=False)
    with pytest.raises(SettingsError, match=r"pip install 'dsrc-testbed\[pettingzoo\]'"):
        parallel_env()


def test_it_passes_the_test_of_pettingzoo() -> None:
    test = pytest.importorskip("pettingzoo.test")
    env = parallel_env(egos=3, **SHORT)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        test.parallel_api_test(env, num_cycles=20)
    env.close()


def test_an_agent_alone_has_the_numbers_of_the_gymnasium_environment() -> None:
    pytest.importorskip("pettingzoo")
    single = DrivingEnv(action={"type": "ContinuousAction", "longitudinal": True, "lateral": False}, **SHORT)
    found = [single.reset(seed=3), *(single.step(np.array([0.4], np.float32)) for _ in range(5))]
    single.close()
    env = parallel_env(egos=1, **SHORT)
    assert env.action_space("ego_0") == single.action_space
    assert env.observation_space("ego_0") == single.observation_space
    observations, infos = env.reset(seed=3)
    assert np.array_equal(observations["ego_0"], found[0][0]) and infos["ego_0"]["outcome"] == ""
    for expected in found[1:]:
        step = env.step({"ego_0": np.array([0.4], np.float32)})
        assert np.array_equal(step[0]["ego_0"], expected[0])
        assert [part["ego_0"] for part in step[1:4]] == list(expected[1:4])
    env.close()


def test_several_agents_see_each_other_and_leave_when_the_time_is_over() -> None:
    pytest.importorskip("pettingzoo")
    env = parallel_env(egos=2, **SHORT)
    first = env.reset(seed=0)[0]
    again = env.reset(seed=0)[0]
    assert all(np.array_equal(first[agent], again[agent]) for agent in env.possible_agents)
    assert not np.array_equal(first["ego_0"], first["ego_1"])
    steps = 0
    while env.agents:
        actions = {"ego_0": np.array([1.0], np.float32), "ego_1": np.array([-1.0], np.float32)}
        _, _, terminated, truncated, infos = env.step(actions)
        steps += 1
    assert steps == 10 and truncated == {"ego_0": True, "ego_1": True} and not any(terminated.values())
    speeds = [infos[agent]["speed"] for agent in env.possible_agents]
    assert speeds[0] > speeds[1]
    env.close()


def test_steering_and_a_wrong_number_of_perceptions_are_refused() -> None:
    pytest.importorskip("pettingzoo")
    with pytest.raises(SettingsError, match="without steering"):
        parallel_env(action={"type": "ContinuousAction", "longitudinal": True, "lateral": True})
    with pytest.raises(SettingsError, match="a perception of all or one of each of 3"):
        parallel_env(egos=3, perception=["truth"])
