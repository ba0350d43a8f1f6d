"""Samples of drives by frame and ego, and those of a training.

Nothing is cached: reading a frame of four agents (10 ms) and moving it into the ego's frame (25 ms) costs about as much
as reading a prepared sample, and prepared samples of all egos would fill gigabytes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from torch.utils.data import Dataset

from dsrc.data.drives import labelled_frames, open_drive
from dsrc.data.level import level
from dsrc.data.sample import Sample, SampleRequest, make_sample
from dsrc.training.augmentation.augment import augment, source_grid
from dsrc.training.recipes import Recipe
from sensors.corruptions import SEVERITIES, corrupt_frame
from sensors.frame import Frame
from sim.errors import DataError, complaint
from sim.streams import Stream, random_generator

Draw = tuple[int, int]
"""Epoch and number of a frame, which with the seed determine a training sample."""

CorruptionDraw = tuple[str, int, int]
"""Kind, severity and seed of a corruption."""


@dataclass(frozen=True, slots=True)
class FrameRef:
    """Reference to a frame: the number of its drive in the store and its position there."""

    drive: int
    position: int


class SampleStore:
    """Samples of drives, made on access.

    Attributes:
        drives: their readers.
        frames: all frames, drive by drive.
    """

    def __init__(self, drives: Sequence[Path], request: SampleRequest) -> None:
        """Open the drives.

        Raises:
            DataError: the drives have no frames.
        """
        self.drives = [open_drive(drive) for drive in drives]
        self.request = request
        self.frames = [FrameRef(d, i) for d, reader in enumerate(self.drives) for i in labelled_frames(reader)]
        if not self.frames:
            raise DataError(complaint(drives[0] if drives else "data", "frames with ground truth", "at least one", 0))

    def egos(self, ref: FrameRef) -> list[int]:
        """Return the possible egos: vehicles (or all agents without a vehicle), in folder order."""
        agents = self.drives[ref.drive].agents
        return [agent for agent in agents if agent >= 0] or list(agents)

    def sample(self, ref: FrameRef, ego_id: int, corruption: CorruptionDraw | None = None) -> Sample:
        """Make the sample of one frame and ego, with corrupted clouds in addition if `corruption` is given.

        Raises:
            DataError: the sweeps lack what the corruption needs.
        """
        frame = self.drives[ref.drive].read(ref.position)
        sample = self.sample_of(frame, ref, ego_id)
        if corruption is None:
            return sample
        kind, severity, seed = corruption
        corrupted = corrupt_frame(frame, kind, severity, seed, ego_id=ego_id)
        return replace(sample, corrupted=self.sample_of(corrupted, ref, ego_id).clouds)

    def sample_of(self, frame: Frame, ref: FrameRef, ego_id: int) -> Sample:
        """Make the sample of an ego in a frame that was read, or changed since."""
        reader = self.drives[ref.drive]
        key = f"{reader.drive.name}/{ego_id}/{reader.frames[ref.position]:06d}"
        return make_sample(frame, ego_id, self.request, key=key)


class TrainingSet(Dataset[Sample]):
    """Training set of augmented samples."""

    def __init__(self, store: SampleStore, frames: list[FrameRef], recipe: Recipe, seed: int) -> None:
        self.store, self.frames, self.recipe, self.seed = store, frames, recipe, seed

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, draw: Draw) -> Sample:
        ref, ego, rng = self.ego_of(draw)
        sample = self.store.sample(ref, ego, self._corruption(*draw))
        model, augmentation = self.recipe.model, self.recipe.augmentation
        if model.height == "ground":
            # Before it is lifted, so that lifts are errors of the ground.
            sample = level(sample, source_grid(model.grid, augmentation))
        return augment(sample, model.grid, augmentation, rng)

    def ego_of(self, draw: Draw) -> tuple[FrameRef, int, np.random.Generator]:
        """Return the frame and the ego of a draw, and the generator of its augmentation."""
        epoch, number = draw
        rng = random_generator(self.seed, Stream.TRAINING_AUGMENTATION, epoch, number)
        egos = self.store.egos(self.frames[number])
        choice = int(rng.integers(len(egos)))
        return self.frames[number], egos[choice if self.recipe.augmentation.random_ego else 0], rng

    def _corruption(self, epoch: int, number: int) -> CorruptionDraw | None:
        """Draw the corruption of the sensors, independently of all other draws."""
        choice = self.recipe.augmentation
        rng = random_generator(self.seed, Stream.TRAINING_CORRUPTION, epoch, number)
        if rng.random() >= choice.corruption:
            return None
        kind = choice.kinds[int(rng.integers(len(choice.kinds)))]
        return kind, int(rng.choice(SEVERITIES)), int(rng.integers(2**31))
