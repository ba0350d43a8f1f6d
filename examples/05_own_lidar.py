"""A LiDAR of your own in a room of your own: its sweep, and how far off the walls its points lie.

Usage:
    python examples/05_own_lidar.py --rings 64
"""

import argparse

import numpy as np
import trimesh

import dsrc


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rings", type=int, default=32)
    options = parser.parse_args()
    elevation_deg = tuple(np.linspace(15.0, -25.0, options.rings))
    lidar = dsrc.LidarSpec(name="mine", elevation_deg=elevation_deg, columns=1024, range_noise_m=0.01)
    dsrc.check_sensor(lidar)
    hall = trimesh.creation.box((40.0, 24.0, 8.0))
    hall.face_attributes["material"] = np.full(len(hall.faces), dsrc.material_index("plaster"))
    # The sensor drives 1 m during the sweep of 0.1 s.
    start, end = dsrc.pose_matrix([-0.5, 0.0, 0.0]), dsrc.pose_matrix([0.5, 0.0, 0.0])
    sweep = dsrc.scan(dsrc.RayScene(hall), lidar, start, end, time_s=0.0, rng=np.random.default_rng(0))
    off_m = np.abs(np.array([20.0, 12.0, 4.0]) - np.abs(sweep.world_points)).min(axis=1)
    print(f"{len(sweep)} points of {lidar.rings} rings, {1000 * np.median(off_m):.0f} mm off the walls (median)")
    raw = dsrc.deskew(sweep, "raw")
    print(f"without motion compensation they move by up to {np.abs(raw.points - sweep.points).max():.2f} m")


if __name__ == "__main__":
    main()
