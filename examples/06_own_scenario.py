"""A scenario of your own: junctions on a grid, made from a few lines of TOML.

Usage:
    python examples/06_own_scenario.py
"""

import argparse
import tempfile
from pathlib import Path

import dsrc

SCENARIO = """
name = "my_junction"
description = "One junction of a made grid."
warmup_s = 30.0
duration_s = 20.0

[network.generate]
grid = true
"grid.number" = 2
"grid.length" = 100.0
"grid.attach-length" = 100.0

[demand]
vehicles_per_hour = VEHICLES
focus_m = [100.0, 100.0]

[agents]
vehicles = 2
lidar = "debug-16"
within_m = 80.0
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vehicles-per-hour", type=float, default=1500.0)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scenario.toml"
        path.write_text(SCENARIO.replace("VEHICLES", str(options.vehicles_per_hour)))
        scenario = dsrc.register_scenario(path)  # from now on a name like those that ship
        dsrc.check_scenario(scenario.name, options.seed)
        for frame in dsrc.simulate_frames(scenario.name, 3, options.seed, interval_s=1.0):
            print(f"{scenario.name} at {frame.time_s:.1f} s: {len(frame.agents)} agents, {len(frame.truth)} road users")


if __name__ == "__main__":
    main()
