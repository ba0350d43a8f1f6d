"""What a network for pedestrians and two-wheelers finds of each, by class, in frames of drives.

Boxes are matched to true boxes whose centres lie within 1 m, one to one, the most confident box first. True boxes are
those that the network is judged on: with a point of an agent, wholly inside its range. A two-wheeler's box is along its
line within 30 degrees of the true heading or its opposite, as a third of random boxes are.

Usage:
    python -m studies.dsrc_paper.road_users --data data/dsrc-sim/test --checkpoint vulnerable.pt
    python -m studies.dsrc_paper.road_users --data data/dsrc-sim/test \
        --checkpoint alone=vulnerable-alone.pt vulnerable.pt --docs studies/dsrc_paper/report.md
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from dsrc.data.drives import open_drives
from dsrc.data.sample import inside_range, make_sample
from dsrc.evaluation.detect import frame_positions
from dsrc.evaluation.metrics.matching import match
from dsrc.models.detector import Detector
from dsrc.models.storage.checkpoint import load_detector
from sensors.frame import Frame
from sim.boxes import CLASSES
from sim.errors import UserError
from studies.look import put_table

NEXT_TO_M = 1.0
ALONG = np.cos(2 * np.radians(30.0))
"""Cosine of twice the largest angle between two lines that run alike."""
SECOND, NOBODY = "matched already", "nobody"
TWO_WHEELERS = ("bicycle", "motorcycle")
KINDS = ("pedestrian", *TWO_WHEELERS, SECOND, NOBODY)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="drives")
    parser.add_argument("--checkpoint", nargs="+", required=True, metavar="[NAME=]FILE", help="detector files")
    parser.add_argument("--frames", type=int, default=92, help="of all drives, evenly spread; default: %(default)s")
    parser.add_argument("--docs", type=Path, help="document whose table `road_users` is replaced")
    options = parser.parse_args()
    if options.frames < 1:
        parser.error(f"--frames: expected at least 1, found {options.frames}")
    torch.set_num_threads(1)
    try:
        drives = open_drives(options.data)
        detectors = {}
        for given in options.checkpoint:
            name, _, file = given.rpartition("=") if not Path(given).exists() else ("", "", given)
            detector = load_detector(Path(file)).eval()
            if detector.settings.users != "vulnerable":
                raise UserError(f"{file}: expected a network of users=vulnerable, found {detector.settings.users}")
            name = name or Path(file).stem
            if name in detectors:
                raise UserError(f"--checkpoint: expected names that differ, as NAME=FILE, found {name} twice")
            detectors[name] = detector
        found: dict[str, list[Pair]] = {name: [] for name in detectors}
        for drive, positions in zip(drives, frame_positions(drives, options.frames), strict=True):
            for position in positions:
                frame = drive.read(position)
                for name, detector in detectors.items():
                    found[name] += pairs(detector, frame)
        head = (
            "network",
            "road user",
            "true boxes",
            "found",
            "as a pedestrian",
            "as a two-wheeler",
            "median score",
            "along its line, %",
        )
        rows = [[name, *row] for name, pairs_of_it in found.items() for row in counted(pairs_of_it)]
        put_table(options.docs, "road_users", head, rows)
    except UserError as error:
        parser.error(str(error))


class Pair(NamedTuple):
    """True box and the box matched to it.

    Attributes:
        true: class, or `SECOND` or `NOBODY` of a box that has no true one.
        called: class that it was found as, "" if missed.
        score: of the box.
        along: whether the box lies along the true line.
    """

    true: str
    called: str = ""
    score: float = 0.0
    along: bool = False


def pairs(detector: Detector, frame: Frame) -> Iterator[Pair]:
    """Yield every true box of a frame with the box matched to it, and the boxes that have none."""
    sample = make_sample(frame, None, detector.settings.request)
    found = detector.detect(sample)
    found = found[inside_range(found.boxes, detector.settings.grid)]
    away = np.linalg.norm(found.boxes.center[:, None, :2] - sample.boxes.center[None, :, :2], axis=2)
    of = match(-away, found.score, -NEXT_TO_M)
    for row, truth in zip(of.order, of.truth, strict=True):
        near = (away[row] <= NEXT_TO_M).any()
        kind = CLASSES[sample.boxes.label[truth]] if truth >= 0 else SECOND if near else NOBODY
        turned = found.boxes.yaw[row] - sample.boxes.yaw[truth] if truth >= 0 else np.pi / 2
        yield Pair(kind, CLASSES[found.boxes.label[row]], float(found.score[row]), np.cos(2 * turned) >= ALONG)
    for truth in np.setdiff1d(np.arange(len(sample.boxes)), of.truth):
        yield Pair(CLASSES[sample.boxes.label[truth]])


def counted(found: Sequence[Pair]) -> Iterator[list[str]]:
    """Yield a row of the table for each class and for the boxes without a match."""
    for kind in KINDS:
        of_it = [pair for pair in found if pair.true == kind]
        boxes = [pair for pair in of_it if pair.called]
        riding = [pair for pair in boxes if pair.called != "pedestrian"]
        middle = f"{np.median([pair.score for pair in boxes]):.2f}" if boxes else "-"
        lined = kind in TWO_WHEELERS and riding
        along = f"{100 * np.mean([pair.along for pair in riding]):.0f}" if lined else "-"
        true = "-" if kind in (SECOND, NOBODY) else f"{len(of_it)}"
        yield [kind, true, f"{len(boxes)}", f"{len(boxes) - len(riding)}", f"{len(riding)}", middle, along]


if __name__ == "__main__":
    main()
