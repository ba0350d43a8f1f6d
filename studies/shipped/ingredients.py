"""What each ingredient of the detectors for real roads gives: short trainings, each without one of them.

All start from the plain network of single vehicles that has seen uneven worlds without parked rows (`starts/`), and
differ in their drives or in one augmentation. The data, for each NAME of `ingredients/`: `dsrc dataset build
studies/shipped/ingredients/NAME.toml --out data/ingredients/NAME`.

Usage:
    python -m studies.shipped.ingredients --data data/ingredients --out runs/ingredients
"""

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

from dsrc.training.recipes import RECIPES, of_method, override
from dsrc.training.train import train
from studies.shipped.train import BATCH, HALF, SETTINGS, STARTS

START = "unparked-plain-alone"
FRAMES = 200
"""Frames of an epoch."""


@dataclass(frozen=True)
class Run:
    """Training without one ingredient.

    Attributes:
        name: of its folder.
        drives: name of its data set.
        changes: of the recipe.
        sensor: LiDAR of its drives; "" for all.
    """

    name: str
    drives: str = "parked"
    changes: tuple[str, ...] = ()
    sensor: str = ""


RUNS = (
    Run("everything"),
    Run("no_parked_rows", "unparked"),
    Run("level_worlds", "level"),
    Run("one_sensor", sensor="hdl-64e-kitti"),
    Run("no_crowding", changes=("augmentation.crowding=0",)),
    Run("no_sizes", changes=("augmentation.sizes=0",)),
    Run("no_intensity", changes=("augmentation.intensity=0",)),
)


def drives_of(run: Run, data: Path, out: Path) -> Path:
    """Return the folder of a run's drives: those of one sensor are linked from it."""
    drives = data / run.drives / "train"
    if not run.sensor:
        return drives
    chosen = out / "drives" / run.sensor
    chosen.mkdir(parents=True, exist_ok=True)
    for drive in drives.glob(f"*_{run.sensor}"):
        link = chosen / drive.name
        if not link.exists():
            link.symlink_to(drive.resolve(), target_is_directory=True)
    return chosen


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("data/ingredients"), help="folder of the three data sets")
    parser.add_argument("--out", type=Path, default=Path("runs/ingredients"), help="folder of the runs")
    parser.add_argument("--steps", type=int, default=250, help=f"of {BATCH} frames, each training")
    parser.add_argument("--only", nargs="+", choices=[run.name for run in RUNS], help="runs; default: all")
    options = parser.parse_args()
    size = (f"epochs={max(BATCH * options.steps // FRAMES, 1)}", f"epoch_frames={FRAMES}", "learning_rate=5e-4")
    recipe = override(
        of_method(RECIPES["small"](), "no-collaboration"), (*SETTINGS, *size, HALF, "augmentation.alone=1", "workers=0")
    )
    for run in RUNS:
        if options.only and run.name not in options.only:
            continue
        begun = time.monotonic()
        train(
            override(recipe, run.changes),
            drives_of(run, options.data, options.out),
            options.out / run.name,
            "plain",
            init=STARTS / f"{START}.pt",
        )
        print(f"{run.name}: {time.monotonic() - begun:.0f} s", flush=True)


if __name__ == "__main__":
    main()
