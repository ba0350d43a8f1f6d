"""What each ingredient of the detectors for real roads gives: short trainings, each without one of them.

All start from the plain network of single vehicles that has seen uneven worlds without parked rows (`starts/`), and
differ in their drives or in one augmentation. The data, for each NAME of `ingredients/`: `dsrc dataset build
studies/shipped/ingredients/NAME.toml --out data/ingredients/NAME`. With real frames, which `dsrc detect --score` reads,
a table says what each finds there.

Usage:
    python -m studies.shipped.ingredients --data data/ingredients --out runs/ingredients --real FRAMES
"""

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

from scipy.stats import binomtest

from dsrc.evaluation.find import detect_drives
from dsrc.evaluation.scoring.sources import SourceScore, score_sources
from dsrc.options.detection import Detection
from dsrc.training.recipes import RECIPES, of_method, override
from dsrc.training.train import train
from studies.look import put_table
from studies.shipped.train import BATCH, HALF, SETTINGS, STARTS

START = "unparked-plain-alone"
FRAMES = 200
"""Frames of an epoch."""
HEAD = ("training", "AP@0.5 / 0.7, %", "recall, %, and its 95 % interval", "false boxes a frame", "error of height, m")


@dataclass(frozen=True)
class Run:
    """Training without one ingredient.

    Attributes:
        name: of its folder.
        title: of its line in a table.
        drives: name of its data set.
        changes: of the recipe.
        sensor: LiDAR of its drives; "" for all.
    """

    name: str
    title: str
    drives: str = "parked"
    changes: tuple[str, ...] = ()
    sensor: str = ""


RUNS = (
    Run("everything", "everything"),
    Run("no_parked_rows", "no parked rows", "unparked"),
    Run("level_worlds", "level, bare worlds without parked rows", "level"),
    Run("one_sensor", "one sensor, half of the drives", sensor="hdl-64e-kitti"),
    Run("no_crowding", "no vehicles put beside what stands", changes=("augmentation.crowding=0",)),
    Run("no_sizes", "sizes as simulated", changes=("augmentation.sizes=0",)),
    Run("no_intensity", "intensities of the simulated sensors alone", changes=("augmentation.intensity=0",)),
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


def score(detector: Path, frames: Path, out: Path) -> SourceScore:
    """Return what a detector finds in all real frames together."""
    detect_drives(Detection(checkpoint=str(detector), data=frames, out=out, engine="fused"))
    return score_sources(out / "boxes.json", frames)[0]


def table(scores: dict[str, SourceScore]) -> list[tuple[str, ...]]:
    """Return a row of `HEAD` per training, recall with its 95 % interval."""
    titles = {run.name: run.title for run in RUNS}
    rows = []
    for name, one in scores.items():
        bounds = binomtest(round(one.recall * one.vehicles), one.vehicles).proportion_ci(0.95, "wilson")
        low, high = (round(100 * bound) for bound in (bounds.low, bounds.high))
        aps, recall = f"{100 * one.ap[0.5]:.1f} / {100 * one.ap[0.7]:.1f}", f"{100 * one.recall:.0f} ({low} to {high})"
        numbers = f"{one.false_per_frame:.1f}", f"{one.height_m:.2f}"
        rows.append((titles.get(name, "the start: uneven worlds, few parked cars"), aps, recall, *numbers))
    return rows


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("data/ingredients"), help="folder of the three data sets")
    parser.add_argument("--out", type=Path, default=Path("runs/ingredients"), help="folder of the runs")
    parser.add_argument("--steps", type=int, default=250, help=f"of {BATCH} frames, each training")
    parser.add_argument("--only", nargs="+", choices=[run.name for run in RUNS], help="runs; default: all")
    parser.add_argument("--real", type=Path, help="folder of real frames to score all trainings by")
    parser.add_argument("--docs", type=Path, help="Markdown page that gets their table")
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
    if options.real is not None:
        files = {"start": STARTS / f"{START}.pt"} | {run.name: options.out / run.name / "detector.pt" for run in RUNS}
        scores = {name: score(file, options.real, options.out / "real" / name) for name, file in files.items()}
        put_table(options.docs, "ingredients", HEAD, table(scores))


if __name__ == "__main__":
    main()
