"""A corruption of your own: a smear on the window takes the points of a sector.

Usage:
    python examples/04_own_corruption.py
"""

import argparse
from typing import Any

import numpy as np

import dsrc

WIDTH_DEG = (5.0, 10.0, 20.0, 40.0, 80.0)
"""Width of the smear at severities 1 to 5."""


def smear(sweep: dsrc.Sweep, width_deg: float, rng: np.random.Generator) -> dsrc.Sweep:
    """Return a sweep without the points of a sector in a random direction."""
    azimuth = np.degrees(np.arctan2(sweep.points[:, 1], sweep.points[:, 0]))
    off = (azimuth - rng.uniform(-180.0, 180.0) + 180.0) % 360.0 - 180.0
    kept: Any = np.abs(off) > width_deg / 2.0
    return sweep[kept]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="four_way")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    dsrc.register_corruption("smear", WIDTH_DEG, smear)
    dsrc.check_corruption("smear")
    frame = next(dsrc.simulate_frames(options.scenario, 1, options.seed))
    for severity in range(1, 6):
        smeared = dsrc.corrupt_frame(frame, "smear", severity, seed=0)
        left = [
            len(after.sweep) / len(before.sweep) for before, after in zip(frame.agents, smeared.agents, strict=True)
        ]
        print(f"severity {severity}: {', '.join(f'{100 * share:.0f} %' for share in left)} of the points left")


if __name__ == "__main__":
    main()
