"""The data of a training: which frames, through whose eyes, augmented how, and in which order."""

from collections.abc import Iterator
from pathlib import Path

import lightning.pytorch as pl
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from dsrc.data.sample import Sample
from dsrc.models.inputs.batch import Batch, collate
from dsrc.models.settings import ModelSettings
from dsrc.training.augment import augment, source_grid
from dsrc.training.recipes import Recipe
from dsrc.training.samples import Corruption, FrameRef, SampleStore
from sensors.corruptions import SEVERITIES

Draw = tuple[int, int]
"""Epoch and number of a frame: together with the seed they fix a training sample completely."""


class EpochSampler(Sampler[Draw]):
    """Frames in an order that depends on the seed and the epoch alone, so that a resumed run repeats it."""

    def __init__(self, frames: int, seed: int, limit: int | None = None, device: int = 0, devices: int = 1) -> None:
        """Draw from so many frames, all of them or `limit` in each epoch; each of the devices takes every n-th."""
        self.frames, self.seed, self.epoch = frames, seed, 0
        self.device, self.devices = device, devices
        # All devices get equally many, so that none waits for another; what is left over has its turn another epoch.
        self.count = (frames if limit is None else min(limit, frames)) // devices

    def set_epoch(self, epoch: int) -> None:
        """Start this epoch; called by the trainer."""
        self.epoch = epoch

    def __iter__(self) -> Iterator[Draw]:
        order = np.random.default_rng([self.seed, 1, self.epoch]).permutation(self.frames)
        order = order[: self.count * self.devices][self.device :: self.devices]
        return iter([(self.epoch, int(i)) for i in order])

    def __len__(self) -> int:
        return self.count


class TrainingSet(Dataset[Sample]):
    """Augmented samples."""

    def __init__(self, store: SampleStore, frames: list[FrameRef], recipe: Recipe, seed: int) -> None:
        self.store, self.frames, self.recipe, self.seed = store, frames, recipe, seed

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, draw: Draw) -> Sample:
        epoch, number = draw
        rng = np.random.default_rng([self.seed, 2, epoch, number])
        egos = self.store.egos(self.frames[number])
        choice = int(rng.integers(len(egos)))
        ego = egos[choice if self.recipe.augmentation.random_ego else 0]
        sample = self.store.sample(self.frames[number], ego, self._corruption(epoch, number))
        return augment(sample, self.recipe.model.grid, self.recipe.augmentation, rng)

    def _corruption(self, epoch: int, number: int) -> Corruption | None:
        """Draw what befalls the sensors, if anything, beside all other draws."""
        choice = self.recipe.augmentation
        rng = np.random.default_rng([self.seed, 3, epoch, number])
        if rng.random() >= choice.corruption:
            return None
        kind = choice.kinds[int(rng.integers(len(choice.kinds)))]
        return kind, int(rng.choice(SEVERITIES)), int(rng.integers(2**31))


class ValidationSet(Dataset[Sample]):
    """Samples as they are, seen by the first vehicle of each drive."""

    def __init__(self, store: SampleStore, frames: list[FrameRef]) -> None:
        self.store, self.frames = store, frames

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, number: int) -> Sample:
        return self.store.sample(self.frames[number], self.store.egos(self.frames[number])[0])


class Collate:
    """Turns a list of samples into a batch for a network of these settings, with a recipe's labels."""

    def __init__(self, settings: ModelSettings, recipe: Recipe, training: bool) -> None:
        self.settings, self.labels, self.training = settings, recipe.labels, training
        self.objects = recipe.distill.teacher_norms == "moving"
        self.both_views = recipe.consistency > 0

    def __call__(self, samples: list[Sample]) -> Batch:
        """Collate."""
        return collate(samples, self.settings, self.training, self.labels, self.objects, self.both_views)


class DetectionData(pl.LightningDataModule):
    """Loaders of training and validation batches."""

    def __init__(
        self,
        recipe: Recipe,
        settings: ModelSettings,
        drives: list[Path],
        validation_drives: list[Path] | None,
        seed: int,
    ) -> None:
        """Look at the drives.

        Args:
            recipe: batch size, augmentation, hold-out.
            settings: of the network that is trained.
            drives: to train on.
            validation_drives: to validate on; None holds out the end of each training drive.
            seed: of order and augmentation.
        """
        super().__init__()
        self.recipe, self.settings = recipe, settings
        agents = (recipe.comm_range_m, recipe.model.max_agents, recipe.labels.ego_box)
        wide = SampleStore(drives, source_grid(recipe.model.grid, recipe.augmentation), *agents)
        frames, held_out = wide.frames, wide.frames
        if validation_drives is None and recipe.validation_share > 0:
            held = {f for f in wide.frames if _is_held_out(f, len(wide.drives[f.drive]), recipe.validation_share)}
            frames, held_out = [f for f in wide.frames if f not in held], [f for f in wide.frames if f in held]
        exact = SampleStore(validation_drives or drives, recipe.model.grid, *agents)
        if validation_drives is not None:
            held_out = exact.frames
        self.training = TrainingSet(wide, frames, recipe, seed)
        self.validation = ValidationSet(exact, _evenly(held_out or exact.frames, recipe.validation_frames))
        self.validates_on_unseen = validation_drives is not None or len(frames) < len(wide.frames)

    def train_dataloader(self) -> DataLoader:
        """Return the training batches; a last batch that is not full is dropped unless it is the only one."""
        device, devices = self._place()
        sampler = EpochSampler(len(self.training), self.training.seed, self.recipe.epoch_frames, device, devices)
        batch_size = self.recipe.batch_size // devices
        return DataLoader(
            self.training,
            batch_size=batch_size,
            sampler=sampler,
            collate_fn=Collate(self.settings, self.recipe, training=True),
            drop_last=len(sampler) >= batch_size,
            **_workers(self.recipe.workers),
        )

    def val_dataloader(self) -> DataLoader:
        """Return the validation batches of this device."""
        return self.validation_batches(*self._place())

    def validation_batches(self, device: int = 0, devices: int = 1) -> DataLoader:
        """Return the validation batches, one sample each; of several devices each has every n-th."""
        return DataLoader(
            self.validation,
            batch_size=1,
            sampler=range(device, len(self.validation), devices),
            collate_fn=Collate(self.settings, self.recipe, training=False),
            **_workers(min(self.recipe.workers, 1)),
        )

    def _place(self) -> tuple[int, int]:
        """Return the number of this process and how many train together."""
        return (0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size)

    def transfer_batch_to_device(self, batch: Batch, device: torch.device, dataloader_idx: int) -> Batch:
        """Move a batch's tensors."""
        return batch.to(device)


def _workers(count: int) -> dict:
    if count == 0:
        return {"num_workers": 0}
    return {"num_workers": count, "persistent_workers": True, "prefetch_factor": 3}


def _is_held_out(frame: FrameRef, frames: int, share: float) -> bool:
    """Return whether a frame lies in the last part of its drive; the first frame never does."""
    return frame.position >= max(frames - max(round(frames * share), 1), 1)


def _evenly(frames: list[FrameRef], limit: int) -> list[FrameRef]:
    if len(frames) <= limit:
        return frames
    return [frames[i] for i in np.linspace(0, len(frames) - 1, limit).round().astype(int)]
