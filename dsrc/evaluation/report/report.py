"""Report of a benchmark: result files, tables and plots, and the sections of a document with them."""

import csv
import io
import json
import logging
import math
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
from matplotlib.figure import Figure

from dsrc.data.sample import judged_range
from dsrc.evaluation.figures.bars import corruption_bars, difference_map, mean_bars, table_heatmap
from dsrc.evaluation.figures.curves import table_lines
from dsrc.evaluation.figures.points import difference_dots, robustness_scatter, table_dots, traffic_scatter
from dsrc.evaluation.figures.style import Style, png_bytes
from dsrc.evaluation.metrics.robustness import mce, mean_ap
from dsrc.evaluation.report.dataset_results import (
    NAMES,
    DatasetResults,
    averaged_methods,
    compared_methods,
    method_styles,
    trained_methods,
)
from dsrc.evaluation.report.differences import DifferenceTable, difference_table
from dsrc.evaluation.report.document import Section, slug
from dsrc.evaluation.report.paper_tables import corruption_tables
from dsrc.evaluation.report.published import published_tables
from dsrc.evaluation.report.sweep_tables import axes_of, clean_tables
from dsrc.evaluation.results import CLEAN, MCE, MEAN_AP, Row
from dsrc.evaluation.runner import BenchmarkResult, CaseResult, TrainedDetector
from dsrc.evaluation.stored import StoredDrive, StoredIndex, StoredRun, write_index
from dsrc.evaluation.table import ResultTable, Stat
from dsrc.runs.provenance import commit, versions
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
    tables = _difference_tables(result)
    differences = [
        {"dataset": dataset, "family": family, **one.listed()}
        for (dataset, family), table in tables.items()
        for one in table.differences
    ]
    entries = [(entry, result.trained[entry.case.method][entry.case.training]) for entry in result.entries]
    write_results(out, made_by, entries, differences)
    write_index(out, stored_index(result, entries))
    sections = []
    for dataset in result.drives:
        folder = slug(dataset)
        own = {family: table for (name, family), table in tables.items() if name == dataset}
        sections += [section.below(folder) for section in _dataset(result, dataset, own, out / folder, made_by)]
    return sections


def write_results(
    out: Path,
    made_by: Mapping[str, Any],
    entries: Sequence[tuple[CaseResult, TrainedDetector]],
    differences: Sequence[Mapping[str, Any]] = (),
) -> None:
    """Write `results.json`, `results.csv` and `timings.csv`; a warning names former results that they replace.

    Args:
        out: folder.
        made_by: provenance.
        entries: results and their detectors, a row each.
        differences: between methods, JSON types.
    """
    if gone := _methods_of(out / "results.csv") - _methods_in(made_by):
        names = ", ".join(f"{method} on {dataset}" for method, dataset in sorted(gone))
        LOG.warning("%s: replaces the results of %s", out / "results.csv", names)
    listed = [_listed(entry, trained) for entry, trained in entries]
    content = {"provenance": made_by, "rows": listed, "differences": differences}
    text = json.dumps(content, indent=1, sort_keys=True, allow_nan=False)
    write_file(out / "results.json", text + "\n")
    write_file(out / "results.csv", _csv(listed, made_by))
    write_file(out / "timings.csv", _timings([entry for entry, _ in entries]))


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
    """Index of the stored detections of results, named as their rows are.

    Args:
        result: the benchmark.
        entries: results and their detectors.
    """
    # Paths are dict keys for their order.
    places = list(dict.fromkeys((entry.case.dataset, path) for entry, _ in entries for path in entry.drives))
    runs = []
    for entry, one in entries:
        case, condition = entry.case, entry.case.condition
        cells: list[list[str]] = [[] for _ in places]
        for key, path in zip(entry.cells, entry.drives, strict=True):
            cells[places.index((case.dataset, path))].append(key)
        limits = [one.settings.max_agents, one.agents, case.agents]
        run = StoredRun(
            method=case.method,
            training=case.training,
            kind=condition.kind,
            severity=condition.severity,
            family=condition.family,
            who=condition.who,
            channel=case.channel,
            swept=", ".join(f"{name} {getattr(case, name):g}" for name in _SWEPT[1:] if getattr(case, name)),
            detector=one.sha256,
            range_m=judged_range(one.settings),
            agents=min(limit for limit in limits if limit is not None),
            cells=tuple(map(tuple, cells)),
        )
        runs.append(run)
    drives = [
        StoredDrive(dataset=dataset, path=str(path.resolve()), data=result.drives[dataset][path.name])
        for dataset, path in places
    ]
    return StoredIndex(seed=result.plan.seed, drives=tuple(drives), runs=tuple(runs))


