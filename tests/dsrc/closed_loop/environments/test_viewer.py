"""Pictures of the environments: road, ego, tracks and what it has no track of."""

import gymnasium as gym
import numpy as np
import pytest

from dsrc.closed_loop.environments import ENVIRONMENTS
from dsrc.closed_loop.environments.viewer import _ROAD, _UNSEEN, CRASHED, EGO, TRACK
from dsrc.closed_loop.types import Percept
from sim.boxes import Boxes
from sim.scenario import Scenario
from sim.traffic.base import Actors


class Blind:
    """Perceives nothing."""

    cooperative = False

    def reset(self, scenario: Scenario, ego_id: int, seed: int) -> None:
        pass

    def perceive(self, before: Actors, now: Actors, claims: dict[str, Actors]) -> Percept:
        return Percept(now.time_s, Boxes.zeros(), np.zeros(0), np.zeros((0, 2)))


def colours(picture: np.ndarray) -> set[tuple[int, int, int]]:
    return set(map(tuple, picture.reshape(-1, 3).tolist()))


@pytest.mark.parametrize(
    "name", [name if "Free" in name else pytest.param(name, marks=pytest.mark.slow) for name in ENVIRONMENTS]
)
def test_a_picture_has_the_ego_in_its_middle_the_road_and_the_tracks(name: str) -> None:
    env = gym.make(name, scenario="ima_building", render_mode="rgb_array", disable_env_checker=True)
    env.reset(seed=3)
    steady = 1 if env.action_space.shape == () else np.zeros(env.action_space.shape, np.float32)
    for _ in range(25):
        env.step(steady)
    picture = env.render()
    assert picture.shape == (600, 600, 3)
    assert tuple(picture[300, 300]) == EGO
    assert {_ROAD, TRACK} <= colours(picture) and _UNSEEN not in colours(picture)
    env.close()


@pytest.mark.slow
def test_who_has_no_track_is_an_outline_and_a_crashed_ego_is_red() -> None:
    action = np.array([0.3], np.float32)
    env = gym.make("dsrc/Rail-v0", scenario="stalled_after_curve", perception=Blind(), render_mode="rgb_array")
    env.reset(seed=3)
    over = False
    while not over:
        _, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated
    assert info["outcome"] == "crashed"
    seen = colours(env.render())
    assert {CRASHED, _UNSEEN} <= seen and TRACK not in seen
    env.close()


@pytest.mark.slow
def test_a_window_shows_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "offscreen")
    env = gym.make("dsrc/Meta-v0", scenario="ima_building", render_mode="human", disable_env_checker=True)
    env.reset(seed=3)
    for _ in range(25):
        env.step(1)
    assert {EGO, TRACK, _ROAD} <= colours(env.unwrapped.viewer.get_image())
    env.close()
