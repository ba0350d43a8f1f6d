"""A drive in memory: sweeps of all agents at one instant, and who sees whom.

Usage:
    python examples/01_generate.py --scenario berlin --frames 5
"""

import argparse

import dsrc


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="four_way")
    parser.add_argument("--frames", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    # dsrc.generate(scenario, folder) writes the same frames as files.
    for frame in dsrc.simulate_frames(options.scenario, options.frames, options.seed):
        agents = ", ".join(f"{agent.kind} {agent.agent_id}: {len(agent.sweep)} points" for agent in frame.agents)
        seen = (frame.points_on > 0).any(axis=0).sum()
        print(f"{frame.time_s:.1f} s  {agents}; {len(frame.truth)} road users, {seen} of them with points")


if __name__ == "__main__":
    main()
