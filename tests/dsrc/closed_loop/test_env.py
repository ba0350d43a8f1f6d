"""The closed loop in a real SUMO junction: contract, determinism, consequences."""

from pathlib import Path

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dsrc.closed_loop.env import CoopDrivingEnv
from dsrc.closed_loop.episodes import drive_episodes, idm_policy, make_perception
from dsrc.closed_loop.former_perception import TruthPerception
from sim.boxes import Boxes
from sim.errors import SettingsError
from sim.traffic.base import Actors


class Blind(TruthPerception):
    """Sees nothing."""

    def perceive(self, before: Actors, now: Actors) -> Boxes:
        return Boxes.zeros()


def run(env: CoopDrivingEnv, seed: int) -> tuple[list[float], dict]:
    """Drive one episode with the follower; return the speeds and the last info."""
    observation, info = env.reset(seed=seed)
    speeds, done = [], False
    while not done:
        observation, _, terminated, truncated, info = env.step(idm_policy(observation))
        speeds.append(float(observation["speed"][0]))
        done = terminated or truncated
    env.close()
    return speeds, info


def test_the_environment_keeps_gymnasiums_contract() -> None:
    env = CoopDrivingEnv("four_way", duration_s=2.0)
    check_env(env, skip_render_check=True)
    env.close()


def test_one_seed_is_one_episode() -> None:
    env = CoopDrivingEnv("four_way", duration_s=4.0)
    first, info = run(env, 3)
    second, again = run(env, 3)
    assert first == second
    assert info == again
    assert len(first) == 40


def test_a_parked_car_is_not_driven() -> None:
    env = CoopDrivingEnv("rilsa_1", duration_s=0.3)  # its parked cars have the first ids
    speeds, info = run(env, 0)
    assert len(speeds) == 3
    assert info["progress_m"] > 0.0


def test_who_sees_nothing_crashes_where_who_sees_does_not() -> None:
    # Two seeds, because a blind drive may be lucky once.
    crashes = {"TruthPerception": 0, "Blind": 0}
    for eyes in (TruthPerception(), Blind()):
        for seed in (0, 3):
            _, info = run(CoopDrivingEnv("braunschweig", eyes, duration_s=15.0), seed)
            crashes[type(eyes).__name__] += bool(info["collided_with"])
            assert (info["min_ttc_s"] == 0.0) == bool(info["collided_with"])
    assert crashes["TruthPerception"] == 0
    assert crashes["Blind"] > 0


def test_episodes_are_rows_of_a_file(tmp_path: Path) -> None:
    out = tmp_path / "rows.csv"
    drive_episodes("four_way", seeds=(0, 1), duration_s=1.0, out=out)
    lines = out.read_text().splitlines()
    assert lines[0].startswith("scenario,perception,corruption,severity,seed,duration_s,progress_m")
    assert [line.split(",")[4] for line in lines[1:]] == ["0", "1"]
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize("duration", [0.0, -1.0, np.nan])
def test_a_duration_that_cannot_be_is_named(duration: float) -> None:
    with pytest.raises(SettingsError, match="duration"):
        drive_episodes("four_way", duration_s=duration)


def test_the_truth_cannot_be_corrupted() -> None:
    with pytest.raises(SettingsError, match="corruption"):
        make_perception("truth", None, "fog")


def test_a_corruption_that_is_not_there_is_told_before_a_detector_is_loaded() -> None:
    with pytest.raises(SettingsError, match="did you mean 'snow'"):
        make_perception("dsrc", Path("nowhere.pt"), "snwo")
    with pytest.raises(SettingsError, match="did you mean 'paper'"):
        make_perception("dsrc", Path("nowhere.pt"), "fog", 3, "papr")  # type: ignore[arg-type]


def test_the_truth_takes_no_detector() -> None:
    with pytest.raises(SettingsError, match="checkpoint"):
        make_perception("truth", Path("detector.pt"))
