"""Train a policy by reinforcement learning in the closed loop, and count its crashes before and after.

Usage:
    python -m studies.closed_loop.ppo --out runs/ppo
    python -m studies.closed_loop.ppo --out runs/ppo --scenario four_way --steps 50000

stable-baselines3's PPO with its `MlpPolicy` decides five times a second how fast the ego should be (`dsrc/Meta-v0`), on
the tracks of a perception. Episodes are drawn from 40 seeds; outcomes are counted on 20 others, of actions drawn at
random before and of the most probable ones after. Needs the extra `rl`: pip install -e '.[rl]'.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib
import numpy as np

import dsrc

matplotlib.use("Agg")
import matplotlib.pyplot as plt

TRAINED, TESTED = range(40), range(1000, 1020)
"""Seeds of the training and of the test."""

RATE_HZ = 5
PPO_SETTINGS: dict[str, Any] = {
    "n_steps": 256,
    "batch_size": 64,
    "learning_rate": 5e-4,
    "gamma": 0.95,
    "ent_coef": 0.01,
    "policy_kwargs": {"net_arch": [256, 256]},
}
"""Nearly those of highway-env's own example, at its horizon of four seconds."""
SPEEDS = [0.0, 5.0, 10.0, 15.0]
"""Speeds that the policy chooses among, m/s."""


class Seeds(gym.Wrapper):
    """Environment whose episodes have some seeds, again and again.

    Args:
        env: environment.
        seeds: in the order of the episodes.
    """

    def __init__(self, env: gym.Env, seeds: range) -> None:
        super().__init__(env)
        self.seeds, self.episode = seeds, 0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        """Begin the episode of the next seed."""
        seed = self.seeds[self.episode % len(self.seeds)]
        self.episode += 1
        return self.env.reset(seed=seed, options=options)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/ppo"), help="folder of the policy and the picture")
    parser.add_argument("--scenario", default="ima_building", help="scenario")
    parser.add_argument("--perception", default="truth", help="perception")
    parser.add_argument("--steps", type=int, default=20_000, help="actions of the training")
    parser.add_argument("--tests", type=int, default=len(TESTED), help="seeds of the test, at most 20")
    args = parser.parse_args()
    try:
        from stable_baselines3 import PPO
        from stable_baselines3.common.monitor import Monitor
    except ImportError:
        parser.error("stable-baselines3 is missing: pip install -e '.[rl]'")
    dsrc.register_environments()
    settings = {"scenario": args.scenario, "perception": args.perception, "policy_frequency": RATE_HZ}
    action = {"type": "DiscreteMetaAction", "longitudinal": True, "lateral": False, "target_speeds": SPEEDS}
    env = Seeds(gym.make("dsrc/Meta-v0", action=action, **settings), TRAINED)
    policy = PPO("MlpPolicy", monitor := Monitor(env), seed=0, **PPO_SETTINGS)

    tested = TESTED[: args.tests]
    before = tally(policy, env, tested, drawn=True)
    env.seeds, env.episode = TRAINED, 0
    began = time.perf_counter()
    policy.learn(args.steps)
    seconds = time.perf_counter() - began
    returns, lengths = np.array(monitor.get_episode_rewards()), np.array(monitor.get_episode_lengths())
    after = tally(policy, env, tested, drawn=False)
    env.close()

    args.out.mkdir(parents=True, exist_ok=True)
    policy.save(args.out / "policy.zip")
    for name, counted in (("untrained", before), ("trained", after)):
        print(f"{name}: " + ", ".join(f"{outcome} {count}" for outcome, count in counted.items()))
    print(f"{args.steps} steps, {args.steps / seconds:.0f} steps/s")
    print(draw(args.out / "ppo.png", args.scenario, returns, np.cumsum(lengths), before, after))


def tally(policy: Any, env: Seeds, seeds: range, drawn: bool) -> dict[str, int]:
    """Return how often episodes ended how; the policy draws its actions, or takes the most probable ones."""
    env.seeds, env.episode = seeds, 0
    outcomes: dict[str, int] = {}
    for _ in seeds:
        observed, info = env.reset()
        over = False
        while not over:
            observed, _, terminated, truncated, info = env.step(policy.predict(observed, deterministic=not drawn)[0])
            over = terminated or truncated
        outcomes[info["outcome"]] = outcomes.get(info["outcome"], 0) + 1
    return dict(sorted(outcomes.items()))


def draw(
    path: Path, scenario: str, returns: np.ndarray, steps: np.ndarray, before: dict[str, int], after: dict[str, int]
) -> Path:
    """Draw the returns over the steps of the training and the outcomes before and after, and return the path."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.4), width_ratios=(2, 1), layout="constrained")
    left.plot(steps, returns, ".", color="0.75", markersize=3, label="episode")
    window = max(1, min(20, len(returns) // 4))
    mean = np.convolve(returns, np.ones(window) / window, mode="valid")
    left.plot(steps[window - 1 :], mean, color="tab:blue", label=f"mean of {window}")
    left.set(xlabel="actions", ylabel="return", title=f"PPO in dsrc/Meta-v0, {scenario}")
    left.legend(loc="lower right")
    bottom = np.zeros(2)
    for outcome in sorted({*before, *after}):
        counts = np.array([before.get(outcome, 0), after.get(outcome, 0)])
        right.bar(["untrained", "trained"], counts, bottom=bottom, label=outcome, color=COLORS.get(outcome))
        bottom += counts
    right.set(ylabel="episodes of other seeds", title="Outcomes", xlim=(-0.6, 3.2))
    right.legend(fontsize="small", loc="center right")
    figure.savefig(path, dpi=110)
    return path


COLORS = {"arrived": "tab:green", "crashed": "tab:red", "stuck": "tab:orange", "timeout": "0.7", "left": "tab:brown"}


if __name__ == "__main__":
    main()