def _difference_tables(result: BenchmarkResult) -> dict[tuple[str, Family], DifferenceTable]:
    """Tables of differences by dataset and family; empty without pairs to compare."""
    plan = result.plan
    if not plan.differences:
        return {}
    return {
        (dataset, family): difference_table(DatasetResults.of(result, dataset, family), plan.differences, frames)
        for dataset, frames in result.frames.items()
        for family in plan.families
    }


def provenance_of(result: BenchmarkResult) -> dict[str, Any]:
    """Provenance of a result: settings, hashes of detectors and data, versions, machine and commit."""
    plan = result.plan
    settings = msgspec.to_builtins(plan)
    settings["methods"] = {
        name: [
            {"file": one.path.name, "sha256": one.sha256, "training_seed": one.seed, "use": one.use}
            | ({} if one.agents is None else {"agents": one.agents})
            for one in several
        ]
        for name, several in result.trained.items()
    }
    settings["datasets"] = result.drives
    settings["engine"] = result.engine
    settings["pictures"]["teacher"] = Path(plan.pictures.teacher).name
    return {
        "settings": settings,
        "seed": plan.seed,
        "versions": versions(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "commit": commit(),
    }


def _listed(entry: CaseResult, one: TrainedDetector) -> dict[str, Any]:
    """Fields of a result row, JSON types."""
    case, row = entry.case, entry.row
    fields = {name: getattr(case, name) for name in (*_CASE, *_SWEPT)}
    condition = {"condition": case.condition.kind, "severity": case.condition.severity, "family": case.condition.family}
    numbers = {name: getattr(row, name) for name in _COUNTS}
    sample_note = {"detector": one.sha256, "training_seed": one.seed, "cells": entry.digest}
    metrics = {name: None if math.isnan(value) else value for name, value in row.metrics.items()}
    return {**fields, **condition, **sample_note, **numbers, "metrics": metrics}


def _csv(listed: list[dict[str, Any]], made_by: Mapping[str, Any]) -> str:
    """CSV with a line per row; the first line is a comment (#) with the provenance as JSON."""
    text = io.StringIO()
    text.write(f"# {json.dumps(made_by, sort_keys=True, allow_nan=False)}\n")
    metrics = list(dict.fromkeys(name for row in listed for name in row["metrics"]))
    fields = [name for name in listed[0] if name != "metrics"]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*fields, *metrics])
    for row in listed:
        values = [row[name] for name in fields] + [row["metrics"].get(name) for name in metrics]
        writer.writerow(
            ["" if value is None else repr(value) if isinstance(value, float) else value for value in values]
        )
    return text.getvalue()


def _timings(entries: list[CaseResult]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*_CASE, "condition", "severity", *_SWEPT, "frames", "median_seconds_per_frame"])
    for entry in entries:
        case, seconds = entry.case, entry.row.seconds_per_frame
        if seconds is not None:
            place = [getattr(case, name) for name in _CASE] + [case.condition.kind, case.condition.severity]
            writer.writerow([*place, *(getattr(case, name) for name in _SWEPT), entry.row.frames, f"{seconds:.6f}"])
    return text.getvalue()


def _dataset(
    result: BenchmarkResult,
    dataset: str,
    tables: Mapping[Family, DifferenceTable],
    folder: Path,
    made_by: Mapping[str, Any],
) -> list[Section]:
    """Write tables and plots of a dataset; return their sections.

    Names of the second family of corruptions end in the family; those of clean frames exist once.
    """
    plan, writer = result.plan, _Writer(folder, made_by)
    views = {family: DatasetResults.of(result, dataset, family) for family in plan.families}
    first = views[plan.families[0]]
    styles = method_styles(first)
    for family, results in views.items():
        suffix = "" if results is first else f"_{family}"
        for sheet in corruption_tables(results, plan.severities):
            writer.sheet(sheet, None if isinstance(sheet, str) else _figure_of(sheet, results, result, styles), suffix)
        if family in tables:
            table = tables[family]
            files = {".md": table.markdown(), ".csv": table.csv()}
            name = f"differences{suffix}"
            if len(plan.differences) > 1:
                figure = difference_map(table.differences, table.title)
                writer.section(name, table.summary(), files, figure, table.title, whole=f"{name}.md")
            else:
                figure = difference_dots(table.differences, table.title)
                writer.section(name, table.markdown(), files, figure, table.title)
        if results.kinds():
            four = f"Figure 4. Mean of all methods under each corruption, {results.titled}"
            five = f"Figure 5. mCE against mean AP, {results.titled}"
            means, rows = mean_rows(results, averaged_methods(results)), mean_rows(results, trained_methods(results))
            writer.section(f"figure_4{suffix}", figure=mean_bars(means, title=four), about=four)
            writer.section(f"figure_5{suffix}", figure=robustness_scatter(rows, styles=styles, title=five), about=five)
    for sheet in clean_tables(first, axes_of(result)):
        writer.sheet(sheet, None if isinstance(sheet, str) else _figure_of(sheet, first, result, styles))
    about = f"AP in clean frames against the bytes that are sent, {dataset}"
    writer.section("traffic", figure=traffic_scatter(_traffic(first), styles, about), about=about)
    return writer.sections


