"""Evaluation of detectors on one dataset, `dsrc evaluate`: a small benchmark with a table of its own."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from msgspec.structs import replace as replace_fields

from dsrc.data.drives import open_drives
from dsrc.detectors.levelled import height_in_use
from dsrc.detectors.texts import named
from dsrc.evaluation.cache import read_cell
from dsrc.evaluation.causes.results import write_causes
from dsrc.evaluation.config import (
    Benchmark,
    DatasetSpec,
    DifferenceSpec,
    MethodSpec,
    check,
    check_messages,
    single_defence,
)
from dsrc.evaluation.detect import join_results
from dsrc.evaluation.figures.bars import corruption_bars
from dsrc.evaluation.figures.curves import precision_recall_curves, reliability_curves
from dsrc.evaluation.figures.points import robustness_scatter
from dsrc.evaluation.metrics.ap import evaluate_matches
from dsrc.evaluation.report.report import difference_tables, provenance_of, stored_index, write_results
from dsrc.evaluation.results import CLEAN, Row, summary_rows
from dsrc.evaluation.runner import BenchmarkResult, CaseResult, TrainedDetector, fitting_kinds, run_plan
from dsrc.evaluation.stored import write_index
from dsrc.options.detection import Evaluation
from dsrc.options.fields import takes_fields
from dsrc.options.told import NO_DEFENCE
from dsrc.runs.executors import SERIAL, Pool, Progress
from dsrc.tables.figure import write_figure
from sim.errors import SettingsError, complaint
from sim.radio import IDEAL

EGO_ALONE = "ego alone"


@takes_fields(Evaluation)
def evaluate_drives(config: Evaluation, pool: Pool = SERIAL, progress: Progress | None = None) -> list[Row]:
    """Evaluate detectors, write results, plots and the index of detections; resume what is cached.

    The files are `results.csv`, `results.json`, `causes.csv`, `timings.csv`, `detections.json` and PNGs; `mce_map.png`
    needs a corruption.

    The results and plots are the same for the same settings; times are in `timings.csv` alone.

    Args:
        config: see `Evaluation`.
        pool: workers, of one thread each; scripts with several guard their code by `if __name__ == "__main__":`.
        progress: called with detections done and detections to do.

    Returns:
        Rows by condition and method, then the `mean_ap` and `mce` row of each method; see
        `dsrc.evaluation.report.ap_table.result_table`.

    Raises:
        UserError: a file, a drive or a setting is wrong.
    """
    plan, channels = plan_of_evaluation(config), bool(config.radios(config.channel))
    result = run_plan(plan, config.out, pool, config.device, progress, config.engine, config.reuse)
    made_by = provenance_of(result)
    entries = list(_labelled(result, channels))
    rows = [_with_curves(entry, config.out / "cells", channels) for entry, _ in entries]
    summaries = summary_rows(rows)
    write_results(config.out, made_by, [*entries, *_summary_entries(entries, summaries)], difference_tables(result))
    write_index(config.out, stored_index(result, entries))
    write_causes(config.out, made_by, entries, config.seed)
    rows += summaries
    figures = {
        "ap_per_corruption": corruption_bars(rows),
        "precision_recall": precision_recall_curves(rows),
        "reliability": reliability_curves(rows),
    }
    if summaries:
        figures["mce_map"] = robustness_scatter(rows)
    else:
        (config.out / "mce_map.png").unlink(missing_ok=True)  # of an evaluation here before
    for name, figure in figures.items():
        write_figure(config.out / f"{name}.png", figure, made_by)
    return rows


def plan_of_evaluation(config: Evaluation) -> Benchmark:
    """Benchmark of one dataset with the settings of an evaluation.

    Raises:
        SettingsError: a name repeats or is unknown, or a number is out of its range.
    """
    if not config.checkpoint:
        raise SettingsError(complaint("evaluate", "checkpoint", "at least one detector", "none"))
    files: dict[str, str] = {}
    for name, path in named(config.checkpoint):
        if name in files:
            found = f"{name} for {path} too"
            raise SettingsError(
                complaint("evaluate", "checkpoint", "names that differ", found, "; give names: name=path")
            )
        files[name] = path
    for text in config.messages:
        check_messages(text, "evaluate")
    for text in config.defence:
        single_defence(text, "evaluate")
    use = height_in_use("evaluate", config.height)
    if config.drop_lone_points:
        use["drop_lone_points"] = True
    methods = [MethodSpec(name=name, detectors=(path,), use=use) for name, path in files.items()]
    first, *others = files
    messages = [
        MethodSpec(name=f"{first}, {kind}", detectors=(files[first],), use={**use, "messages": kind})
        for kind in config.messages
    ]
    defended = [
        replace_fields(one, name=f"{one.name}, {text}", use={**one.use, "defence": text})
        for one in messages or methods
        for text in config.defence
        if text != NO_DEFENCE
    ]
    methods += [*messages, *defended]
    drives = open_drives(config.data)
    if config.ego_alone and any(len(drive.agents) > 1 for drive in drives):
        methods.append(MethodSpec(name=f"{first}, {EGO_ALONE}", detectors=(files[first],), use=use, agents=1))
    plan = Benchmark(
        name="evaluate",
        methods=tuple(methods),
        datasets=(DatasetSpec(name=config.data.name or "data", drives=(str(config.data),)),),
        corruption=fitting_kinds("evaluate", config.corruption, config.family, drives) or (CLEAN,),
        severity=(config.severity,),
        family=(config.family,),
        corrupted_agents=config.corrupted_agents,
        channel=config.radios(config.channel) or (IDEAL,),
        fault=config.fault,
        seed=config.seed,
        frames=config.frames,
        differences=tuple(DifferenceSpec(method=first, baseline=other) for other in others),
    )
    check(plan, "evaluate")
    return plan


def _labelled(result: BenchmarkResult, channels: bool) -> Iterator[tuple[CaseResult, TrainedDetector]]:
    """Yield results and detectors by condition and method, named by method and channel; the ego alone needs none."""
    conditions = list(dict.fromkeys(entry.case.condition for entry in result.entries))
    alone = {method.name for method in result.plan.methods if method.agents == 1}

    def place(entry: CaseResult) -> tuple[int, bool]:
        return conditions.index(entry.case.condition), entry.case.method in alone

    for entry in sorted(result.entries, key=place):
        case = entry.case
        if case.method in alone and case.channel != result.plan.channel[0]:
            continue
        label = f"{case.method}, {case.channel}" if channels and case.method not in alone else case.method
        labelled = replace(entry, case=replace(case, method=label), row=replace(entry.row, method=label))
        yield labelled, result.trained[case.method][case.training]


def _with_curves(entry: CaseResult, folder: Path, channels: bool) -> Row:
    """Row of a result for tables and plots: with curves for clean frames, without ages of messages that none delays."""
    row = entry.row
    if not channels or row.method.endswith(f", {EGO_ALONE}"):
        row = replace(row, message_age_s=None, heard=None)
    if row.condition != CLEAN:
        return row
    return replace(row, result=evaluate_matches(join_results([read_cell(folder, key) for key in entry.cells]).matches))


def _summary_entries(
    entries: Sequence[tuple[CaseResult, TrainedDetector]], summaries: Sequence[Row]
) -> Iterator[tuple[CaseResult, TrainedDetector]]:
    """Yield `mean_ap` and `mce` as results of their own, of all cells of their method."""
    for row in summaries:
        own = [pair for pair in entries if pair[0].case.method == row.method]
        clean, trained = own[0]
        condition = replace(clean.case.condition, kind=row.condition)
        cells = tuple(key for entry, _ in own for key in entry.cells)
        drives = tuple(path for entry, _ in own for path in entry.drives)
        yield CaseResult(replace(clean.case, condition=condition), row, cells, drives), trained
