"""Report of a benchmark: result files, tables and plots, and the sections of a document with them."""

import json
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from dsrc.evaluation.figures.bars import difference_map, table_heatmap
from dsrc.evaluation.figures.curves import table_lines
from dsrc.evaluation.figures.points import difference_dots, robustness_scatter, traffic_scatter
from dsrc.evaluation.metrics.robustness import mce, mean_ap
from dsrc.evaluation.report.choice import choice_sheet
from dsrc.evaluation.report.dataset_results import NAMES, DatasetResults
from dsrc.evaluation.report.differences import DifferenceTable, difference_table
from dsrc.evaluation.report.lies import lie_table
from dsrc.evaluation.report.tables import axes_of, severity_table, sweep_table, table_1, visibility_table
from dsrc.evaluation.results import CLEAN, MCE, MEAN_AP, Row
from dsrc.evaluation.runner import BenchmarkResult, CaseResult, TrainedDetector
from dsrc.evaluation.stored import StoredDrive, StoredIndex, StoredRun, write_index
from dsrc.runs.provenance import provenance
from dsrc.tables.document import Section, SectionWriter, slug
from dsrc.tables.figure import styles_of
from dsrc.tables.files import Scalar, csv_text, json_text
from dsrc.tables.table import Stat
from sensors.corruptions import Family
from sim.files import write_file

LOG = logging.getLogger(__name__)
_CASE = ("method", "training", "dataset")
_SWEPT = ("channel", "agents", "pose_error", "delay_s", "loss")
RESULTS = ("results.json", "results.csv", "timings.csv")
_COUNTS = ("frames", "truth", "detections", "bytes_per_frame", "message_age_s", "heard")


def write_report(result: BenchmarkResult, out: Path) -> list[Section]:
    """Write `results.json`, `results.csv`, `timings.csv` and, in a folder for each dataset, tables and plots.

    The result files are the same for the same cells; times, which are not, are in `timings.csv` and in Table 1.

    Returns:
        Sections of a document, names and pictures below the folder of their dataset.
    """
    made_by = provenance_of(result)
    tables = difference_tables(result)
    entries = [(entry, result.trained[entry.case.method][entry.case.training]) for entry in result.entries]
    write_results(out, made_by, entries, tables)
    write_index(out, stored_index(result, entries))
    sections = []
    for dataset in result.drives:
        folder = slug(dataset)
        own = {family: table for (name, family), table in tables.items() if name == dataset}
        sections += [section.below(folder) for section in _dataset(result, dataset, own, out / folder, made_by)]
    return sections


def write_results(
    out: Path,
    made_by: Mapping[str, object],
    entries: Sequence[tuple[CaseResult, TrainedDetector]],
    tables: Mapping[tuple[str, Family], DifferenceTable] | None = None,
) -> None:
    """Write `results.json`, `results.csv` and `timings.csv`; a warning names former results that they replace.

    Args:
        entries: results and their detectors, a row each.
        tables: differences between methods by dataset and family, see `difference_tables`.
    """
    differences = [
        {"dataset": dataset, "family": family, **one.listed()}
        for (dataset, family), table in (tables or {}).items()
        for one in table.differences
    ]
    if gone := _methods_of(out / "results.csv") - _methods_in(made_by):
        names = ", ".join(f"{method} on {dataset}" for method, dataset in sorted(gone))
        LOG.warning("%s: replaces the results of %s", out / "results.csv", names)
    listed = [_listed(entry, trained) for entry, trained in entries]
    write_file(out / "results.json", json_text({"provenance": made_by, "rows": listed, "differences": differences}))
    rows = [{**{name: row[name] for name in row if name != "metrics"}, **row["metrics"]} for row in listed]
    write_file(out / "results.csv", csv_text(rows, made_by=made_by))
    write_file(out / "timings.csv", csv_text(list(_timings(entries))))


def _methods_of(path: Path) -> set[tuple[str, str]]:
    """Methods and datasets of a `results.csv`; none where there is no such file."""
    try:
        with path.open(encoding="utf-8") as file:
            return _methods_in(json.loads(file.readline().removeprefix("# ")))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return set()


