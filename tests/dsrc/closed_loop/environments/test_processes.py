"""The environments in processes of other libraries, by the id that names the package before the colon."""

import pytest


def test_stable_baselines_drives_in_two_processes_by_the_short_id() -> None:
    common = pytest.importorskip("stable_baselines3.common.env_util")
    vectors = pytest.importorskip("stable_baselines3.common.vec_env")
    settings = {"scenario": "ima_building:no_conflict", "policy_frequency": 5}
    env = common.make_vec_env("dsrc:dsrc/Meta-v0", 2, seed=1, env_kwargs=settings, vec_env_cls=vectors.SubprocVecEnv)
    try:
        seen = env.reset()
        assert seen.shape[0] == 2
        seen, reward, done, _ = env.step([1, 1])
        assert seen.shape[0] == len(reward) == len(done) == 2
    finally:
        env.close()
