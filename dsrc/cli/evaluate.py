"""Commands `dsrc evaluate` and `dsrc benchmark`: average precision, clean and corrupted."""

import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from tyro.conf import Positional, arg

from dsrc.cli.options import CHANNELS, CORRUPTIONS, Data, Family, File, Folder, Severity, choice
from dsrc.cli.progress import progress
from dsrc.data.executors import SERIAL, Pool

Device = Literal["cpu", "cuda"]
Engine = Literal["fused", "bf16", "compiled", "plain"]
Checkpoints = Annotated[tuple[str, ...], arg(metavar="[NAME=]FILE [...]")]
Kinds = Annotated[tuple[str, ...], choice(("clean", "paper_six", "all", *CORRUPTIONS), several=True)]


class Evaluate(msgspec.Struct, frozen=True, kw_only=True):
    """Evaluate detectors on drives, clean and corrupted: table, CSV, JSON and plots.

    Attributes:
        data: a drive, or a folder of drives.
        checkpoint: detector files; NAME=FILE names a row.
        out: folder of results.csv, results.json, plots and cached cells; an interrupted evaluation resumes.
        corruption: kinds of corruption; paper_six are those of the paper's tables.
        seed: seed of corruptions and channels.
        frames: frames to evaluate, evenly spread; default: all.
        ego_alone: also evaluate the first detector without collaborators.
        channel: radio channels; default: no loss, no delay and no byte counts.
        engine: execution of the networks: fused layers, the same in half precision for CPUs with AMX, PyTorch's
            compiler, or layer by layer.
        device: device of the networks.
    """

    data: Data
    checkpoint: Checkpoints
    out: Folder
    corruption: Kinds = ("paper_six",)
    level: Severity = Severity()
    seed: int = 0
    frames: int | None = None
    ego_alone: bool = True
    channel: Annotated[tuple[str, ...], choice(CHANNELS, several=True)] = ()
    engine: Engine = "fused"
    device: Device = "cpu"
    pool: Pool = Pool()

    def run(self) -> None:
        """Evaluate, write the results and print the table."""
        from rich.console import Console

        from dsrc.evaluation.evaluate import Evaluation, evaluate_drives
        from dsrc.evaluation.report.ap_table import result_table

        config = Evaluation(
            checkpoints=self.checkpoint,
            data=self.data,
            out=self.out,
            corruptions=self.corruption,
            severity=self.level.severity,
            family=self.level.family,
            seed=self.seed,
            limit=self.frames,
            ego_alone=self.ego_alone,
            channels=self.channel,
            engine=self.engine,
            device=self.device,
        )
        with progress(f"evaluate {self.data}") as report:
            rows = evaluate_drives(config, self.pool, report)
        Console(highlight=False).print(result_table(rows))
        sys.stdout.write(f"{self.out}\n")


