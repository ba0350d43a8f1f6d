"""Campaign of trainings: every detector of report.md, several at a time, with gates between the phases.

It works offline: `dsrc dataset build dsrc-sim --out data/dsrc-sim` renders recorded traffic, without SUMO. Detectors of
pedestrians and two-wheelers are trained on drives of their own, in a folder beside it:
`dsrc dataset build dsrc-sim-vulnerable --out data/dsrc-sim-vulnerable`.

Finished trainings are kept, interrupted ones resume. Phases: 1 the teacher; 2 students of single clouds, plain and
distilled, from the teacher's weights without the paint; 3 the same with collaborators; 4 the parts of DSRC; 5 rivals
with weights of their own, after starts of their own; 6 extensions of the paper. Seeds 0 and 1 come first, then further
seeds, then the parts. After 1 and within 2, gates on the validation drives decide whether to continue, see
`studies/dsrc_paper/gates.py`.

Usage:
    python -m studies.dsrc_paper.campaign --data data/dsrc-sim --out runs   # two CPU cores: over a day, estimated
    python -m studies.dsrc_paper.campaign --data data/dsrc-sim --out runs --recipe opv2v --jobs 4 --lengthen 4   # a GPU
    python -m studies.dsrc_paper.campaign --data data/dsrc-sim --out runs --phases 1 2 --seeds 2
    python -m studies.dsrc_paper.campaign --data data/dsrc-sim --out runs --only teacher dsrc_s0 attfuse_s0
    python -m studies.dsrc_paper.campaign --data data/dsrc-sim --out runs --dry-run
"""

import argparse
import csv
import io
import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from dsrc.training.recipes import RECIPES, of_method
from sim.errors import UserError
from sim.files import file_sha256, write_file
from studies.dsrc_paper import gates
from studies.dsrc_paper.trainings import SEEDS, TEACHER, Training, campaign

EPOCH = 500
"""Steps between two validations."""
SETTINGS = "settings.json"
KEPT = ("detector.pt", SETTINGS, "environment.json", "metrics.csv", "result.json")
"""Files of a finished training that are kept."""
TOML = Path(__file__).with_name("benchmark.toml")


