"""A driver of one's own in the closed loop: it brakes for whatever is near its way, and does not predict.

Usage:
    python examples/03_own_driver.py
    python examples/03_own_driver.py --scenario red_light_runner --seeds 5
"""

import argparse

import numpy as np

import dsrc


class Cautious:
    """Driver that keeps free what lies within its braking distance, ten metres to both sides."""

    def reset(self, lanes: object) -> None:
        """Begin an episode: nothing to forget, and no use of the lanes that others may take."""

    def decide(self, ego: dsrc.EgoState, tracks: dsrc.Tracks) -> dsrc.Decision:
        """Return full stop or free drive."""
        yaw = float(ego.box.yaw[0])
        offset = tracks.boxes.center[:, :2] - ego.box.center[0, :2]
        ahead, aside = offset @ [np.cos(yaw), np.sin(yaw)], offset @ [-np.sin(yaw), np.cos(yaw)]
        needed = 8.0 + ego.speed_mps**2 / (2.0 * 4.0)
        moving = np.linalg.norm(tracks.velocity, axis=1) > 0.5
        near = np.flatnonzero((ahead > 0.0) & (ahead < needed) & (np.abs(aside) < np.where(moving, 10.0, 2.0)))
        if len(near):
            return dsrc.Decision(-5.0, "yield", track=int(tracks.boxes.object_id[near[0]]))
        return dsrc.Decision(float(np.clip(ego.limits.speed_mps - ego.speed_mps, -2.0, 1.5)), "free")


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenario", default="ima_queue")
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    for name, driver in (("cautious", Cautious()), ("planning", None)):
        loop = dsrc.ClosedLoop(options.scenario, dsrc.open_perception("truth"), driver)
        for seed in range(options.seeds):
            outcome = loop.run(seed)
            found = dsrc.episode_metrics(loop.log(driver=name))
            print(f"{name:9s} seed {seed}  {outcome.value:8s} {found.mean_speed_mps:4.1f} m/s, ", end="")
            print(f"hardest brake {found.hardest_brake_mps2:.1f} m/s²")


if __name__ == "__main__":
    main()
