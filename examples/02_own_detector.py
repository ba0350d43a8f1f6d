"""A detector of one's own in the closed loop: clusters of points, in twenty lines.

Usage:
    python examples/02_own_detector.py
    cd examples && dsrc evaluate ../data/test --checkpoint 02_own_detector:Clusters --out ../results
    python examples/02_own_detector.py --scenario lta_truck --seed 2
"""

import argparse
from pathlib import Path

import numpy as np
from scipy import ndimage

import dsrc


class Clusters:
    """Detector that takes every group of points of a car's size above the road for a car."""

    def detect(self, sample: dsrc.Sample) -> dsrc.Detections:
        """Return a box for every such group, in the ego LiDAR's frame."""
        points = np.concatenate(sample.clouds)[:, :3]  # of the ego and its helpers, in the ego LiDAR's frame
        points = points[(points[:, 2] > -1.3) & (points[:, 2] < 0.3)]
        cells = np.floor(points[:, :2] / 0.5).astype(int)
        low = cells.min(axis=0, initial=0)
        image = np.zeros(cells.max(axis=0, initial=0) - low + 1, bool)
        image[tuple((cells - low).T)] = True
        number, count = ndimage.label(image, np.ones((3, 3)))
        cluster = number[tuple((cells - low).T)]
        boxes = []
        for one in range(1, count + 1):
            group = points[cluster == one, :2]
            if len(group) < 10:
                continue
            across, along = np.linalg.eigh(np.cov(group.T) + 1e-6 * np.eye(2))[1].T
            length, width = np.ptp(group @ along), np.ptp(group @ across)
            if 1.0 < length < 6.0 and width < 2.6:
                x, y = group.mean(axis=0)
                boxes.append([x, y, -1.0, 4.5, 1.9, 1.6, np.arctan2(along[1], along[0])])
        return dsrc.Detections(dsrc.Boxes.from_array(boxes), np.full(len(boxes), 0.6, np.float32))


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenario", default="ima_building:no_occluder")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--duration-s", type=float, default=20.0)
    options = parser.parse_args()
    settings = dsrc.LoopSettings(detect_every_s=0.2, duration_s=options.duration_s)
    for name in (f"{Path(__file__).stem}:Clusters", "truth"):
        loop = dsrc.ClosedLoop(options.scenario, dsrc.open_perception(name, interval_s=0.2), settings=settings)
        outcome = loop.run(options.seed)
        found = dsrc.episode_metrics(loop.log(perception=name))
        print(f"{name:25s} {outcome.value}, driving score {found.driving_score_2_1:.2f}, {found.progress_m:.0f} m")


if __name__ == "__main__":
    main()
