"""Trainings and tables of a question: rivals, lengths, parts of DSRC, or the paper's scale; see `plan.md`.

What is finished stays, an interrupted training goes on at its last epoch, and at the end `dsrc benchmark` measures all
that the tables name, under the six corruptions in both families. A sitting on a machine that is given back: `--minutes`
ends it, and `--kept` is a folder of detector files in half precision, one for each finished training, that is brought
back and taken to the next. Beside each is its record, which is enough for a training that nothing starts from and no
table names: its weights may be deleted. Questions share trainings by a common `--kept`; lines trained in bfloat16 and
in float32 are not measured together. `--share 0.01` tries everything on a hundredth of the steps; `--list` prints the
plan. Processes with one `--out` share its trainings: each takes the next that is free. All but one of them have
`--only '*'`, which measures nothing; `--measure` measures the lines of which all trainings are finished.

Usage:
    python -m studies.rivals.train rivals --data data/dsrc-sim-2 --out runs/rivals
    python -m studies.rivals.train lengths --data data/dsrc-sim-2 --out runs/lengths
    python -m studies.rivals.train parts --data data/dsrc-sim-2 --out runs/parts
    python -m studies.rivals.train scale --data data/dsrc-sim-2 --out runs/scale --kept kept --minutes 40
"""

import argparse
import json
import shutil
import signal
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from dsrc.cli.evaluate import Benchmark
from dsrc.data.drives import list_drives, open_drive
from dsrc.data.sample import make_sample
from dsrc.models.storage.checkpoint import load_detector, read_meta
from dsrc.options.detection import Device
from dsrc.runs.lock import BusyError, locked
from dsrc.tables.files import json_text
from dsrc.training.recipes import RECIPES
from dsrc.training.run_folder import DETECTOR, RESULT
from dsrc.training.train import train
from sim.errors import SettingsError, UserError, complaint
from sim.files import file_sha256, write_file
from studies.look import put_table
from studies.rivals.questions import DOUBLED, QUESTIONS, Training, pairs, rivals
from studies.shipped.train import STARTS

_NOT_FINISHED = "{}: this training comes first and is not finished"
_POLL_S = 5.0
LEAST_SCORE = 0.05
"""Score from which boxes count."""
HEAD = (
    *("method", "trainings", "steps of the kept weights", "parameters, M", "GFLOP a frame"),
    "validation AP@0.5 / 0.7, %",
)


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("question", choices=QUESTIONS)
    parser.add_argument("--data", type=Path, default=Path("data/dsrc-sim-2"), help="with train, validation, unseen")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs and of the benchmark")
    parser.add_argument("--kept", type=Path, help="folder of detectors of finished trainings; default: none")
    parser.add_argument("--minutes", type=float, help="end of this sitting; default: when all is done")
    parser.add_argument("--share", type=float, default=1.0, help="share of the steps, to try the plan")
    parser.add_argument(
        "--longest", type=int, choices=DOUBLED, help="steps at which rivals end, before the share; default: the last"
    )
    parser.add_argument("--recipe", choices=sorted(RECIPES), help="in place of the plan's, to try a small network")
    parser.add_argument("--frames", type=int, help="frames of the benchmark; default: all")
    parser.add_argument("--docs", type=Path, help="Markdown document that gets the tables; default: none")
    parser.add_argument("--workers", type=int, default=1, help="processes that prepare batches")
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument("--only", nargs="+", metavar="NAME", help="train runs of these names, as *-0, and measure none")
    mode.add_argument("--measure", action="store_true", help="train nothing, measure the lines that are finished")
    mode.add_argument("--list", action="store_true", help="print the plan and train nothing")
    options = parser.parse_args()
    if options.longest and options.question != "rivals":
        parser.error(f"--longest: expected with rivals alone, found with {options.question}")
    if not 0.0 < options.share <= 1.0:
        parser.error(f"--share: expected above 0 and at most 1, found {options.share:g}")
    begun = time.monotonic()
    if options.minutes is not None:
        signal.signal(signal.SIGALRM, signal.default_int_handler)
        signal.setitimer(signal.ITIMER_REAL, 60.0 * options.minutes)
    try:
        measured = list(finished(options))
        if options.measure or not (options.list or options.only):
            measure(options, measured)
    except UserError as error:
        sys.stderr.write(f"train: {error}\n")
        raise SystemExit(2) from None
    except (KeyboardInterrupt, SystemExit):
        if options.minutes is None or time.monotonic() - begun < 60.0 * options.minutes:
            raise
        print("the sitting is over; the same command goes on", flush=True)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def finished(options: argparse.Namespace) -> Iterator[Training]:
    """Finish the trainings of a question, as far as no other process does; yield those that are measured."""
    known: dict[str, Training] = {}

    def ranked(name: str) -> float:
        if options.list:
            return float(known[name].steps)
        if not options.measure and named(name, options):
            finish(known[name], known, options)
        return sum(validated(name, options))

    plan = partial(rivals, longest=options.longest) if options.longest else QUESTIONS[options.question]
    for one in plan(ranked):
        told = known.pop(one.name, None)  # the run that is measured stands last, in the order of the tables
        run = known[one.name] = replace(one, base=options.recipe or one.base)
        if not named(run.name, options):
            continue
        if told:
            print(f"{run.name}: above; a training of {run.title}", flush=True)
        else:
            start = f"from {run.start}" if run.start else "from random weights"
            print(f"{run.name}: {run.method}, {run.stage}, {steps_of(run, options)} steps, {start}", flush=True)
        if not options.list:
            check_length(run, options)
        if not (options.list or options.measure):
            if not claim(run, known, options):
                print(f"{run.name}: another process trains it, or what it starts from", flush=True)
    chosen = [run for run in known.values() if named(run.name, options)]
    if options.only and not chosen:
        hint = "; --list prints them"
        raise SettingsError(
            complaint(options.question, "--only", "names of its trainings", " ".join(options.only), hint)
        )
    for run in chosen:
        if not (options.list or options.measure):
            finish(run, known, options)
        if run.title:
            yield run
    most = "at most " if options.list else ""
    print(f"{most}{sum(steps_of(run, options) for run in chosen)} steps in all")


