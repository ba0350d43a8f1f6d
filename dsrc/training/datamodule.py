"""Data module of a training: frames, egos, augmentation and their order."""

import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import lightning.pytorch as pl
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from dsrc.data.drives import drive_hashes
from dsrc.data.sample import Sample
from dsrc.models.inputs.batch import Batch, collate
from dsrc.models.settings import ModelSettings
from dsrc.training.augmentation.augment import source_grid
from dsrc.training.recipes import Recipe
from dsrc.training.resident.batch import ResidentBatches, reason_for_host
from dsrc.training.resident.plan import Plan, PlanCollate, ResidentSet
from dsrc.training.resident.store import ResidentPoints, expected_bytes, free_bytes
from dsrc.training.samples import Draw, FrameRef, SampleStore, TrainingSet
from sim.streams import Stream, random_generator

LOG = logging.getLogger(__name__)
RESIDENT = ("cuda",)
"""Types of devices that keep the points of a training; on CPUs the host's compiled loops make the batches."""
_SHARE = 0.5
"""Share of a device's free memory that points may take; networks need the rest."""


class EpochSampler(Sampler[Draw]):
    """Frame order of an epoch, by the seed and the epoch alone, so that a resumed run repeats it."""

    def __init__(self, frames: int, seed: int, limit: int | None = None, device: int = 0, devices: int = 1) -> None:
        """Draw from `frames` frames, all or `limit` per epoch; each of the n devices takes every n-th."""
        self.frames, self.seed, self.epoch = frames, seed, 0
        self.device, self.devices = device, devices
        # Devices get equal numbers, so that none waits for another; the rest is drawn in another epoch.
        self.count = (frames if limit is None else min(limit, frames)) // devices

    def set_epoch(self, epoch: int) -> None:
        """Start this epoch; called by the trainer."""
        self.epoch = epoch

    def __iter__(self) -> Iterator[Draw]:
        order = random_generator(self.seed, Stream.TRAINING_ORDER, self.epoch).permutation(self.frames)
        order = order[: self.count * self.devices][self.device :: self.devices]
        return iter([(self.epoch, int(i)) for i in order])

    def __len__(self) -> int:
        return self.count


class ValidationSet(Dataset[Sample]):
    """Validation set of unaugmented samples, with the first vehicle of each drive as ego."""

    def __init__(self, store: SampleStore, frames: list[FrameRef]) -> None:
        self.store, self.frames = store, frames

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, number: int) -> Sample:
        return self.store.sample(self.frames[number], self.store.egos(self.frames[number])[0])


class Collate:
    """Collate function: a list of samples to a batch for a network of these settings, with a recipe's labels."""

    def __init__(self, settings: ModelSettings, recipe: Recipe, training: bool) -> None:
        self.settings, self.labels, self.training = settings, recipe.labels, training
        self.objects = recipe.distill.teacher_norms == "moving"
        self.both_views = recipe.consistency > 0

    def __call__(self, samples: list[Sample]) -> Batch:
        """Collate."""
        return collate(samples, self.settings, self.training, self.labels, self.objects, self.both_views)


