"""What feature maps hold: fronts and backs of vehicles, and cells that are far surer of no vehicle than others.

Of networks with a head for directions: how often the head is right at the anchors of true boxes, and how often
classifiers are that are fitted to the fused features there. Two thirds of the training frames, augmented as in
training, fit the classifiers; the last third and the validation frames try them. Of every network: cells of test frames
whose logits are below -20, and what the least of them is without the points within 12 m.

Usage:
    python -m studies.dsrc_paper.feature_maps --data data/dsrc-sim --checkpoint detector.pt
    python -m studies.dsrc_paper.feature_maps --data data/dsrc-sim --checkpoint DSRC=dsrc.pt plain.pt --docs report.md
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional

from dsrc.data.drives import Drive, open_drives
from dsrc.data.sample import Sample, make_sample
from dsrc.evaluation.detect import frame_positions
from dsrc.models.detector import Detector, NetworkOutput
from dsrc.models.inputs.batch import Batch, collate
from dsrc.models.storage.checkpoint import load_detector
from dsrc.training.augmentation.augment import augment, source_grid
from dsrc.training.recipes import Augmentation
from dsrc.training.samples import SampleStore
from sim.errors import UserError
from studies.look import put_table

SURE, WITHIN_M = -20.0, 12.0
CLASSIFIERS = {"linear classifier of its features": 0, "classifier with a hidden layer of 128": 128}
"""Hidden units, 0 for none."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="data set: folders of drives train, validation, test")
    parser.add_argument("--checkpoint", nargs="+", required=True, metavar="[NAME=]FILE", help="students")
    parser.add_argument("--frames", type=int, default=300, help="of the training drives; default: %(default)s")
    parser.add_argument("--tested", type=int, default=92, help="of the other drives; default: %(default)s")
    parser.add_argument("--docs", type=Path, help="document whose tables `feature_maps` are replaced")
    options = parser.parse_args()
    for name in ("frames", "tested"):
        if (count := getattr(options, name)) < 3:
            parser.error(f"--{name}: expected at least 3, found {count}")
    torch.set_num_threads(1)
    torch.manual_seed(0)
    try:
        detectors = dict(map(named, options.checkpoint))
        rows = [
            [name, *row]
            for name, detector in detectors.items()
            if detector.direction_head is not None
            for row in directions(detector, options.data, options.frames, options.tested)
        ]
        head = ["network", "direction by", "right at anchors of training frames, %", "of validation frames, %"]
        put_table(options.docs, "feature_maps/directions", head, rows)
        drives = open_drives(options.data / "test")
        rows = [[name, *surest(detector, drives, options.tested)] for name, detector in detectors.items()]
        head = ["network", "test frames", "with cells below -20", "of all cells, %", "true boxes", "in such cells"]
        head += ["least logit", "without the points within 12 m"]
        put_table(options.docs, "feature_maps/sure", head, rows)
    except UserError as error:
        parser.error(str(error))


def named(given: str) -> tuple[str, Detector]:
    """Return the name and the detector of NAME=FILE or FILE."""
    name, _, file = given.rpartition("=") if not Path(given).exists() else ("", "", given)
    detector = load_detector(Path(file)).eval()
    if detector.settings.role != "student":
        raise UserError(f"{file}: expected a student, found a teacher")
    return name or Path(file).stem, detector


@torch.inference_mode()
def output_of(detector: Detector, batch: Batch) -> NetworkOutput:
    """Return the output of a student."""
    assert batch.student is not None
    return detector(batch.student, batch.layout).float()


@dataclass(frozen=True, slots=True, eq=False)
class Anchors:
    """N anchors of true boxes.

    Attributes:
        feature: (N, C) fused features, then 1 for the anchor across.
        against: (N,) 1 where the true box heads against the anchor, else 0.
        head: (N,) what the head says, as `against`.
    """

    feature: NDArray[np.float32]
    against: NDArray[np.int64]
    head: NDArray[np.int64]


def anchors_of(detector: Detector, samples: Iterator[Sample]) -> Anchors:
    """Return the anchors of the true boxes of samples."""
    parts = []
    for sample in samples:
        batch = collate([sample], detector.settings, training=True)
        assert batch.targets is not None
        output = output_of(detector, batch)
        assert output.direction is not None
        _, row, column, anchor = batch.targets.positive.nonzero(as_tuple=True)
        feature = torch.cat([output.fused[0, :, row, column].T, anchor[:, None]], 1)
        yaw = batch.targets.regression[0, :, :, 6::7][row, column, anchor]
        parts.append((feature.numpy(), (yaw.cos() < 0).numpy(), (output.direction[0, anchor, row, column] > 0).numpy()))
    feature, against, head = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Anchors(feature, against.astype(int), head.astype(int))


