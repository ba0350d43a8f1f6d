"""A driver that no one here wrote: the car following of highway-env's `IDMVehicle` on what the ego tracks.

Usage:
    python examples/12_highway_env_driver.py
    cd examples && dsrc drive four_way --driver 12_highway_env_driver:Idm
"""

import argparse

import numpy as np
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle

import dsrc


def acceleration(speed_mps, limit_mps, length_m, route, boxes, velocity):
    """Return what an `IDMVehicle` does on a straight road as long as the (K, 2) route, m/s2.

    Whoever of (N, 7) boxes is within half a lane of the route is before it there, at the speed along the route that
    (N, 2) velocities have.
    """
    road = Road(RoadNetwork.straight_road_network(1, speed_limit=limit_mps), record_history=False)
    ego = IDMVehicle(road, [0.0, 0.0], speed=speed_mps, target_speed=limit_mps, enable_lane_change=False)
    ego.LENGTH = length_m
    step = np.diff(route, axis=0)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*step.T))])
    stations = np.arange(0.0, along[-1], 1.0)
    line = np.stack([np.interp(stations, along, route[:, axis]) for axis in (0, 1)], axis=1)
    ahead = None
    for box, moves in zip(boxes, velocity, strict=True):
        gap = np.hypot(*(line - box[:2]).T)
        at = int(gap.argmin()) if len(gap) > 1 else 0
        if 0 < at < len(line) - 1 and gap[at] < 2.0 and (ahead is None or stations[at] < ahead.position[0]):
            way = line[at + 1] - line[at - 1]
            ahead = IDMVehicle(road, [stations[at], 0.0], speed=max(float(moves @ way / np.hypot(*way)), 0.0))
            ahead.LENGTH = float(box[3])
    return float(ego.acceleration(ego, front_vehicle=ahead))


class Idm:
    """Driver of the loop; it follows, and sees neither red lights nor who crosses."""

    def reset(self, lanes: object) -> None:
        """Begin an episode: nothing to forget."""

    def decide(self, ego: dsrc.EgoState, tracks: dsrc.Tracks) -> dsrc.Decision:
        """Return what highway-env's vehicle does."""
        limit, length = ego.limits.speed_mps, float(ego.box.size[0, 0])
        found = acceleration(ego.speed_mps, limit, length, ego.route, tracks.boxes.array, tracks.velocity)
        return dsrc.Decision(found, "follow" if found < 0.0 else "free")


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenario", default="eebl_chain")
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    for wrong in dsrc.check_driver(Idm):
        print(f"highway-env's IDM: {wrong}")
    for name, driver in (("highway-env", Idm()), ("planning", None)):
        loop = dsrc.ClosedLoop(options.scenario, dsrc.open_perception("truth"), driver)
        for seed in range(options.seeds):
            outcome = loop.run(seed)
            brakes = dsrc.episode_metrics(loop.log(driver=name)).hardest_brake_mps2
            print(f"{name:11s} seed {seed}  {outcome.value:8s} hardest brake {brakes:.1f} m/s²")


if __name__ == "__main__":
    main()