def command(training: Training, options: argparse.Namespace, known: dict[str, Training]) -> list[str]:
    """Return the command line of a training."""
    out, data = options.out, options.data
    settings = [f"bfloat16={str(options.bfloat16).lower()}", f"workers={options.workers}", *training.settings]
    batch = RECIPES[options.recipe]().batch_size
    if training.passes and not options.trial:
        epochs = max(round(training.passes * options.lengthen), 1)
    else:
        steps = options.trial or round(training.steps * options.lengthen)
        epochs = max(steps // EPOCH, 1)
        settings.append(f"epoch_frames={steps // epochs * batch}")
    frames = min(options.validation_frames, 8 * options.trial) if options.trial else options.validation_frames
    settings += ["validate_every=1", f"validation_frames={frames}"]
    line = [sys.executable, "-m", "dsrc", "model", "train", options.recipe, "--method", training.method]
    line += ["--stage", training.stage, "--seed", str(training.seed), "--epochs", str(epochs)]
    drives = drives_of(training, data)
    line += ["--data", str(drives / "train"), "--validate", str(drives / "validation")]
    line += ["--out", str(out / training.name)]
    if training.init:
        line += ["--init", str(known[training.init].detector(out))]
    if training.teacher:
        line += ["--teacher", str(known[training.teacher].detector(out))]
    return [*line, "--set", *settings]


def drives_of(training: Training, data: Path) -> Path:
    """Return the folder of the data set of a training; all lie side by side."""
    if not training.data:
        return data
    return (data if data.name not in ("", "..") else data.resolve()).with_name(training.data)


def check_drives(chosen: Sequence[Training], options: argparse.Namespace) -> None:
    """Check that the drives are there of every training that is not finished.

    Raises:
        UserError: a folder is missing.
    """
    finished = [folder for folder in (options.out, options.kept) if folder]
    for training in chosen:
        if any(training.detector(folder).is_file() for folder in finished):
            continue
        drives = drives_of(training, options.data)
        for part in ("train", "validation"):
            if not (drives / part).is_dir():
                build = f"`dsrc dataset build {training.data or 'dsrc-sim'} --out {drives}`"
                raise UserError(f"{drives}: {training.name} needs its folder {part}, found none; {build} makes it")


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="folder with train, validation and test")
    parser.add_argument("--out", type=Path, required=True, help="folder of the run folders")
    parser.add_argument("--recipe", default="small", choices=sorted(RECIPES), help="default: small")
    parser.add_argument(
        "--seeds", type=int, default=SEEDS, help="seeds of DSRC and its plain twin; default: %(default)s"
    )
    parser.add_argument("--lengthen", type=float, default=1.0, help="factor of all numbers of steps; default: 1")
    parser.add_argument(
        "--trial", type=int, default=0, metavar="STEPS", help="try everything with this many steps each"
    )
    parser.add_argument("--phases", type=int, nargs="+", choices=range(1, 7), help="these and their dependencies")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these and their dependencies")
    parser.add_argument(
        "--past", nargs="+", default=[], choices=("G0", "G2"), help="continue past this gate, although it failed"
    )
    parser.add_argument(
        "--jobs",
        type=int,
        default=2,
        help="trainings at a time; they share the cores, unless OMP_NUM_THREADS is set; default: 2",
    )
    parser.add_argument(
        "--validation-frames", type=int, default=140, metavar="FRAMES", help="of each validation; default: %(default)s"
    )
    parser.add_argument("--workers", type=int, default=0, help="processes per training that prepare batches")
    parser.add_argument(
        "--bfloat16",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="half precision; some CPUs are not faster with it, see docs/training.md",
    )
    parser.add_argument("--kept", type=Path, help="second folder that gets finished trainings, and has earlier ones")
    parser.add_argument("--dry-run", action="store_true", help="print the commands")
    options = parser.parse_args()
    for name, least in (("seeds", 2), ("jobs", 1), ("validation_frames", 1), ("workers", 0), ("trial", 0)):
        if getattr(options, name) < least:
            parser.error(f"--{name.replace('_', '-')}: expected at least {least}, found {getattr(options, name)}")
    if options.lengthen <= 0:
        parser.error(f"--lengthen: expected more than 0, found {options.lengthen}")
    planned = campaign(options.seeds, factor(options.out))
    known = [training.name for training in planned]
    if unknown := sorted(set(options.only or ()) - set(known)):
        parser.error(f"--only: expected some of {', '.join(known)}, found {', '.join(unknown)}")
    chosen = selected(planned, options)
    if options.dry_run:
        by_name = {training.name: training for training in planned}
        for training in chosen:
            print(shlex.join(command(training, options, by_name)))
        return
    try:
        check_drives(chosen, options)
    except UserError as error:
        parser.error(f"--data: {error}")
    options.out.mkdir(parents=True, exist_ok=True)
    if options.kept:
        restore(options.kept, options.out)
    runner = Campaign(options)
    try:
        failure = runner.run()
    except KeyboardInterrupt:
        runner.stop()
        print("campaign: interrupted; the same command continues it", file=sys.stderr)
        sys.exit(130)
    table = record(campaign(max(options.seeds, SEEDS), factor(options.out)), options.out)
    write_file(options.out / "trainings.csv", table, edited=True)
    if failure:
        sys.exit(failure)
    print(f"now measure: dsrc benchmark {TOML}, with the folders that it names made yours")


def selected(planned: Sequence[Training], options: argparse.Namespace) -> list[Training]:
    """Return the requested trainings and their dependencies, in the campaign's order."""
    by_name = {training.name: training for training in planned}
    wanted = {t.name for t in planned if not options.phases or t.phase in options.phases}
    if options.only:
        # G1 may have replaced some by trainings of half the weights while the campaign ran.
        halved = (name.replace("dsrc-single_s", "dsrc-single-halved_s") for name in options.only)
        wanted = {name if name in by_name else other for name, other in zip(options.only, halved, strict=True)}
    while missing := {need for name in wanted for need in by_name[name].needs()} - wanted:
        wanted |= missing
    return [training for training in planned if training.name in wanted]