def directions(detector: Detector, data: Path, frames: int, tested: int) -> Iterator[list[str]]:
    """Yield how often directions are right: by the head, by classifiers, and by guessing the anchor's."""
    settings = detector.settings
    drives = [drive.drive for drive in open_drives(data / "train")]
    grid = source_grid(settings.grid, Augmentation())
    store = SampleStore(drives, replace(settings.request, grid=grid, keep_ego_box=False, truth_range_m=None))
    rng = np.random.default_rng(0)
    chosen = [store.frames[i] for i in rng.permutation(len(store.frames))[:frames]]
    egos = [int(rng.choice(store.egos(frame))) for frame in chosen]
    moved = [
        augment(store.sample(*pair), settings.grid, Augmentation(), rng) for pair in zip(chosen, egos, strict=True)
    ]
    cut = len(moved) * 2 // 3
    fitted, held_out = (anchors_of(detector, iter(part)) for part in (moved[:cut], moved[cut:]))
    unseen = anchors_of(detector, samples_of(detector, open_drives(data / "validation"), tested))
    others = held_out, unseen
    yield ["none: always the anchor's", *(right(np.zeros_like(part.against), part) for part in others)]
    yield ["its head", *(right(part.head, part) for part in others)]
    for name, hidden in CLASSIFIERS.items():
        mean, spread = fitted.feature.mean(0), fitted.feature.std(0) + 1e-3
        scaled = [torch.tensor((part.feature - mean) / spread) for part in (fitted, *others)]
        classifier = fit(scaled[0].float(), torch.tensor(fitted.against).float(), hidden)
        said = [(classifier(part.float())[:, 0] > 0).long().numpy() for part in scaled[1:]]
        yield [name, *(right(one, part) for one, part in zip(said, others, strict=True))]


def right(said: NDArray[np.int64], anchors: Anchors) -> str:
    """Return the share of right directions, %."""
    return f"{100.0 * np.mean(said == anchors.against):.0f}"


def fit(feature: torch.Tensor, against: torch.Tensor, hidden: int, epochs: int = 60) -> nn.Module:
    """Fit a classifier to (N, C) features."""
    sizes = [feature.shape[1], *([hidden] if hidden else []), 1]
    layers = [layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), nn.ReLU())]
    classifier = nn.Sequential(*layers[:-1])
    optimiser = torch.optim.AdamW(classifier.parameters(), 2e-3)
    for _ in range(epochs):
        for rows in torch.randperm(len(feature)).split(512):
            optimiser.zero_grad()
            functional.binary_cross_entropy_with_logits(classifier(feature[rows])[:, 0], against[rows]).backward()
            optimiser.step()
    return classifier


def samples_of(detector: Detector, drives: Sequence[Drive], count: int) -> Iterator[Sample]:
    """Yield samples of drives, evenly spread."""
    for drive, positions in zip(drives, frame_positions(drives, count), strict=True):
        for position in positions:
            yield make_sample(drive.read(position), None, detector.settings.request)


def surest(detector: Detector, drives: Sequence[Drive], count: int) -> list[str]:
    """Return how many cells are below `SURE`, how many true boxes are in them, and what makes the least of them."""
    grid, frames, cells, share, boxes, inside = detector.settings.grid, 0, 0, 0.0, 0, 0
    least, without = np.inf, np.nan
    for sample in samples_of(detector, drives, count):
        logits = logits_of(detector, sample)
        below = logits < SURE
        cell_m = (grid.range_m[3] - grid.range_m[0]) / logits.shape[1]
        place = ((sample.boxes.center[:, :2] - grid.range_m[:2]) / cell_m).astype(int)
        column, row = (np.clip(place[:, i], 0, logits.shape[1 - i] - 1) for i in (0, 1))
        frames, cells, share = frames + 1, cells + below.any(), share + below.mean()
        boxes, inside = boxes + len(place), inside + below[row, column].sum()
        if logits.min() < least:
            at = np.unravel_index(logits.argmin(), logits.shape)
            middle = (np.array([at[1], at[0]]) + 0.5) * cell_m + grid.range_m[:2]
            clouds = (cloud[np.hypot(*(cloud[:, :2] - middle).T) > WITHIN_M] for cloud in sample.clouds)
            least = logits.min()
            without = logits_of(detector, replace(sample, clouds=tuple(clouds)))[at]
    counts = [frames, cells, f"{100.0 * share / frames:.2f}", boxes, inside]
    return [*map(str, counts), f"{least:.0f}", f"{without:.0f}"]


def logits_of(detector: Detector, sample: Sample) -> NDArray[np.float32]:
    """Return (h, w) logits of a vehicle, of the surer of a cell's anchors."""
    return output_of(detector, collate([sample], detector.settings, training=False)).cls[0].amax(0).numpy()


if __name__ == "__main__":
    main()
