"""Train every detector of docs/results.md, several at a time, then measure them: the whole campaign in one command.

It needs neither SUMO nor a network: `dsrc generate dsrc-sim --out data/dsrc-sim` renders recorded traffic. What is
done is not done again, and what was interrupted goes on.

Usage:
    python examples/tables.py --data data/dsrc-sim --out runs                      # two CPU cores: a night
    python examples/tables.py --data data/dsrc-sim --out runs --recipe opv2v --jobs 4 --steps 4000   # a GPU
    python examples/tables.py --data data/dsrc-sim --out runs --only teacher dsrc_s0 attfuse_s0
    python examples/tables.py --data data/dsrc-sim --out runs --dry-run
"""

import argparse
import csv
import io
import json
import os
import shlex
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from dsrc.evaluation.provenance import hash_file
from dsrc.evaluation.tables import write_atomic
from dsrc.training.recipes import RECIPES

FIRST, START = "first", "start"
SEEDS = (0, 1, 2)
RIVALS = (
    "no-collaboration",
    "early",
    "late",
    "f-cooper",
    "v2vnet",
    "v2x-vit",
    "cobevt",
    "where2comm",
    "coalign",
    "ermvp",
    "mrcnet-style",
)
STRONGEST = "where2comm"
"""The rival that has three seeds, like DSRC and its plain student: best on the validation drives with the first."""
TOML = Path(__file__).parents[1] / "docs/results/dsrc-sim-small/benchmark.toml"


@dataclass(frozen=True)
class Training:
    """One run folder.

    Attributes:
        name: of the folder.
        method: see `dsrc train --method`.
        stage: `plain` for the common start, else `teacher` or `student`.
        seed: of weights, order and augmentation.
        settings: what differs from the recipe.
        teacher: the training whose detector teaches; "" for none.
        passes: over all frames; 0 takes `--steps` steps instead.
        init: the training whose detector it starts from; "" for none.
    """

    name: str
    method: str
    stage: str
    seed: int = 0
    settings: tuple[str, ...] = ()
    teacher: str = ""
    passes: int = 0
    init: str = START

    def detector(self, out: Path) -> Path:
        """Return the file that it makes."""
        return out / self.name / self.stage / "detector.pt"

    def needs(self) -> tuple[str, ...]:
        """Return the trainings that have to be there first."""
        return tuple(name for name in (self.init, self.teacher) if name)


def campaign() -> list[Training]:
    """Return all trainings, those that most depends on first.

    All begin at one detector of single clouds, which knows points, boxes and scores already; what a method adds of
    its own begins at random. Teachers, too, read single clouds, made dense by everybody's: the fusion of DSRC has no
    weights.
    """
    ablations = {"sdd": ("pcp=false", "rec=false"), "pcp": ("sdd=false", "rec=false"), "sdd-pcp": ("rec=false",)}
    return [
        Training(FIRST, "no-collaboration", "plain", passes=2, init=""),
        Training(START, "no-collaboration", "plain", 1, passes=3, settings=("ema=0.998",), init=FIRST),
        Training("teacher-first", "dsrc-alone", "teacher", passes=2, settings=("ema=0.998",), init=FIRST),
        Training(
            "teacher",
            "dsrc-alone",
            "teacher",
            1,
            passes=1,
            settings=("ema=0.998", "learning_rate=1e-3"),
            init="teacher-first",
        ),
        *(Training(f"dsrc_s{seed}", "dsrc", "student", seed, teacher="teacher") for seed in SEEDS[:1]),
        *(Training(f"attfuse_s{seed}", "attfuse", "student", seed) for seed in SEEDS[:1]),
        *(Training(f"{method}_s0", method, "student") for method in RIVALS),
        Training("dsrc-max_s0", "dsrc-max", "student", teacher="teacher"),
        Training("dsrc-alone_s0", "dsrc-alone", "student", teacher="teacher"),
        *(Training(f"dsrc_s{seed}", "dsrc", "student", seed, teacher="teacher") for seed in SEEDS[1:]),
        *(Training(f"{m}_s{seed}", m, "student", seed) for m in ("attfuse", STRONGEST) for seed in SEEDS[1:]),
        *(
            Training(f"dsrc-{name}_s0", "dsrc", "student", 0, (setting,), "teacher")
            for name, setting in (
                ("thinned", "augmentation.thinning=0.5"),
                ("corrupted", "augmentation.corruption=0.5"),
            )
        ),
        # Without paint a teacher's clouds are like those of the start, with it like the teacher's: a short way.
        Training("teacher-sdd", "dsrc-alone", "teacher", settings=ablations["sdd"], init=START),
        Training("teacher-pcp", "dsrc-alone", "teacher", settings=ablations["pcp"], init="teacher"),
        *(
            Training(f"{name}_s0", "dsrc", "student", 0, parts, "teacher" if name == "sdd-pcp" else f"teacher-{name}")
            for name, parts in ablations.items()
        ),
    ]


