"""Commands `dsrc detect`, `evaluate`, `benchmark`, `shares` and `score`: what is found, corrupted, and by whom."""

import sys
from pathlib import Path

from dsrc.cli.progress import log_lines, made, progress
from dsrc.cli.toml_files import require_kind
from dsrc.options.detection import BenchmarkOptions, Detection, Device, Engine, Evaluation, Scoring, Sharing, Stressing
from dsrc.options.fields import File, Folder, Output
from dsrc.runs.executors import Pool


class Detect(Detection, frozen=True, kw_only=True):
    """Detect in drives and write the boxes: JSON, and KITTI's or OpenCOOD's form.

    Boxes out of the detector's range are left out, as are those out of the part of the scene in which labels hold, such
    as KITTI's picture.

    Examples:
        dsrc detect data/test --checkpoint detector.pt --out boxes
        dsrc detect data/test --checkpoint my_module:Detector --height auto --format kitti --out boxes
        dsrc detect real --checkpoint detector.pt --height auto --score --out boxes

    Attributes:
        verbose: also say which engine runs the network, and why.
    """

    verbose: bool = False
    pool: Pool = Pool()
    output: Output = Output()

    def run(self) -> None:
        """Detect, write the boxes and say how many there are."""
        from dsrc.evaluation.find import detect_drives
        from sim.files import check_apart

        if self.verbose:
            log_lines("dsrc.models.storage", on_terminals=True)
        check_apart(self.out, self.data)
        if self.score:
            from rich.console import Console

            from dsrc.evaluation.scoring.sources import check_names, score_sources, source_table, write_sources
            from dsrc.evaluation.scoring.write import BOXES

            check_names(self.data)
        with progress(f"detect in {self.data}") as report:
            row, places = detect_drives(self, self.pool, report)
        if self.score:
            with progress("score") as report:
                scores = score_sources(self.out / BOXES, self.data, report)
            write_sources(self.out, scores)
            Console(highlight=False).print(source_table(scores))
        made(places, f"{row.detections} boxes in {row.frames} frames", "view", self.out)


class Evaluate(Evaluation, frozen=True, kw_only=True):
    """Evaluate detectors on drives, clean and corrupted: table, CSV, JSON and plots.

    Examples:
        dsrc evaluate data/test --checkpoint detector.pt --out results
        dsrc evaluate data/test --checkpoint DSRC=a.pt late=b.pt --corruption fog snow --channel its-g5-27 --out results

    Attributes:
        verbose: also say which engine runs the networks, and why.
    """

    verbose: bool = False
    pool: Pool = Pool()
    output: Output = Output()

    def run(self) -> None:
        """Evaluate, write the results and print the table."""
        from rich.console import Console

        from dsrc.evaluation.causes.results import cause_tables
        from dsrc.evaluation.evaluate import evaluate_drives
        from dsrc.evaluation.report.ap_table import result_table
        from dsrc.evaluation.report.choice import choice_table
        from dsrc.evaluation.report.differences import stored_differences
        from dsrc.evaluation.report.lies import lie_table
        from sim.files import check_apart

        if self.verbose:
            log_lines("dsrc.models.storage", on_terminals=True)
        check_apart(self.out, self.data)
        with progress(f"evaluate {self.data}") as report:
            rows = evaluate_drives(self, self.pool, report)
        differences = stored_differences(self.out / "results.json")
        shown = [differences.terminal()] if differences.differences else []
        shown += [table] if (table := lie_table(rows)) else []
        Console(highlight=False).print(result_table(rows), *shown, choice_table(rows), *cause_tables(self.out))
        made(self.out, "results, plots and all detections", "view", self.out)


class Benchmark(BenchmarkOptions, frozen=True, kw_only=True):
    """Compare methods x corruptions x severities x datasets x channels.

    An interrupted benchmark resumes; a new method costs only its own evaluations.

    Examples:
        dsrc benchmark benchmark.toml --out runs/benchmark
        dsrc benchmark --checkpoint DSRC=a.pt late=b.pt --data data/test --agents 1 2 3 --out runs/benchmark

    Attributes:
        out: folder for results, tables, plots and cached evaluations.
        docs: Markdown document that gets the tables too, files beside it: those that it has markers for, or all at its
            end if it has none; default: none.
        partial: leave out missing detector files and list them.
        device: device of the networks.
        engine: execution of the networks: fused layers, the same in half precision for CPUs with AMX, PyTorch's
            compiler, or layer by layer.
        reuse: folders of earlier benchmarks: cells whose settings agree in all but code and package versions are
            taken from them, which is recorded; default: none.
    """

    out: Folder
    docs: File | None = None
    partial: bool = False
    device: Device = "cpu"
    engine: Engine = "fused"
    reuse: tuple[Folder, ...] = ()
    pool: Pool = Pool()
    output: Output = Output()

    def run(self) -> None:
        """Evaluate what is missing, write tables and plots and print the first two tables."""
        from rich.console import Console

        from dsrc.evaluation.config import available, plan_of
        from dsrc.evaluation.report.choice import choice_sheet
        from dsrc.evaluation.report.dataset_results import DatasetResults
        from dsrc.evaluation.report.report import RESULTS, write_report
        from dsrc.evaluation.report.tables import table_1
        from dsrc.evaluation.runner import run_plan
        from dsrc.tables.document import publish
        from sim.files import write_file

        if self.plan is not None:
            require_kind("benchmark", self.plan, "benchmark")
        plan = plan_of(self)
        plan, absent = available(plan) if self.partial else (plan, [])
        with progress(f"benchmark {plan.name}") as report:
            outcome = run_plan(plan, self.out, self.pool, self.device, report, self.engine, self.reuse)
        sections = write_report(outcome, self.out)
        write_file(self.out / "tables.md", "\n".join(section.markdown(Path()) for section in sections))
        for dataset in plan.datasets:
            results = DatasetResults.of(outcome, dataset.name)
            Console(highlight=False).print(table_1(results), choice_sheet(results))
        if absent:
            sys.stdout.write(f"Missing detector files, left out: {', '.join(absent)}.\n")
        places = [self.out / "tables.md"]
        if self.docs is not None:
            publish(sections, self.out, self.docs, plan.name, RESULTS)
            places.insert(0, self.docs)
        made(places, "tables, plots and all detections", "score", self.out)


