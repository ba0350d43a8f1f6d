"""Weight selection: the last or the best validated weights of a training, or their moving average."""

import math
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
from torch import Tensor

from dsrc.models.detector import Detector
from dsrc.models.storage.checkpoint import load_detector, save_detector
from dsrc.training.recipes import Recipe
from dsrc.training.validation import is_metric

SCORE = ("ap_bev_50", "ap_bev_70")
"""Metrics whose sum ranks the weights; only those of unseen frames decide anything."""


class WeightSelection(pl.Callback):
    """Weight selection: moving average over the steps, best validated weights, early stopping.

    Its state is in every checkpoint, so that a resumed run decides as an uninterrupted one. With a moving average,
    validations and the best weights are of the average.

    Attributes:
        metrics: validation metrics of the selected weights; empty before the first validation.
        epoch: epoch of that validation.
    """

    def __init__(self, recipe: Recipe, best: Path) -> None:
        """Select by a recipe's rules; the best weights are stored in the detector file `best`."""
        self.recipe, self.best = recipe, best
        self.metrics: dict[str, float] = {}
        self.epoch = -1
        self._highest = -math.inf
        self._waited = self._steps = 0
        self._average: dict[str, Tensor] = {}

    @property
    def state_key(self) -> str:
        """Key of its state in checkpoints, which outlives names of the class."""
        return "Selection"

    def apply(self, detector: Detector) -> None:
        """Load the selected weights into a trained detector."""
        if self.recipe.keep == "best":
            detector.load_state_dict(load_detector(self.best).state_dict())
        elif self._average:
            detector.load_state_dict(self._average)

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Start the average; stop a resumed run that had stopped early."""
        if self.recipe.ema and not self._average:
            self._average = {name: tensor.clone() for name, tensor in _detector(pl_module).state_dict().items()}
        self._average = {name: tensor.to(pl_module.device) for name, tensor in self._average.items()}
        self._stop(trainer)

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        """Move the average towards the weights of this step."""
        if not self._average:
            return
        # A shorter average at first: the full one would hold the untrained weights.
        share = max(1 - self.recipe.ema, 9 / (10 + self._steps))
        self._steps += 1
        for name, tensor in _detector(pl_module).state_dict().items():
            if tensor.is_floating_point():
                self._average[name].lerp_(tensor, share)
            else:
                self._average[name].copy_(tensor)

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Swap in the average for the validation."""
        self._swap(pl_module)

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Keep the weights if they are the best so far, and swap the average out."""
        metrics = {name: float(value) for name, value in trainer.callback_metrics.items() if is_metric(name)}
        score = sum(value for name, value in metrics.items() if name.rpartition("/")[2] in SCORE)
        better = score > self._highest
        self._highest, self._waited = max(score, self._highest), 0 if better else self._waited + 1
        if better or self.recipe.keep == "last":
            self.metrics, self.epoch = metrics, trainer.current_epoch
        if better and self.recipe.keep == "best" and trainer.is_global_zero:
            save_detector(self.best, _detector(pl_module), {"epoch": self.epoch, "metrics": metrics}, half=False)
        self._swap(pl_module)
        self._stop(trainer)

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint."""
        names = ("metrics", "epoch", "_highest", "_waited", "_steps", "_average")
        return {name: getattr(self, name) for name in names}

    def load_state_dict(self, state_dict: dict[str, object]) -> None:
        """Restore the state of a checkpoint."""
        for name, value in state_dict.items():
            setattr(self, name, value)

    def _stop(self, trainer: pl.Trainer) -> None:
        patience = self.recipe.patience
        if patience is not None and self._waited >= patience:
            trainer.should_stop = True

    def _swap(self, module: pl.LightningModule) -> None:
        for name, average in self._average.items():
            tensor = _detector(module).state_dict()[name]
            own = tensor.clone()
            tensor.copy_(average)
            average.copy_(own)


def _detector(module: pl.LightningModule) -> Detector:
    detector = module.detector
    if not isinstance(detector, Detector):
        raise TypeError("WeightSelection needs a DetectionModule")
    return detector