def _methods_in(made_by: Mapping[str, Any]) -> set[tuple[str, str]]:
    """Methods and datasets of a provenance."""
    settings = made_by["settings"]
    return {(method, dataset) for method in settings["methods"] for dataset in settings["datasets"]}


def stored_index(result: BenchmarkResult, entries: Sequence[tuple[CaseResult, TrainedDetector]]) -> StoredIndex:
    """Index of the stored detections of results, named as their rows are."""
    # Paths are dict keys for their order.
    places = list(dict.fromkeys((entry.case.dataset, path) for entry, _ in entries for path in entry.drives))
    runs = []
    for entry, one in entries:
        case, condition = entry.case, entry.case.condition
        cells: list[list[str]] = [[] for _ in places]
        for key, path in zip(entry.cells, entry.drives, strict=True):
            cells[places.index((case.dataset, path))].append(key)
        request = one.settings.request
        limits = [request.max_agents, one.agents, case.agents]
        run = StoredRun(
            method=case.method,
            training=case.training,
            kind=condition.kind,
            severity=condition.severity,
            family=condition.family,
            who=condition.agents_text,
            channel=case.channel,
            swept=", ".join(f"{name} {getattr(case, name):g}" for name in _SWEPT[1:] if getattr(case, name)),
            detector=one.sha256,
            range_m=request.judged_m,
            agents=min(limit for limit in limits if limit is not None),
            comm_range_m=request.comm_range_m,
            max_agents=request.max_agents,
            team_by=request.team_by,
            cells=tuple(map(tuple, cells)),
        )
        runs.append(run)
    drives = [
        StoredDrive(dataset=dataset, path=str(path.resolve()), data=result.drives[dataset][path.name])
        for dataset, path in places
    ]
    return StoredIndex(seed=result.plan.seed, drives=tuple(drives), runs=tuple(runs))


def difference_tables(result: BenchmarkResult) -> dict[tuple[str, Family], DifferenceTable]:
    """Tables of differences by dataset and family; empty without pairs to compare."""
    plan = result.plan
    if not plan.differences:
        return {}
    return {
        (dataset, family): difference_table(
            DatasetResults.of(result, dataset, family), plan.differences, frames, result.runs[dataset]
        )
        for dataset, frames in result.frames.items()
        for family in plan.family
    }


def provenance_of(result: BenchmarkResult) -> dict[str, Any]:
    """Provenance of a result: settings, hashes of detectors and data, versions, machine and commit."""
    plan = result.plan
    settings = msgspec.to_builtins(plan)
    settings["methods"] = {
        name: [
            {"file": one.name, "sha256": one.sha256, "training_seed": one.seed, "use": one.use}
            | ({} if one.agents is None else {"agents": one.agents})
            for one in several
        ]
        for name, several in result.trained.items()
    }
    settings["datasets"] = result.drives
    settings["engine"] = result.engine
    del settings["pictures"]  # decide nothing here
    return {**provenance(settings, plan.seed), **result.reused}


def _listed(entry: CaseResult, one: TrainedDetector) -> dict[str, Any]:
    """Fields of a result row, JSON types."""
    case, row = entry.case, entry.row
    fields = {name: getattr(case, name) for name in (*_CASE, *_SWEPT)}
    condition = {"condition": case.condition.kind, "severity": case.condition.severity, "family": case.condition.family}
    numbers = {name: getattr(row, name) for name in _COUNTS}
    sample_note = {"detector": one.sha256, "training_seed": one.seed, "cells": entry.digest}
    metrics = {name: None if math.isnan(value) else value for name, value in row.metrics.items()}
    return {**fields, **condition, **sample_note, **numbers, "metrics": metrics}


def _timings(entries: Sequence[tuple[CaseResult, TrainedDetector]]) -> Iterator[dict[str, Scalar]]:
    for entry, _ in entries:
        case, row = entry.case, entry.row
        if row.seconds_per_frame is not None:
            yield {
                **{name: getattr(case, name) for name in _CASE},
                **{"condition": case.condition.kind, "severity": case.condition.severity},
                **{name: getattr(case, name) for name in _SWEPT},
                **{"frames": row.frames, "median_seconds_per_frame": f"{row.seconds_per_frame:.6f}"},
            }


