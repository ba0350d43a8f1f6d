"""Trainings of the detectors for real roads: plain and DSRC, alone and with collaborators, on dsrc-sim-2.

Heights are above a fitted ground, cars of any height and sensors of six kinds are seen. The first start from
`starts/`, networks of an earlier form of the data set. The runs follow each other, and each goes on where it was
stopped. `--share 0.01` tries them all on a hundredth of the steps; `--list` prints the plan. The data: `dsrc dataset
build dsrc-sim-2 --out data/dsrc-sim-2`.

Usage:
    python -m studies.shipped.train --data data/dsrc-sim-2 --out runs/shipped-2
"""

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

from dsrc.training.recipes import RECIPES, Recipe, Stage, of_method, override
from dsrc.training.train import train

STARTS = Path(__file__).resolve().with_name("starts")
BATCH = 4
FRAMES = 1000
"""Frames of an epoch, drawn anew for each."""
SETTINGS = (
    "height=ground",
    "augmentation.height_m=0.15",
    "augmentation.sizes=0.25",
    "augmentation.crowding=0.3",
    "augmentation.intensity=0.4",
    "augmentation.thinning=0.3",
    "ema=0.998",
    "labels.min_points=5",
    f"batch_size={BATCH}",
    "validate_every=4",
    "validation_frames=24",
)
"""Changes of a recipe; lifts are errors of the fitted ground, thinning stands for sensors of fewer beams."""


HALF = "bfloat16=true"
"""Change of the recipe: convolutions in bfloat16, so that trainings of all machines may be compared."""
ALONE = ("no-collaboration", "dsrc-alone")
"""Methods of single vehicles: their ground truth is what these have seen."""


@dataclass(frozen=True)
class Run:
    """Training of one detector.

    Attributes:
        name: of its folder.
        method: see `dsrc model train --method`.
        stage: `plain`, `teacher` or `student`.
        start: name of the run, or of the file in `starts`, whose weights it starts from.
        steps: of `BATCH` frames.
        rate: peak learning rate.
        teacher: name of the run that teaches it; "" for none.
        seed: of weights, order and augmentation.
        settings: further changes of the recipe.
        base: name of the recipe that all of this changes.
    """

    name: str
    method: str
    stage: Stage
    start: str
    steps: int
    rate: float
    teacher: str = ""
    seed: int = 0
    settings: tuple[str, ...] = ()
    base: str = "small"

    def recipe(self, share: float = 1.0, workers: int = 1) -> Recipe:
        """Return its recipe, with a share of its steps."""
        drawn = BATCH * max(round(self.steps * share), 1)
        epochs = max(round(drawn / FRAMES), 1)
        size = (f"epochs={epochs}", f"epoch_frames={drawn // epochs}", f"learning_rate={self.rate}")
        alone = "augmentation.alone=1" if self.method in ALONE else "augmentation.alone=0.4"
        changes = (*SETTINGS, *size, alone, HALF, f"workers={workers}", *self.settings)
        return override(of_method(RECIPES[self.base](), self.method), changes)


PLAN = (
    Run("plain-alone", "no-collaboration", "plain", "unparked-plain-alone", 3000, 1.5e-3),
    Run("plain", "attfuse", "plain", "plain-alone", 1500, 5e-4),
    Run("teacher", "dsrc", "teacher", "unparked-teacher", 1000, 1.5e-3),
    Run("dsrc-alone", "dsrc-alone", "student", "unparked-dsrc-alone", 3000, 1.5e-3, "teacher"),
    Run("dsrc", "dsrc", "student", "dsrc-alone", 1500, 5e-4, "teacher"),
)
"""Runs in their order; a teacher goes before what it teaches. Plain and DSRC have equal steps."""


def detector_of(name: str, out: Path) -> Path:
    """Return the detector file of a run, or of a start."""
    return out / name / "detector.pt" if name in {run.name for run in PLAN} else STARTS / f"{name}.pt"


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("data/dsrc-sim-2"), help="folder of the data set")
    parser.add_argument("--out", type=Path, default=Path("runs/shipped-2"), help="folder of the runs")
    parser.add_argument("--share", type=float, default=1.0, help="share of the steps, to try the plan")
    parser.add_argument("--only", nargs="+", choices=[run.name for run in PLAN], help="runs; default: all")
    parser.add_argument("--list", action="store_true", help="print the plan and train nothing")
    parser.add_argument("--workers", type=int, default=1, help="processes that prepare batches")
    options = parser.parse_args()
    for run in PLAN:
        if options.only and run.name not in options.only:
            continue
        print(f"{run.name}: {run.method}, {run.stage}, {run.steps} steps, from {run.start}", flush=True)
        if options.list:
            continue
        begun = time.monotonic()
        train(
            run.recipe(options.share, options.workers),
            options.data / "train",
            options.out / run.name,
            run.stage,
            teacher=detector_of(run.teacher, options.out) if run.teacher else None,
            validate=options.data / "validation",
            init=detector_of(run.start, options.out),
        )
        print(f"{run.name}: {time.monotonic() - begun:.0f} s", flush=True)


if __name__ == "__main__":
    main()
