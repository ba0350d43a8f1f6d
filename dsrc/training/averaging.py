"""Which weights a training ends with: the last or the best validated, as they are or as a moving average of them."""

import math
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
from torch import Tensor

from dsrc.models.detector import Detector
from dsrc.models.storage.checkpoint import load_detector, save_detector
from dsrc.training.recipes import Recipe

SCORE = ("val/ap_bev_50", "val/ap_bev_70")
"""The sum of these says which weights are the best."""


class Selection(pl.Callback):
    """Averages the weights over the steps, keeps the best, and ends a training that no longer gets better.

    Its state is in every checkpoint, so that a resumed run decides as one that was not interrupted. A validation looks
    at the average, where there is one, and that is what is kept.

    Attributes:
        metrics: of the validation of the weights that the training ends with; empty before the first.
        epoch: of that validation.
    """

    def __init__(self, recipe: Recipe, best: Path) -> None:
        """Choose as a recipe says; the best weights go to the detector file `best`."""
        self.recipe, self.best = recipe, best
        self.metrics: dict[str, float] = {}
        self.epoch = -1
        self._highest = -math.inf
        self._waited = self._steps = 0
        self._average: dict[str, Tensor] = {}

    def apply(self, detector: Detector) -> None:
        """Give a trained detector the weights that the training ends with."""
        if self.recipe.keep == "best":
            detector.load_state_dict(load_detector(self.best).state_dict())
        elif self._average:
            detector.load_state_dict(self._average)

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Begin the average; end at once what had ended early before."""
        if self.recipe.ema and not self._average:
            self._average = {name: tensor.clone() for name, tensor in _detector(pl_module).state_dict().items()}
        self._average = {name: tensor.to(pl_module.device) for name, tensor in self._average.items()}
        self._stop(trainer)

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Move the average towards the weights of this step."""
        if not self._average:
            return
        # At first the steps are too few for the average that is asked for: it would hold the untrained weights.
        share = max(1 - self.recipe.ema, 9 / (10 + self._steps))
        self._steps += 1
        for name, tensor in _detector(pl_module).state_dict().items():
            if tensor.is_floating_point():
                self._average[name].lerp_(tensor, share)
            else:
                self._average[name].copy_(tensor)

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Let the validation see the average."""
        self._swap(pl_module)

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Compare with the best so far."""
        metrics = {k: float(v) for k, v in trainer.callback_metrics.items() if k.startswith("val/")}
        score = sum(metrics[name] for name in SCORE)
        better = score > self._highest
        self._highest, self._waited = max(score, self._highest), 0 if better else self._waited + 1
        if better or self.recipe.keep == "last":
            self.metrics, self.epoch = metrics, trainer.current_epoch
        if better and self.recipe.keep == "best" and trainer.is_global_zero:
            save_detector(self.best, _detector(pl_module), {"epoch": self.epoch, "metrics": metrics}, half=False)
        self._swap(pl_module)
        self._stop(trainer)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a resumed run needs to know."""
        names = ("metrics", "epoch", "_highest", "_waited", "_steps", "_average")
        return {name: getattr(self, name) for name in names}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over the state of a checkpoint."""
        for name, value in state_dict.items():
            setattr(self, name, value)

    def _stop(self, trainer: pl.Trainer) -> None:
        patience = self.recipe.patience
        if patience is not None and self._waited >= patience:
            trainer.should_stop = True

    def _swap(self, module: pl.LightningModule) -> None:
        """Exchange the weights and their average."""
        for name, average in self._average.items():
            tensor = _detector(module).state_dict()[name]
            own = tensor.clone()
            tensor.copy_(average)
            average.copy_(own)


def _detector(module: pl.LightningModule) -> Detector:
    detector = module.detector
    if not isinstance(detector, Detector):
        raise TypeError("Selection needs a DetectionModule")
    return detector
