"""An agent of reinforcement learning in the closed loop: a gymnasium environment, driven by a rule.

Usage:
    python examples/08_gymnasium.py --scenario four_way
"""

import argparse

import gymnasium
import numpy as np

import dsrc


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="ima_building")
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    dsrc.register_environments()
    env = gymnasium.make("dsrc/Meta-v0", scenario=options.scenario, perception="truth")
    observation, _ = env.reset(seed=options.seed)
    print(f"observations {env.observation_space}, actions {env.action_space}")
    total, ended = 0.0, False
    steps = 0
    while steps < options.steps and not ended:
        steps += 1
        others = observation[1:][observation[1:, 0] > 0.0]  # presence, x, y, vx, vy, cos, sin; x and y from the ego
        near = np.hypot(others[:, 1], others[:, 2]) < 0.15
        action = 0 if near.any() else 2  # SLOWER, FASTER
        observation, reward, terminated, truncated, info = env.step(action)
        total += float(reward)
        ended = terminated or truncated
    print(f"{steps} steps, return {total:.1f}, {info['outcome'] if ended else 'still driving'}")


if __name__ == "__main__":
    main()