def _dataset(
    result: BenchmarkResult,
    dataset: str,
    tables: Mapping[Family, DifferenceTable],
    folder: Path,
    made_by: Mapping[str, object],
) -> list[Section]:
    """Write tables and plots of a dataset; return their sections.

    Names of the second family of corruptions end in the family; those of clean frames exist once.
    """
    plan, writer = result.plan, SectionWriter(folder, made_by)
    views = {family: DatasetResults.of(result, dataset, family) for family in plan.family}
    first = views[plan.family[0]]
    styles = styles_of(list(first.trained))
    # Variants in use have another's weights and almost its place in a figure.
    trained = [name for name, several in first.trained.items() if not several[0].use]
    for family, results in views.items():
        suffix = "" if results is first else f"_{family}"
        sheet = table_1(results)
        writer.table(sheet, table_heatmap(sheet), suffix)
        writer.table(table_1(results, opencood=True), suffix=suffix)
        if len(plan.severity) > 1 and results.corruptions():
            sheet = severity_table(results, sorted(plan.severity))
            places = [0, *sorted(plan.severity)]
            writer.table(sheet, table_lines(sheet, "severity, 0 for clean", places, styles), suffix)
        if family in tables:
            _write_differences(writer, tables[family], f"differences{suffix}", one_pair=len(plan.differences) == 1)
        if results.corruptions():
            title = f"mCE against mean AP, {results.titled}"
            writer.figure(f"figure_5{suffix}", robustness_scatter(mean_rows(results, trained), styles, title), title)
    writer.table(choice_sheet(first))
    told = [row for name in first.trained for kind in (CLEAN, *first.kinds()) for row in first.rows(name, kind)[:1]]
    if (sheet_of_lies := lie_table(told, f"Attacks and defences, {dataset}")) is not None:
        writer.table(sheet_of_lies)
    if (sheet_of_sight := visibility_table(first)) is not None:
        writer.table(sheet_of_sight, table_heatmap(sheet_of_sight))
    for axis in axes_of(result):
        sheet = sweep_table(first, axis)
        writer.table(sheet, table_lines(sheet, axis.label, axis.places, styles) if sheet.rows else None)
    about = f"AP in clean frames against the bytes that are sent, {dataset}"
    writer.figure("traffic", traffic_scatter(_traffic(first), styles, about), about)
    return writer.sections


def _write_differences(writer: SectionWriter, table: DifferenceTable, name: str, *, one_pair: bool) -> None:
    """Write the differences of a family; of several pairs the document gets the summary and a link to the table."""
    files = {f"{name}.md": table.markdown(), f"{name}.csv": table.csv()}
    if one_pair:
        writer.section(name, table.markdown(), files, difference_dots(table.differences, table.title), table.title)
    else:
        figure = difference_map(table.differences, table.title)
        writer.section(name, table.summary(), files, figure, table.title, whole=f"{name}.md")


def mean_rows(results: DatasetResults, methods: Sequence[str]) -> list[Row]:
    """Rows of the mean over a method's trainings: one per condition, and summaries where frames are corrupted."""
    rows = []
    for method in methods:
        first = results.rows(method)[0]

        def row(condition: str, stats: tuple[Stat, ...], method: str = method, first: Row = first) -> Row:
            metrics = {name: stat.mean for name, stat in zip(NAMES, stats, strict=True)}
            return Row(method, condition, 0, first.frames, first.truth, 0, metrics)

        rows += [row(kind, results.ap(results.rows(method, kind))) for kind in (CLEAN, *results.kinds())]
        if results.corruptions():
            rows += [row(MEAN_AP, results.summary(method, mean_ap)), row(MCE, results.summary(method, mce))]
    return rows


def _traffic(results: DatasetResults) -> dict[str, tuple[float, float, float]]:
    """KB per frame and AP at IoU 0.5 and 0.7 in clean frames, by method."""
    points = {}
    for method in results.trained:
        rows = results.rows(method)
        sent = sum(row.bytes_per_frame or 0.0 for row in rows) / len(rows)
        low, high = results.ap(rows)
        points[method] = (1e-3 * sent, low.mean, high.mean)
    return points