class _Writer:
    """Writer of tables and plots into a folder; keeps their sections.

    Args:
        folder: for the files.
        made_by: provenance, for the plots.
    """

    def __init__(self, folder: Path, made_by: Mapping[str, Any]) -> None:
        self.sections: list[Section] = []
        self._folder, self._made_by, self._published = folder, made_by, published_tables()

    def sheet(self, sheet: ResultTable | str, figure: Figure | None, suffix: str = "") -> None:
        """Write a table and its section; a text says why a table is left out.

        Below that of the first family, whose sections have no suffix, is the published table.
        """
        if isinstance(sheet, str):
            name = sheet.split(" is ")[0].lower().replace(" ", "_")
            self.section(f"{name}{suffix}", f"{sheet}\n")
            return
        published = None if suffix else self._published.get(sheet.name)
        beside = f"\n{published.markdown()}" if published else ""
        files = {".md": sheet.markdown(), ".csv": sheet.csv()}
        self.section(f"{sheet.name}{suffix}", f"{sheet.markdown()}{beside}", files, figure, sheet.title)

    def section(
        self,
        name: str,
        text: str = "",
        files: Mapping[str, str] | None = None,
        figure: Figure | None = None,
        about: str = "",
        whole: str = "",
    ) -> None:
        """Write the files of a section, by suffix, and its plot."""
        tables = {f"{name}{ending}": content for ending, content in (files or {}).items()}
        for file, content in tables.items():
            write_file(self._folder / file, content)
        picture = "" if figure is None else f"{name}.png"
        if figure is not None:
            write_file(self._folder / picture, png_bytes(figure, self._made_by))
        self.sections.append(Section(name, text, picture, about if picture else "", tuple(tables), whole))


def _figure_of(
    sheet: ResultTable, results: DatasetResults, result: BenchmarkResult, styles: Mapping[str, Style]
) -> Figure | None:
    """Plot of a table; None for one without lines or without a plot."""
    if not sheet.lines:
        return None
    for axis in axes_of(result):
        if axis.name == sheet.name:
            return table_lines(sheet, axis.label, axis.places, styles)
    if sheet.name == "severity":
        return table_lines(sheet, "severity, 0 for clean", [0, *sorted(result.plan.severities)], styles)
    if sheet.name in ("table_1", "visibility"):
        return table_heatmap(sheet)
    if sheet.name == "table_2":
        return table_dots(sheet)
    if sheet.name in ("table_3", "table_4"):
        fusions = ("max", "attention") if sheet.name == "table_3" else ("none",)
        pairs = [(results.plain(fusion), results.whole(fusion)) for fusion in fusions]
        methods = [name for pair in pairs if None not in pair for name in pair if name]
        return corruption_bars(mean_rows(results, methods), styles=styles, title=sheet.title)
    return None


def mean_rows(results: DatasetResults, methods: list[str]) -> list[Row]:
    """Rows of the mean over a method's trainings: one per condition, and summaries where frames are corrupted."""
    rows = []
    for method in methods:
        first = results.rows(method)[0]

        def row(condition: str, stats: tuple[Stat, ...], method: str = method, first: Row = first) -> Row:
            metrics = {name: stat.mean for name, stat in zip(NAMES, stats, strict=True)}
            return Row(method, condition, 0, first.frames, first.truth, 0, metrics)

        rows += [row(kind, results.ap(results.rows(method, kind))) for kind in (CLEAN, *results.kinds())]
        if results.kinds():
            rows += [row(MEAN_AP, results.summary(method, mean_ap)), row(MCE, results.summary(method, mce))]
    return rows


def _traffic(results: DatasetResults) -> dict[str, tuple[float, float, float]]:
    """KB per frame and AP at IoU 0.5 and 0.7 in clean frames, by method."""
    points = {}
    for method in compared_methods(results):
        rows = results.rows(method)
        sent = sum(row.bytes_per_frame or 0.0 for row in rows) / len(rows)
        low, high = results.ap(rows)
        points[method] = (1e-3 * sent, low.mean, high.mean)
    return points