def command(training: Training, options: argparse.Namespace) -> list[str]:
    """Return the command line of a training."""
    out, data = options.out, options.data
    settings = [f"bfloat16={str(options.bfloat16).lower()}", f"workers={options.workers}", *training.settings]
    if training.passes:
        settings.append("validate_every=1")
    else:
        settings += [f"epoch_frames={options.steps * RECIPES[options.recipe]().batch_size}", "learning_rate=1e-3"]
    line = [sys.executable, "-m", "dsrc", "train", options.recipe, "--method", training.method]
    line += ["--stage", training.stage, "--seed", str(training.seed), "--epochs", str(training.passes or 1)]
    line += ["--data", str(data / "train"), "--validate", str(data / "validation"), "--out", str(out / training.name)]
    by_name = {other.name: other for other in campaign()}
    if training.init:
        line += ["--init", str(by_name[training.init].detector(out))]
    if training.teacher:
        line += ["--teacher", str(by_name[training.teacher].detector(out))]
    return [*line, "--set", *settings]


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="folder with train, validation and test")
    parser.add_argument("--out", type=Path, required=True, help="folder of the run folders")
    parser.add_argument("--recipe", default="small", choices=sorted(RECIPES), help="default: small")
    parser.add_argument("--steps", type=int, default=400, help="of each method after the common start; default: 400")
    parser.add_argument("--jobs", type=int, default=2, help="trainings at a time, which share the cores; default: 2")
    parser.add_argument("--workers", type=int, default=0, help="processes that prepare batches, of each training")
    parser.add_argument("--bfloat16", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these, and what they need")
    parser.add_argument("--dry-run", action="store_true", help="print the commands")
    options = parser.parse_args()
    known = [training.name for training in campaign()]
    if unknown := sorted(set(options.only or ()) - set(known)):
        parser.error(f"--only: expected some of {', '.join(known)}, found {', '.join(unknown)}")
    for name, least in (("steps", 1), ("jobs", 1), ("workers", 0)):
        if getattr(options, name) < least:
            parser.error(f"--{name}: expected at least {least}, found {getattr(options, name)}")
    for part in ("train", "validation", "test"):
        if not options.dry_run and not (options.data / part).is_dir():
            parser.error(f"--data: expected a folder {part} in {options.data}, found none")
    wanted = selected(options.only)
    if options.dry_run:
        for training in wanted:
            print(shlex.join(command(training, options)))
        return
    failed = train_all(wanted, options)
    write_atomic(options.out / "trainings.csv", record(options.out))
    if failed:
        sys.exit(f"failed: {', '.join(failed)}; see {options.out}/NAME.log")
    # The tables' file names the runs and the data by where the usage has them.
    usual = (
        options.out.resolve() == Path("runs").resolve() and options.data.resolve() == Path("data/dsrc-sim").resolve()
    )
    if options.recipe == "small" and not options.only and usual:
        measure = ["benchmark", str(TOML), "--out", str(options.out / "benchmark"), "--workers", str(options.jobs)]
        subprocess.run([sys.executable, "-m", "dsrc", *measure], check=True)
    else:
        print(f"now measure: dsrc benchmark {TOML}, with the folders that it names made yours")


def record(out: Path) -> str:
    """Return the trainings that are done as CSV: what their run folders say of how they began and ended."""
    done = [t for t in campaign() if t.detector(out).exists() and (out / t.name / t.stage / "metrics.csv").exists()]
    names = {hash_file(t.detector(out)): t.name for t in done}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = ("name", "method", "stage", "seed", "init", "teacher", "settings", "steps", "minutes")
    writer.writerow([*columns, "val_ap_bev_50", "val_ap_bev_70"])
    for training in done:
        folder = out / training.name / training.stage
        made = json.loads((folder / "settings.json").read_text(encoding="utf-8"))
        init, teacher = (made.get("init") or {}).get("sha256"), made.get("teacher")
        rows = list(csv.DictReader((folder / "metrics.csv").open(encoding="utf-8")))
        minutes = sum(float(row["seconds"]) for row in rows) / 60
        writer.writerow(
            [
                *(training.name, training.method, made["settings"]["stage"], made["seed"]),
                *("" if sha is None else names.get(sha, sha) for sha in (init, teacher)),
                *(" ".join(training.settings), rows[-1]["step"], f"{minutes:.1f}"),
                *(rows[-1].get(f"val/ap_bev_{iou}", "") for iou in (50, 70)),
            ]
        )
    return text.getvalue()


def selected(names: list[str] | None) -> list[Training]:
    """Return the trainings of these names and what they need, in the campaign's order."""
    by_name = {training.name: training for training in campaign()}
    wanted = set(names or by_name)
    while missing := {need for name in wanted for need in by_name[name].needs()} - wanted:
        wanted |= missing
    return [training for name, training in by_name.items() if name in wanted]


def train_all(trainings: list[Training], options: argparse.Namespace) -> list[str]:
    """Run the trainings, as many at a time as asked for; return those that failed."""
    options.out.mkdir(parents=True, exist_ok=True)
    threads = max((os.cpu_count() or 1) // options.jobs, 1) if not torch.cuda.is_available() else None
    environment = os.environ | ({"OMP_NUM_THREADS": str(threads)} if threads else {})
    by_name = {training.name: training for training in trainings}
    waiting = [training for training in trainings if not training.detector(options.out).exists()]
    running: dict[str, subprocess.Popen] = {}
    failed: list[str] = []
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("trainings", total=len(trainings), completed=len(trainings) - len(waiting))
        while waiting or running:
            for name, process in list(running.items()):
                if process.poll() is not None:
                    del running[name]
                    failed += [name] if process.returncode else []
                    progress.advance(task)
            ready = [t for t in waiting if all(by_name[need].detector(options.out).exists() for need in t.needs())]
            for training in ready[: options.jobs - len(running)]:
                waiting.remove(training)
                with (options.out / f"{training.name}.log").open("ab") as log:
                    running[training.name] = subprocess.Popen(
                        command(training, options), stdout=log, stderr=subprocess.STDOUT, env=environment
                    )
            if waiting and not running and not ready:
                return failed + [training.name for training in waiting]
            progress.update(task, description=", ".join(running) or "trainings")
            time.sleep(1.0)
    return failed


if __name__ == "__main__":
    main()
