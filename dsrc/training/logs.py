"""What a training writes beside its weights: one row per epoch, and lines for those who watch without a terminal."""

import csv
import logging
import time
from pathlib import Path
from typing import Any

import lightning.pytorch as pl

LOG = logging.getLogger(__name__)


class MetricsFile(pl.Callback):
    """Keeps `metrics.csv`: one row per epoch, rewritten whole each time, so that a resumed run continues it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._rows: list[dict[str, str]] = []
        self._started = 0.0

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Read what an earlier run has written, up to the epoch that starts now."""
        if self.path.exists():
            with self.path.open(newline="", encoding="utf-8") as file:
                self._rows = [row for row in csv.DictReader(file) if int(row["epoch"]) < trainer.current_epoch]

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Start the clock."""
        self._started = time.monotonic()

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Add the epoch's row; runs after the validation of the epoch."""
        values: dict[str, Any] = {"epoch": trainer.current_epoch, "step": trainer.global_step}
        values["seconds"] = f"{time.monotonic() - self._started:.1f}"
        values["lr"] = f"{trainer.optimizers[0].param_groups[0]['lr']:.3e}"
        for name, value in sorted(trainer.callback_metrics.items()):
            if name.startswith("val/") and not _validated(trainer):
                continue
            if name.startswith("val/") or name.endswith("_epoch"):
                values[name.removesuffix("_epoch")] = f"{float(value):.5g}"
        self._rows.append({name: str(value) for name, value in values.items()})
        self._write()
        LOG.info("%s", ", ".join(f"{name} {value}" for name, value in self._rows[-1].items()))

    def _write(self) -> None:
        names = list(dict.fromkeys(name for row in self._rows for name in row))
        temporary = self.path.with_name(self.path.name + ".tmp")
        with temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, names, restval="")
            writer.writeheader()
            writer.writerows(self._rows)
        temporary.replace(self.path)


class ValidateLast(pl.Callback):
    """Validates after every n-th epoch and after the last."""

    def __init__(self, every: int) -> None:
        self.every = max(every, 1)

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Decide whether this epoch ends with a validation."""
        trainer.check_val_every_n_epoch = 1 if _validated(trainer, self.every) else trainer.current_epoch + 2


def _validated(trainer: pl.Trainer, every: int | None = None) -> bool:
    if every is None:
        return bool(trainer.check_val_every_n_epoch == 1)
    last = trainer.max_epochs is not None and trainer.current_epoch + 1 >= trainer.max_epochs
    return last or (trainer.current_epoch + 1) % every == 0