def steps_of(run: Training, options: argparse.Namespace) -> int:
    """Return the steps that `--share` leaves of a training."""
    recipe = run.recipe(options.share)
    return recipe.epochs * (recipe.epoch_frames or 0) // recipe.batch_size


def named(name: str, options: argparse.Namespace) -> bool:
    """Return whether a run is one of those that this process trains."""
    return not options.only or any(fnmatch(name, pattern) for pattern in options.only)


def finish(run: Training, known: Mapping[str, Training], options: argparse.Namespace) -> None:
    """Train a run and what it starts from, or wait for the process that does."""
    for name in filter(None, (run.start, run.teacher)):
        if name in known and named(name, options):
            finish(known[name], known, options)
    while not claim(run, known, options):
        time.sleep(_POLL_S)


def claim(run: Training, known: Mapping[str, Training], options: argparse.Namespace) -> bool:
    """Train a run that is not finished, and keep its detector and record; return False where it has to wait.

    It waits for another process that trains it, or what it starts from.
    """
    if settled(run, options):
        return True
    for name in filter(None, (run.start, run.teacher)):
        if name in known and named(name, options) and not settled(known[name], options):
            return False
    start, teacher = (detector_of(name, options) if name else None for name in (run.start, run.teacher))
    try:
        with locked(options.out / "claims" / run.name, what="training"):
            if settled(run, options):  # by another process, since
                return True
            begun = time.monotonic()
            made = train(
                run.recipe(options.share, options.workers),
                options.data / "train",
                options.out / run.name,
                run.stage,
                teacher=teacher,
                validate=options.data / "validation",
                seed=run.seed,
                init=start,
            )
            if options.kept:
                options.kept.mkdir(parents=True, exist_ok=True)
                part = options.kept / f"{run.name}.part"
                shutil.copyfile(made, part)
                part.replace(options.kept / f"{run.name}.pt")
                record = record_of(run.name, options) or {}
                write_file(options.kept / f"{run.name}.json", json_text(record))
            print(f"{run.name}: {time.monotonic() - begun:.0f} s", flush=True)
    except BusyError:
        return False
    return True


def settled(run: Training, options: argparse.Namespace) -> bool:
    """Return whether a run is finished: its detector is there, or of one that is not measured its record."""
    return done(run.name, options) is not None or (not run.title and record_of(run.name, options) is not None)


def done(name: str, options: argparse.Namespace) -> Path | None:
    """Return the detector of a finished run, or of a start that ships with the studies; None without one."""
    places = [STARTS / f"{name}.pt", *([options.kept / f"{name}.pt"] if options.kept else [])]
    if (options.out / name / RESULT).is_file():
        places.append(options.out / name / DETECTOR)
    return next((path for path in places if path.is_file()), None)


def check_length(run: Training, options: argparse.Namespace) -> None:
    """Check that a detector that is there has the start of the plan, and was trained on as many frames as it asks."""
    if record := record_of(run.name, options):
        asked = run.recipe(options.share)
        wanted = asked.epochs * (asked.epoch_frames or 0)
        if record["frames"] != wanted:
            expected, hint = f"{wanted}, as --share {options.share:g} asks", "; another share has another folder"
            path = done(run.name, options) or options.kept / f"{run.name}.json"
            raise SettingsError(complaint(path, "frames of the training", expected, record["frames"], hint))
        start = done(run.start, options) if run.start else None
        if start and record.get("start") != file_sha256(start):
            path = done(run.name, options) or options.kept / f"{run.name}.json"
            raise SettingsError(complaint(path, "start", f"{file_sha256(start)} of {start}", record.get("start")))