class Benchmark(msgspec.Struct, frozen=True, kw_only=True):
    """Compare methods x corruptions x severities x datasets x channels, as in the paper's tables.

    An interrupted benchmark resumes; a new method costs only its own evaluations.

    Attributes:
        plan: TOML of the benchmark, in place of the options that describe one; default: the options.
        checkpoint: detector files; NAME=FILE names a method, several files of one NAME are its trainings;
            default: none.
        data: folders of drives, a dataset each; NAME=FOLDER names one; default: none.
        out: folder for results, tables, plots and cached evaluations.
        corruption: kinds of corruption; paper_six are those of the paper's tables; default: paper_six.
        severity: severities of each corruption, 1 to 5; default: 3.
        family: models of the corruptions: of physical causes, or as published in papers; default: physical.
        channel: radio channels; default: ideal.
        agents: numbers of agents to compare, such as 1 2 3 4 5; default: none.
        pose_error: pose errors of the collaborators to compare, m and deg, such as 0.2 0.4; default: none.
        delay_s: delays to compare, s; default: none.
        loss: packet loss rates to compare; default: none.
        frames: frames of each dataset to evaluate, evenly spread; default: all.
        seed: seed of corruptions and channels; default: 0.
        docs: Markdown document that gets the tables too, between its markers or at its end, files beside it;
            default: none.
        partial: leave out missing detector files and list them.
        device: device of the networks.
        engine: execution of the networks: fused layers, the same in half precision for CPUs with AMX, PyTorch's
            compiler, or layer by layer.
    """

    plan: Positional[File | None] = None
    checkpoint: Checkpoints = ()
    data: Annotated[tuple[str, ...], arg(metavar="[NAME=]FOLDER [...]")] = ()
    out: Folder
    corruption: Kinds | None = None
    severity: tuple[int, ...] | None = None
    family: Family | None = None
    channel: Annotated[tuple[str, ...] | None, choice(CHANNELS, several=True)] = None
    agents: tuple[int, ...] | None = None
    pose_error: tuple[float, ...] | None = None
    delay_s: tuple[float, ...] | None = None
    loss: tuple[float, ...] | None = None
    frames: int | None = None
    seed: int | None = None
    docs: File | None = None
    partial: bool = False
    device: Device = "cpu"
    engine: Engine = "fused"
    pool: Pool = SERIAL

    def run(self) -> None:
        """Evaluate what is missing, write tables and plots and print Table 1."""
        from rich.console import Console

        from dsrc.evaluation.config import available, plan_of
        from dsrc.evaluation.report.paper_tables import DatasetResults, table_1
        from dsrc.evaluation.report.pictures import check_pictures, write_pictures
        from dsrc.evaluation.report.report import publish, write_report
        from dsrc.evaluation.runner import run_plan
        from sim.files import write_file

        flags: dict[str, Any] = {"corruptions": self.corruption, "severities": self.severity, "family": self.family}
        flags |= {"channels": self.channel, "limit": self.frames, "seed": self.seed}
        sweeps = {"agents": self.agents, "pose_error": self.pose_error, "delay_s": self.delay_s, "loss": self.loss}
        if self.plan is not None:
            self._check_alone({"checkpoint": self.checkpoint or None, **flags, **sweeps})
        plan = plan_of(self.checkpoint if self.plan is None else [str(self.plan)], self.data, flags, sweeps)
        plan, absent = available(plan) if self.partial else (plan, [])
        check_pictures(plan)
        with progress(f"benchmark {plan.name}") as report:
            outcome = run_plan(plan, self.out, self.pool, self.device, report, self.engine)
        sections = [*write_report(outcome, self.out), *write_pictures(outcome, self.out)]
        write_file(self.out / "tables.md", "\n".join(section.markdown(Path()) for section in sections))
        console = Console(highlight=False)
        for dataset in plan.datasets:
            sheet = table_1(DatasetResults.of(outcome, dataset.name))
            console.print(sheet.terminal(len(sheet.columns) - 2, console.width))  # bytes and times are in the files
        for section in sections:
            if not section.picture and "left out: " in section.text:
                sys.stdout.write(f"{section.text.strip()}\n")
        if absent:
            sys.stdout.write(f"Missing detector files, left out: {', '.join(absent)}.\n")
        if self.docs is not None:
            publish(sections, self.out, self.docs, plan.name)
            sys.stdout.write(f"{self.docs}\n")
        sys.stdout.write(f"{self.out / 'tables.md'}\n")

    def _check_alone(self, options: dict[str, Any]) -> None:
        """Raise SettingsError where the plan is no TOML, or options describe the benchmark beside it."""
        from sim.errors import SettingsError, complaint

        if self.plan is not None and self.plan.suffix != ".toml":
            hint = "; detector files go after --checkpoint"
            raise SettingsError(complaint("benchmark", "plan", "a .toml", str(self.plan), hint))
        names = {"corruptions": "corruption", "severities": "severity", "channels": "channel", "limit": "frames"}
        for name, value in options.items():
            if value is not None:
                expected = f"nothing: {self.plan} describes the benchmark"
                raise SettingsError(complaint("benchmark", names.get(name, name), expected, "a value"))
