"""The fast Kinematics observation has the numbers of highway-env's, and an origin."""

import numpy as np
import pytest
from highway_env.envs.common.observation import KinematicObservation

from dsrc.closed_loop.environments import ENVIRONMENTS
from dsrc.closed_loop.environments.driving import DrivingEnv
from dsrc.closed_loop.environments.observation import Kinematics

INTERSECTION = {
    "type": "Kinematics",
    "vehicles_count": 15,
    "features": ["presence", "x", "y", "vx", "vy", "cos_h", "sin_h"],
    "features_range": {"x": [-100, 100], "y": [-100, 100], "vx": [-20, 20], "vy": [-20, 20]},
    "absolute": True,
}
"""Observation of highway-env's `intersection-v0`."""


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"absolute": True, "normalize": False, "features": ["heading", "x", "vx", "presence"]},
        {"see_behind": True, "clip": False, "vehicles_count": 30, "features_range": {"x": [-50, 50], "vy": [-9, 9]}},
        {"order": "shuffled", "vehicles_count": 3},
    ],
    ids=["default", "absolute", "ranges", "shuffled"],
)
def test_the_numbers_are_those_of_highway_env(settings: dict) -> None:
    env = DrivingEnv(scenario="four_way")
    env.reset(seed=1)
    ours, theirs = Kinematics(env, **settings), KinematicObservation(env, **settings)
    differing, most = [], 0
    for _ in range(5):
        env.step(np.array([0.1], np.float32))
        state = env.np_random.bit_generator.state
        expected = theirs.observe()
        env.np_random.bit_generator.state = state
        found = ours.observe()
        if not np.allclose(found, expected, atol=1e-5):
            differing.append((found, expected))
        most = max(most, len(env.road.vehicles))
    env.close()
    assert not differing
    assert most > 5


def test_features_that_need_more_are_left_to_highway_env() -> None:
    assert Kinematics.serves({"type": "Kinematics"})
    assert not Kinematics.serves({"type": "Kinematics", "features": ["x", "cos_d"]})
    assert not Kinematics.serves({"type": "OccupancyGrid"})
    env = DrivingEnv(scenario="four_way", observation={"type": "Kinematics", "features": ["x", "cos_d", "lat_off"]})
    observed, _ = env.reset(seed=2)
    assert env.observation_space.contains(observed) and not isinstance(env.observation_type, Kinematics)
    env.close()


@pytest.mark.parametrize("scenario", ["four_way", "ima_building", "ped_dartout"])
def test_an_ego_comes_to_the_junction_like_that_of_intersection_v0(scenario: str) -> None:
    action = ENVIRONMENTS["dsrc/Meta-v0"]
    env = DrivingEnv(scenario=scenario, observation=INTERSECTION, action=action, origin="junction")
    observed, _ = env.reset(seed=4)
    _, x, y, vx, vy, cos, sin = observed[0]
    assert 0.0 <= 100.0 * x < 10.0  # in the right half of the road
    assert 10.0 < 100.0 * y <= 100.0  # driving up to it, the y axis pointing down
    assert sin < -0.99 and abs(cos) < 0.1
    assert vy < 0.0 and abs(vx) < 0.02
    ego, others = env.vehicle.position, observed[1:][observed[1:, 0] == 1.0, 1:3]
    away = [np.linalg.norm(100.0 * (other - observed[0, 1:3])) for other in others if (abs(other) < 1.0).all()]
    real = [np.linalg.norm(vehicle.position - ego) for vehicle in env.road.vehicles[1:]]
    assert all(np.abs(np.array(real) - one).min() < 1e-3 for one in away)
    env.close()
