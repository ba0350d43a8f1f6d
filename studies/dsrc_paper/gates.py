"""Gates of the campaign of report.md: least results of teacher and distillation before more is trained on them.

Usage:
    python -m studies.dsrc_paper.gates --runs runs --data data/dsrc-sim    # measures G0
"""

import argparse
import csv
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from scipy import stats

from dsrc.data.drives import list_drives
from dsrc.data.points_in_boxes import points_in_boxes
from dsrc.data.sample import Sample
from dsrc.models.detector import Detector
from dsrc.models.inputs.batch import collate
from dsrc.models.storage.checkpoint import load_detector, with_fusion
from dsrc.ops.anchors import ANCHORS
from dsrc.ops.targets import assign_targets
from dsrc.training.datamodule import DetectionData
from dsrc.training.initialise import initialise_from
from dsrc.training.module import DetectionModule, as_teacher
from dsrc.training.recipes import RECIPES, Recipe, of_method
from dsrc.training.samples import FrameRef, SampleStore
from sim.files import write_file

FILE = "gates.json"
AP = ("val/ap_bev_50", "val/ap_bev_70")


@dataclass(frozen=True)
class Gate:
    """Measured gate.

    Attributes:
        name: G0 to G3.
        passed: whether all bounds hold.
        measured: values by name; AP and its differences in points.
        bounds: lower bounds of the values.
        note: frames, batches or steps of the values.
    """

    name: str
    passed: bool
    measured: dict[str, float]
    bounds: dict[str, float]
    note: str


def gate(name: str, measured: dict[str, float], bounds: dict[str, float], note: str) -> Gate:
    """Return a gate that passes if every value reaches its bound; NaN fails."""
    passed = all(measured[key] >= bound for key, bound in bounds.items())
    rounded = {key: float(f"{value:.4g}") for key, value in measured.items()}
    return Gate(name, passed, rounded, bounds, note)


def teacher_gate(teacher: Path, data: Path, recipe: Recipe, frames: int = 140, batches: int = 30) -> Gate:
    """Return G0: the teacher's AP, its score at boxes hidden from the ego, and DAP's share of the loss.

    Args:
        teacher: run folder of a teacher of single clouds.
        data: folder with `train` and `validation`.
        recipe: recipe of a DSRC student.
        frames: number of validation frames for scores, evenly spread.
        batches: number of training batches for losses of an untrained student.
    """
    detector = with_fusion(load_detector(teacher / "detector.pt"), recipe.model.fusion)
    ap = json.loads((teacher / "result.json").read_text(encoding="utf-8"))["metrics"][AP[0]]
    scores = hidden_scores(detector, list_drives(data / "validation"), recipe, frames)
    student = Detector(recipe.settings("student"))
    initialise_from(teacher / "detector.pt", student)
    module = DetectionModule(recipe, student, detector).train()
    loader = DetectionData(recipe, student.settings, list_drives(data / "train"), None, seed=0).train_dataloader()
    sums: dict[str, float] = {}
    with torch.no_grad():
        for batch in islice(loader, batches):
            for name, value in module.losses(batch).items():
                sums[name] = sums.get(name, 0.0) + value.item() / batches
    share = sums["dap"] / (sums["cls"] + sums["reg"])
    measured = {"ap_bev_50": 100 * ap, "score_at_hidden_positives": float(np.mean(scores)), "dap_share": share}
    measured |= {f"loss_{name}": value for name, value in sums.items()}
    bounds = {"ap_bev_50": 80.0, "score_at_hidden_positives": 0.3, "dap_share": 0.1}
    note = f"{frames} validation frames, {len(scores)} anchors of boxes without a point of the ego; {batches} batches"
    return gate("G0", measured, bounds, note)


def hidden_scores(teacher: Detector, drives: Sequence[Path], recipe: Recipe, frames: int) -> list[float]:
    """Return a teacher's scores at the positive anchors of boxes without a point of the ego."""
    store = SampleStore(drives, recipe.model.request)
    refs = [store.frames[i] for i in np.linspace(0, len(store.frames) - 1, frames).round().astype(int)]
    scores: list[float] = []
    for ref in refs:
        sample = _first_ego(store, ref)
        _, seen = points_in_boxes(sample.boxes, sample.clouds[0])
        hidden = sample.boxes[np.setdiff1d(np.arange(len(sample.boxes)), seen)]
        if not len(hidden):
            continue
        fits = ANCHORS[recipe.model.users].takes[hidden.label]
        positive = assign_targets(
            hidden.array, teacher.anchors, ANCHORS[recipe.model.users].positive_iou, fits=fits
        ).positive
        with torch.no_grad():
            output = as_teacher(teacher, collate([sample], recipe.settings("student"), training=True))
        scores += torch.sigmoid(output.cls[0].permute(1, 2, 0))[torch.as_tensor(np.asarray(positive))].tolist()
    return scores