def record_of(name: str, options: argparse.Namespace) -> dict[str, Any] | None:
    """Return frames of the training, precision and AP on the validation drives of a finished run; None of another."""
    if path := done(name, options):
        meta: Any = read_meta(path)
        recipe, metrics = meta["settings"]["recipe"], meta["metrics"]
        return {
            "frames": recipe["epochs"] * recipe["epoch_frames"],
            "bfloat16": recipe["bfloat16"],
            "start": None if meta["init"] is None else meta["init"]["sha256"],
            **{name: float(metrics[f"val/{name}"]) for name in ("ap_bev_50", "ap_bev_70")},
        }
    kept = options.kept / f"{name}.json" if options.kept else None
    return json.loads(kept.read_text(encoding="utf-8")) if kept and kept.is_file() else None


def detector_of(name: str, options: argparse.Namespace) -> Path:
    """Return the detector of a run that is finished."""
    path = done(name, options)
    if path is None:
        raise SystemExit(_NOT_FINISHED.format(name))
    return path


def validated(name: str, options: argparse.Namespace) -> tuple[float, float]:
    """Return AP@0.5 and AP@0.7 of a finished run on the validation drives."""
    record = record_of(name, options)
    if record is None:
        raise SystemExit(_NOT_FINISHED.format(name))
    return record["ap_bev_50"], record["ap_bev_70"]


def measure(options: argparse.Namespace, measured: list[Training]) -> None:
    """Print what the methods cost, write the plan of the benchmark, and run it."""
    titles: dict[str, list[Training]] = {}
    for run in measured:
        titles.setdefault(run.title, []).append(run)
    titles = {title: runs for title, runs in titles.items() if all(done(run.name, options) for run in runs)}
    if not titles:
        raise SystemExit("measure: no line has all its trainings")
    check_precision([detector_of(run.name, options) for runs in titles.values() for run in runs])
    put_table(
        options.docs, f"{options.question}_costs", HEAD, [cost(title, runs, options) for title, runs in titles.items()]
    )
    lines = [f"name = {json.dumps(options.question)}", 'corruption = ["paper_six"]', 'family = ["physical", "paper"]']
    lines += [f"frames = {options.frames}"] if options.frames else []
    for title, runs in titles.items():
        files = [str(detector_of(run.name, options).resolve()) for run in runs]
        lines += ["", "[[methods]]", f"name = {json.dumps(title)}", f"detectors = {json.dumps(files)}"]
        lines += [f"use = {{score_threshold = {LEAST_SCORE}}}"]
    drives = json.dumps([str((options.data / "unseen").resolve())])
    lines += ["", "[[datasets]]", f"name = {json.dumps(options.data.name)}", f"drives = {drives}"]
    for method, baseline in pairs(list(titles)):
        lines += ["", "[[differences]]", f"method = {json.dumps(method)}", f"baseline = {json.dumps(baseline)}"]
    plan = options.out / "benchmark.toml"
    write_file(plan, "\n".join(lines) + "\n", edited=True)
    device: Device = "cuda" if torch.cuda.is_available() else "cpu"
    Benchmark(plan=plan, out=options.out / "benchmark", docs=options.docs, device=device).run()


def check_precision(paths: list[Path]) -> None:
    """Check that detectors that are compared were trained in one precision."""
    half = {path: read_meta(path)["settings"]["recipe"]["bfloat16"] for path in paths}
    for path in paths[1:]:
        if half[path] != half[paths[0]]:
            raise SettingsError(complaint(path, "bfloat16", f"{half[paths[0]]}, as {paths[0]} was trained", half[path]))


def cost(title: str, runs: list[Training], options: argparse.Namespace) -> tuple[str, ...]:
    """Return the row of a method in the table of costs; GFLOP are those of a validation frame with all its agents."""
    detector = load_detector(detector_of(runs[0].name, options))
    drive = open_drive(list_drives(options.data / "validation")[0])
    sample = make_sample(drive.read(0), None, detector.settings.request)
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        detector.detect(sample)
    steps, ap = [], np.array([validated(run.name, options) for run in runs]).mean(axis=0)
    for run in runs:
        meta: Any = read_meta(detector_of(run.name, options))
        recipe = meta["settings"]["recipe"]
        steps.append((meta["epoch"] + 1) * recipe["epoch_frames"] // recipe["batch_size"])
    millions = 1e-6 * sum(weight.numel() for weight in detector.parameters())
    sizes = f"{millions:.2f}", f"{1e-9 * counter.get_total_flops():.0f}"
    return title, str(len(runs)), " ".join(map(str, steps)), *sizes, " / ".join(f"{100.0 * value:.1f}" for value in ap)


if __name__ == "__main__":
    main()