class DetectionData(pl.LightningDataModule):
    """Data module: loaders of training and validation batches."""

    def __init__(
        self,
        recipe: Recipe,
        settings: ModelSettings,
        drives: list[Path],
        validation_drives: list[Path] | None,
        seed: int,
    ) -> None:
        """Open the drives.

        Args:
            validation_drives: validation drives; None holds out the end of each training drive.
        """
        super().__init__()
        self.recipe, self.settings = recipe, settings
        self._resident: ResidentBatches | None = None
        request = recipe.model.request
        exactly = replace(request, keep_ego_box=request.keep_ego_box or recipe.labels.ego_box)
        grid = source_grid(request.grid, recipe.augmentation)
        labels = recipe.labels
        whole = replace(
            request, grid=grid, keep_ego_box=labels.ego_box, truth_range_m=None, min_points=labels.min_points
        )
        if recipe.augmentation.alone == 1 and not settings.distils and settings.role == "student":
            whole = replace(whole, max_agents=1)  # the others' clouds would be dropped
        wide = SampleStore(drives, whole)
        frames, held_out = wide.frames, wide.frames
        if validation_drives is None and recipe.validation_share > 0:
            counts = [len(drive) for drive in wide.drives]
            # The end of each drive; its first frame is never held out.
            starts = [max(count - max(round(count * recipe.validation_share), 1), 1) for count in counts]
            held = {f for f in wide.frames if f.position >= starts[f.drive]}
            frames, held_out = [f for f in wide.frames if f not in held], [f for f in wide.frames if f in held]
        exact = SampleStore(validation_drives or drives, exactly)
        if validation_drives is not None:
            held_out = exact.frames
        self.training = TrainingSet(wide, frames, recipe, seed)
        self.validation = ValidationSet(exact, _evenly(held_out or exact.frames, recipe.validation_frames))
        # Else validation frames are training frames, and whoever shows their metrics says so.
        trained_on = set(drive_hashes(drives).values())
        of_others = validation_drives is not None and trained_on.isdisjoint(drive_hashes(validation_drives).values())
        self.validates_on_unseen = of_others or (validation_drives is None and len(frames) < len(wide.frames))

    def train_dataloader(self) -> DataLoader:
        """Return the training batches; an incomplete last batch is dropped unless it is the only one."""
        device, devices = self._place()
        sampler = EpochSampler(len(self.training), self.training.seed, self.recipe.epoch_frames, device, devices)
        batch_size = self.recipe.batch_size // devices
        points = None if self.trainer is None else self._on_device(self.trainer.strategy.root_device)
        dataset: TrainingSet | ResidentSet = self.training
        collate: Collate | PlanCollate = Collate(self.settings, self.recipe, training=True)
        if points is not None:
            self._resident = ResidentBatches(points, self.settings, self.recipe)
            dataset = ResidentSet(self.training, points.frames, points.points)
            collate = PlanCollate(self.settings, self.recipe, dataset)
        return DataLoader(
            dataset,
            batch_size=batch_size,
            sampler=sampler,
            collate_fn=collate,
            drop_last=len(sampler) >= batch_size,
            **_workers(self.recipe.workers),
        )

    def _on_device(self, device: torch.device) -> ResidentPoints | None:
        """Read the points of the training frames into a GPU's memory; None where they stay with the host."""
        if device.type not in RESIDENT:
            return None
        store, frames = self.training.store, self.training.frames
        if why := reason_for_host(self.recipe, self.settings):
            LOG.warning("points stay with the host: %s", why)
            return None
        needed, free = expected_bytes(store, frames), free_bytes(device)
        if needed > _SHARE * free:
            LOG.warning("points stay with the host: their %.1f GB beside %.1f GB free", needed / 1e9, free / 1e9)
            return None
        LOG.info("points of %d frames go to %s: about %.1f GB", len(frames), device, needed / 1e9)
        return ResidentPoints(store, frames, device, self.recipe.workers)

    def val_dataloader(self) -> DataLoader:
        """Return the validation batches of this device."""
        return self.validation_batches(*self._place())

    def validation_batches(self, device: int = 0, devices: int = 1) -> DataLoader:
        """Return the validation batches, one sample each; every n-th of n devices."""
        return DataLoader(
            self.validation,
            batch_size=1,
            sampler=range(device, len(self.validation), devices),
            collate_fn=Collate(self.settings, self.recipe, training=False),
            **_workers(min(self.recipe.workers, 1)),
        )

    def _place(self) -> tuple[int, int]:
        """Return the rank of this process and the number of processes."""
        return (0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size)

    def transfer_batch_to_device(self, batch: Batch | Plan, device: torch.device, dataloader_idx: int) -> Batch:
        """Move a batch's tensors, beside what the device computes; make a batch there of a plan."""
        moved = batch.to(device, non_blocking=True)
        if isinstance(moved, Batch):
            return moved
        if self._resident is None:
            raise ValueError("a plan is made with resident points")
        return self._resident(moved)


def _workers(count: int) -> dict:
    pinned = {"pin_memory": torch.cuda.is_available()}
    if count == 0:
        return {"num_workers": 0, **pinned}
    return {"num_workers": count, "persistent_workers": True, "prefetch_factor": 3, **pinned}


def _evenly(frames: list[FrameRef], limit: int) -> list[FrameRef]:
    if len(frames) <= limit:
        return frames
    return [frames[i] for i in np.linspace(0, len(frames) - 1, limit).round().astype(int)]