def _first_ego(store: SampleStore, ref: FrameRef) -> Sample:
    return store.sample(ref, store.egos(ref)[0])


def step_gate(name: str, runs: Path, pairs: Sequence[tuple[str, str]], step: int, least: tuple[float, float]) -> Gate:
    """Return a gate on the mean difference of AP between runs at a step.

    Args:
        name: name of the gate.
        runs: folder of run folders.
        pairs: names of a distilled student and of its plain twin.
        step: step of their trainings with a validation.
        least: least gain in points of AP@0.5 and AP@0.7.

    Raises:
        LookupError: one of them has not reached the step.
    """
    found = np.array([[ap_at(runs / run / "student", step) for run in pair] for pair in pairs])
    gain = found[:, 0] - found[:, 1]
    measured = {"gain_50": gain[:, 0].mean(), "gain_70": gain[:, 1].mean()}
    measured |= {
        f"{run}_{iou}": value
        for pair, row in zip(pairs, found, strict=True)
        for run, both in zip(pair, row, strict=True)
        for iou, value in zip((50, 70), both, strict=True)
    }
    return gate(name, measured, {"gain_50": least[0], "gain_70": least[1]}, f"validation at step {step}")


def ap_at(run: Path, step: int | None = None) -> tuple[float, float]:
    """Return AP@0.5 and AP@0.7 in points of a run's validation at a step; None is the last.

    Raises:
        LookupError: there is no validation at the step.
    """
    path = run / "metrics.csv"
    rows = list(csv.DictReader(path.open(encoding="utf-8"))) if path.exists() else []
    rows = [row for row in rows if row.get(AP[0])]
    if step is not None:
        rows = [row for row in rows if int(row["step"]) == step]
    if not rows:
        raise LookupError(f"{run}: no validation at step {step}")
    return 100 * float(rows[-1][AP[0]]), 100 * float(rows[-1][AP[1]])


def seeds_gate(runs: Path, pairs: Sequence[tuple[str, str]]) -> Gate:
    """Return G3: the gain over the seeds, with its 95 % interval by Student's t above 0 at both overlaps."""
    found = np.array([[ap_at(runs / run / "student") for run in pair] for pair in pairs])
    gain = found[:, 0] - found[:, 1]
    half = stats.t.ppf(0.975, len(gain) - 1) * gain.std(axis=0, ddof=1) / math.sqrt(len(gain))
    measured = {}
    for column, iou in enumerate((50, 70)):
        measured |= {f"gain_{iou}": gain[:, column].mean(), f"lower_{iou}": gain[:, column].mean() - half[column]}
    return gate("G3", measured, {"lower_50": 0.0, "lower_70": 0.0}, f"validation, last step, {len(gain)} seeds")


def recorded(runs: Path) -> dict[str, Gate]:
    """Return the recorded gates by name."""
    path = runs / FILE
    if not path.exists():
        return {}
    return {row["name"]: Gate(**row) for row in json.loads(path.read_text(encoding="utf-8"))}


def record(runs: Path, measured: Gate) -> None:
    """Record a gate, in place of an earlier one of its name."""
    gates = recorded(runs) | {measured.name: measured}
    text = json.dumps([asdict(gates[name]) for name in sorted(gates)], indent=2) + "\n"
    write_file(runs / FILE, text, edited=True)


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=Path, required=True, help="folder of the run folders")
    parser.add_argument("--data", type=Path, required=True, help="folder with train and validation")
    parser.add_argument("--recipe", default="small", choices=sorted(RECIPES), help="default: small")
    options = parser.parse_args()
    recipe = of_method(RECIPES[options.recipe](), "dsrc")
    teacher = options.runs / "teacher" / "teacher"
    for path in (teacher / "detector.pt", teacher / "result.json"):
        if not path.is_file():
            parser.error(f"--runs: expected a finished teacher with {path}, found none")
    for part in ("train", "validation"):
        if not (options.data / part).is_dir():
            parser.error(f"--data: expected a folder {part} in {options.data}, found none")
    found = teacher_gate(teacher, options.data, recipe)
    record(options.runs, found)
    print(json.dumps(asdict(found), indent=2))


if __name__ == "__main__":
    main()