def factor(out: Path) -> float:
    """Return the factor of the distillation weights: a half once G1 has failed with the whole."""
    first = gates.recorded(out).get("G1")
    return 1.0 if first is None or first.passed else 0.5


class Campaign:
    """Runner of the trainings, several at a time, and of the gates between them."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options, self.out = options, options.out
        self.running: dict[str, subprocess.Popen] = {}
        self.failed: list[str] = []
        threads = max((os.cpu_count() or 1) // options.jobs, 1)
        shared = {} if torch.cuda.is_available() else {"OMP_NUM_THREADS": str(threads)}
        self.environment = shared | dict(os.environ)

    def run(self) -> str:
        """Run everything; return the reason of an early end, "" when all is done."""
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        with Progress(*columns, console=Console(stderr=True)) as progress:
            task = progress.add_task("trainings")
            while True:
                self._reap()
                weights = factor(self.out)
                planned = campaign(self.options.seeds, weights)
                trainings = selected(planned, self.options)
                closed = self._gates(trainings)
                if factor(self.out) != weights:
                    continue  # a gate has changed the plan
                waiting = [t for t in trainings if not t.detector(self.out).exists() and t.name not in self.running]
                done = len(trainings) - len(waiting) - len(self.running)
                progress.update(task, total=len(trainings), completed=done, description=", ".join(self.running) or "-")
                if closed:
                    waiting = [t for t in waiting if not behind(t, closed)]
                waiting = [t for t in waiting if t.name not in self.failed]
                by_name = {t.name: t for t in planned}
                ready = [t for t in waiting if all(by_name[n].detector(self.out).exists() for n in t.needs())]
                for training in ready[: max(self.options.jobs - len(self.running), 0)]:
                    self._start(training, by_name)
                if not self.running and not ready:
                    names = [f"{name}, see {self.out}/{name}.log" for name in self.failed]
                    names += [f"gate {name} failed, see {self.out}/{gates.FILE}; --past {name}" for name in closed]
                    return "; ".join(names)
                time.sleep(1.0)

    def stop(self) -> None:
        """End the running trainings; each resumes at its last finished epoch, and one that has ended is kept."""
        self._reap()
        for process in self.running.values():
            process.terminate()
        for process in self.running.values():
            process.wait()

    def _start(self, training: Training, by_name: dict[str, Training]) -> None:
        with (self.out / f"{training.name}.log").open("ab") as log:
            self.running[training.name] = subprocess.Popen(
                command(training, self.options, by_name), stdout=log, stderr=subprocess.STDOUT, env=self.environment
            )

    def _reap(self) -> None:
        for name, process in list(self.running.items()):
            if process.poll() is not None:
                del self.running[name]
                self.failed += [name] if process.returncode else []
                if self.options.kept and not process.returncode:
                    keep(self.out, self.options.kept, name, max(self.options.seeds, SEEDS))

    def _gates(self, trainings: Sequence[Training]) -> list[str]:
        """Measure the gates that are due; return those that are closed."""
        if self.options.trial or self.options.lengthen != 1.0:
            return []  # the gates' steps and bounds are of the whole campaign
        names = {training.name for training in trainings}
        before = gates.recorded(self.out)
        if "G0" not in before and TEACHER in names and (self.out / TEACHER / "teacher/result.json").exists():
            recipe = of_method(RECIPES[self.options.recipe](), "dsrc")
            self._note(gates.teacher_gate(self.out / TEACHER / "teacher", self.options.data, recipe))
        for name, step, least in (("G1", 1000, (-1.0, 1.0)), ("G2", 2500, (0.5, 0.5))):
            pairs = self._pairs("dsrc-single", "single", 2)
            if name not in before and all(part in names for pair in pairs for part in pair):
                self._try(name, pairs, step, least)
        pairs = self._pairs("dsrc", "attfuse", self.options.seeds)
        ended = [self.out / run / "student/result.json" for pair in pairs for run in pair]
        new = "G3" not in before or not before["G3"].note.endswith(f", {len(pairs)} seeds")
        if new and all(path.exists() for path in ended):
            self._note(gates.seeds_gate(self.out, pairs))
        return [
            n
            for n, g in gates.recorded(self.out).items()
            if n in ("G0", "G2") and not g.passed and n not in self.options.past
        ]

    def _pairs(self, distilled: str, plain: str, seeds: int) -> list[tuple[str, str]]:
        halved = "-halved" if factor(self.out) != 1.0 and distilled == "dsrc-single" else ""
        return [(f"{distilled}{halved}_s{seed}", f"{plain}_s{seed}") for seed in range(seeds)]

    def _try(self, name: str, pairs: list[tuple[str, str]], step: int, least: tuple[float, float]) -> None:
        try:
            measured = gates.step_gate(name, self.out, pairs, step, least)
        except LookupError:
            return
        self._note(measured)
        if name == "G1" and not measured.passed:
            for distilled, _ in pairs:  # begun again with half the weights, in folders of their own
                if process := self.running.pop(distilled, None):
                    process.terminate()
                    process.wait()

    def _note(self, measured: gates.Gate) -> None:
        gates.record(self.out, measured)
        if self.options.kept:
            self.options.kept.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(self.out / gates.FILE, self.options.kept / gates.FILE)


def behind(training: Training, closed: Sequence[str]) -> bool:
    """Return whether a closed gate blocks a training."""
    if "G0" in closed:
        return training.phase > 1
    return training.phase > 2 or training.seed > 1


def keep(out: Path, kept: Path, name: str, seeds: int = SEEDS) -> None:
    """Copy the files of a finished training of a campaign of so many seeds."""
    planned = (t for weights in (1.0, 0.5) for t in campaign(seeds, weights))
    training = next(t for t in planned if t.name == name)
    source, target = training.folder(out), training.folder(kept)
    target.mkdir(parents=True, exist_ok=True)
    for part in KEPT:
        if part != SETTINGS:
            shutil.copyfile(source / part, target / part)
    # The folders of this machine mean nothing elsewhere; the hashes of their data stay.
    made = json.loads((source / SETTINGS).read_text(encoding="utf-8"))
    made.pop("folders", None)
    write_file(target / SETTINGS, json.dumps(made, indent=2) + "\n")


def restore(kept: Path, out: Path) -> None:
    """Copy kept trainings and gates that are missing."""
    if (kept / gates.FILE).exists() and not (out / gates.FILE).exists():
        shutil.copyfile(kept / gates.FILE, out / gates.FILE)
    for source in sorted(kept.glob("*/*/detector.pt")):
        folder = out / source.parent.relative_to(kept)
        if not folder.exists():
            shutil.copytree(source.parent, folder)


def record(planned: Sequence[Training], out: Path) -> str:
    """Return the finished trainings as CSV: starts, steps and results, see `Training` for `data`."""
    done = [t for t in planned if t.detector(out).exists() and (t.folder(out) / "metrics.csv").exists()]
    names = {file_sha256(t.detector(out)): t.name for t in done}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = (
        "name",
        "phase",
        "method",
        "stage",
        "seed",
        "init",
        "tensors_taken",
        "teacher",
        "settings",
        "data",
        "steps",
        "minutes",
    )
    writer.writerow([*columns, "val_ap_bev_50", "val_ap_bev_70"])
    for training in done:
        made = json.loads((training.folder(out) / SETTINGS).read_text(encoding="utf-8"))
        init, teacher = made.get("init") or {}, made.get("teacher")
        metrics = (training.folder(out) / "metrics.csv").read_text(encoding="utf-8")
        rows = list(csv.DictReader(io.StringIO(metrics)))
        minutes = sum(float(row["seconds"]) for row in rows) / 60
        taken = f"{init['tensors_taken']}/{init['tensors']}" if "tensors" in init else ""
        writer.writerow(
            [
                *(training.name, training.phase, training.method, made["settings"]["stage"], made["seed"]),
                *(names.get(init.get("sha256"), init.get("sha256", "")), taken),
                *("" if teacher is None else names.get(teacher, teacher), " ".join(training.settings)),
                training.data,
                *(rows[-1]["step"], f"{minutes:.1f}"),
                *(rows[-1].get(f"val/ap_bev_{iou}", "") for iou in (50, 70)),
            ]
        )
    return text.getvalue()


if __name__ == "__main__":
    main()
