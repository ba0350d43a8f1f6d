"""Metrics of a training: `metrics.csv` and `curves.png` of its run folder, and the epochs that are validated."""

import csv
import io
import logging
import time
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import msgspec

from dsrc.evaluation.figures.curves import training_curves
from dsrc.tables.figure import write_figure
from dsrc.tables.files import csv_text
from dsrc.training.validation import is_metric
from sim.files import write_file
from sim.reading import parsing, read_text

LOG = logging.getLogger(__name__)


def _title(folder: Path) -> str:
    """Return a plot title: run folder, training data and validation data, each by the last two names of its path."""
    path = folder / "settings.json"
    folders = msgspec.json.decode(path.read_bytes()).get("folders", {}) if path.exists() else {}
    named = {"": folder, "trained on ": folders.get("data"), "validated on ": folders.get("validate")}
    return ", ".join(f"{what}{'/'.join(Path(place).parts[-2:])}" for what, place in named.items() if place)


class MetricsFile(pl.Callback):
    """Writer of a run folder's `metrics.csv` and `curves.png`.

    The table has one row per epoch and is rewritten each time, so that a resumed run continues it; it is plotted after
    each validation.
    """

    def __init__(self, folder: Path) -> None:
        self.path, self.picture = folder / "metrics.csv", folder / "curves.png"
        self._rows: list[dict[str, str]] = []
        self._started = 0.0

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Read the rows of an interrupted run, up to the epoch that starts now."""
        if self.path.exists():
            text = read_text(self.path, "table of metrics")
            with parsing(self.path, "table of metrics"):
                rows = csv.DictReader(io.StringIO(text))
                self._rows = [row for row in rows if int(row["epoch"]) < trainer.current_epoch]

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Start the clock."""
        self._started = time.monotonic()

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Add the epoch's row; runs after the validation of the epoch."""
        values: dict[str, Any] = {"epoch": trainer.current_epoch, "step": trainer.global_step}
        values["seconds"] = f"{time.monotonic() - self._started:.1f}"
        values["lr"] = f"{trainer.optimizers[0].param_groups[0]['lr']:.3e}"
        for name, value in sorted(trainer.callback_metrics.items()):
            if is_metric(name) and not _validated(trainer):
                continue
            if is_metric(name) or name.endswith("_epoch"):
                values[name.removesuffix("_epoch")] = f"{float(value):.5g}"
        if not trainer.is_global_zero:
            return
        self._rows.append({name: str(value) for name, value in values.items()})
        write_file(self.path, csv_text(self._rows))
        if _validated(trainer):
            write_figure(self.picture, training_curves(self._rows, _title(self.path.parent)))
        LOG.info("%s", ", ".join(f"{name} {value}" for name, value in self._rows[-1].items()))


class ValidationSchedule(pl.Callback):
    """Validation after every n-th epoch and after the last."""

    def __init__(self, every: int) -> None:
        self.every = max(every, 1)

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Schedule this epoch's validation."""
        trainer.check_val_every_n_epoch = 1 if _validated(trainer, self.every) else trainer.current_epoch + 2


def _validated(trainer: pl.Trainer, every: int | None = None) -> bool:
    if every is None:
        return bool(trainer.check_val_every_n_epoch == 1)
    last = trainer.max_epochs is not None and trainer.current_epoch + 1 >= trainer.max_epochs
    return last or (trainer.current_epoch + 1) % every == 0
