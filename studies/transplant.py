"""What fails, the vehicle or its place: recall of vehicles where they were, elsewhere there, and in other drives.

Drives are real or simulated, in any format that `dsrc` reads; see `dsrc.realism.transplant`.

Usage:
    python -m studies.transplant kitti/training data/hdl64 --checkpoint dsrc/checkpoints/small-plain.pt
    python -m studies.transplant kitti/training data/hdl64 --checkpoint detector.pt --height auto --frames 20
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dsrc.data.drives import list_drives, open_drive
from dsrc.data.sample import make_sample
from dsrc.detectors.open import open_detector
from dsrc.ops.detections import Detections
from dsrc.realism.figures import sweeps_of
from dsrc.realism.transplant import Scene, place_table, recall_by_place
from sensors.frame import Frame
from sensors.sweep import Sweep
from sim.errors import UserError


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drives", type=Path, nargs="+", help="drives, or folders of them: each is a source")
    parser.add_argument("--checkpoint", required=True, help="detector, see dsrc evaluate")
    parser.add_argument("--height", default="recorded", help="ground under the clouds, see dsrc detect")
    parser.add_argument("--frames", type=int, default=10, help="frames of each source, evenly spread")
    parser.add_argument("--seed", type=int, default=0, help="of the places")
    options = parser.parse_args()
    try:
        detector = open_detector(options.checkpoint, use={"height": options.height})
        sources = {str(root): scenes_of(root, options.frames) for root in options.drives}
    except UserError as error:
        parser.error(str(error))

    def detect(sweep: Sweep) -> Detections:
        cloud = np.column_stack([sweep.points, sweep.intensity])
        return detector.detect(make_sample(Frame.of_cloud(cloud), None, detector.settings.request))

    print(place_table(recall_by_place(sources, detect, options.seed)).text(120))


def scenes_of(root: Path, frames: int) -> Sequence[Scene]:
    """Return the sweeps of the first vehicle in frames of the drives below a folder, evenly spread, with all others."""
    listed = [(drive, i) for drive in map(open_drive, list_drives(root)) for i in range(len(drive))]
    chosen = np.linspace(0, len(listed) - 1, min(frames, len(listed))).round().astype(int)
    found = (sweeps_of(drive.read(i)) for drive, i in (listed[k] for k in chosen))
    return [scenes[0] for scenes in found if scenes]


if __name__ == "__main__":
    main()