class StressTest(Stressing, frozen=True, kw_only=True):
    """Tell what breaks a detector: every corruption, severity and group of agents, ranked.

    Examples:
        dsrc stress detector.pt --quick
        dsrc stress my_module:Detector data/test --corruption fog snow --fail-under 0.4 --junit stress.xml

    Attributes:
        fail_under: least AP at a bird's-eye IoU of 0.5, 0 to 1: exit with 1 where a condition is below; default: none.
        junit: JUnit's XML, a test case for each condition; default: none.
        pages: write review pages of the ten worst frames.
    """

    fail_under: float | None = None
    junit: File | None = None
    pages: bool = True
    pool: Pool = Pool()
    output: Output = Output()

    def run(self) -> None:
        """Stress, write and print the tables; exit with 1 where a condition fails."""
        from msgspec.structs import replace
        from rich.console import Console

        from dsrc.cli.demo import SCENARIO, TEST_SEED
        from dsrc.data.write import generate
        from dsrc.evaluation.stress import fails, junit, stress, stress_table, worst_table
        from dsrc.review.page.output.worst import worst_pages
        from sim.files import check_apart, write_file

        config = self
        if self.data is None:
            drive = self.out / "drives" / "demo"
            with progress(f"generate {drive}") as report:
                generate(SCENARIO, drive, frames=12, seed=TEST_SEED, interval_s=1.0, progress=report)
            config = replace(self, data=drive)
        else:
            check_apart(self.out, self.data)
        with progress(f"stress {self.detector}") as report:
            found = stress(config, self.pool, report)
        console = Console(highlight=False)
        console.print(stress_table(found), *([worst_table(found)] if found.worst else []), sep="\n")
        if self.junit is not None:
            write_file(self.junit, junit(found, self.fail_under))
        pages = worst_pages(self.out, found) if self.pages else []
        made([self.out, *pages], "tables, curves and worst frames", "view", self.out)
        if failed := [row for row in found.rows if fails(row, self.fail_under)]:
            sys.stderr.write(f"{len(failed)} of {len(found.rows)} conditions are below AP {self.fail_under:g}\n")
            raise SystemExit(1)


class Shares(Sharing, frozen=True, kw_only=True):
    """Tell which agents helped: the share of each in what is found, and in what is made up.

    Examples:
        dsrc shares data/test --checkpoint detector.pt --corruption fog --out shares
    """

    pool: Pool = Pool()
    output: Output = Output()

    def run(self) -> None:
        """Detect with every team, write the shares and print them by agents and distances."""
        from rich.console import Console

        from dsrc.evaluation.sharing.drives import frames_looked_at, provenance_of, share_drives, stored_drives
        from dsrc.evaluation.sharing.report import share_table, write_shares
        from sim.files import check_apart

        check_apart(self.out, self.data)
        with progress(f"shares {self.data}") as report:
            rows = share_drives(self, self.pool, report)
        write_shares(self.out, rows, frames_looked_at(self), provenance_of(self), stored_drives(self.data))
        Console(highlight=False).print(share_table(rows))
        made(self.out, "shares of the agents", "view", self.out)


class Score(Scoring, frozen=True, kw_only=True):
    """Score boxes of any detector under published protocols of average precision.

    Examples:
        dsrc score results
        dsrc score boxes.json --truth data/test --protocol opencood --out scores

    Attributes:
        out: folder for scores.csv, scores.json, scores.md and scores.png; default: none.
    """

    out: Folder | None = None
    output: Output = Output()

    def run(self) -> None:
        """Score, print the table and write it."""
        from rich.console import Console

        from dsrc.evaluation.metrics.protocols import get_protocols
        from dsrc.evaluation.scoring.report import score_tables, write_scores
        from dsrc.evaluation.scoring.score import provenance_of, score
        from sim.files import check_folder

        get_protocols(self.protocol)  # before the files are read
        if self.out is not None:
            check_folder(self.out)
        with progress(f"score {self.detections}") as report:
            found = score(
                self.detections,
                self.truth,
                self.protocol,
                score_threshold=self.score_threshold,
                corruption=self.corruption,
                progress=report,
            )
        Console(highlight=False).print(*score_tables(found), sep="\n")
        if self.out is not None:
            write_scores(self.out, found, provenance_of(self))
            stored = self.truth is None and self.detections.is_dir()
            made(self.out, "scores", *(("view", self.detections) if stored else ()))
