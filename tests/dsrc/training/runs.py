"""Trainings that a fast test can run, and what can happen to them."""

import lightning.pytorch as pl
from msgspec.structs import replace
from torch import nn

from dsrc.training.recipes import Augmentation, Recipe, debug


def tiny(**changes: object) -> Recipe:
    """The debug recipe, cut down to what a fast test can run."""
    recipe = debug()
    model = replace(recipe.model, pillar_channels=8, stage_channels=(8, 16, 16), shrink_channels=16, decoder_channels=8)
    model = replace(model, base_width=64, reconstruction_channels=(4, 2))
    return replace(recipe, model=model, **{"epochs": 4, "augmentation": Augmentation(), "validate_every": 2, **changes})


class Power(pl.Callback):
    """Fails at the start of an epoch."""

    def __init__(self, epoch: int) -> None:
        self.epoch = epoch

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if trainer.current_epoch == self.epoch:
            raise RuntimeError("power cut")


class StillNorms(pl.Callback):
    """Lets the batch norms use the statistics that they have, which do not depend on who is in a batch."""

    def on_train_batch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: object) -> None:
        for layer in pl_module.modules():
            if isinstance(layer, nn.modules.batchnorm._BatchNorm):
                layer.eval()
