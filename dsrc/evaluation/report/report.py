"""What a benchmark writes: result files, tables and plots, and the blocks of a document that hold them."""

import csv
import io
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
from matplotlib.figure import Figure

from dsrc.data.provenance import commit, versions
from dsrc.evaluation.metrics.robustness import mce, mean_ap
from dsrc.evaluation.plots import (
    Look,
    bars_of_sheet,
    corruption_bars,
    difference_dots,
    lines_of_sheet,
    looks_of,
    map_of_sheet,
    mean_bars,
    png_bytes,
    robustness_scatter,
    traffic_scatter,
)
from dsrc.evaluation.report.differences import DifferenceTable, difference_table
from dsrc.evaluation.report.paper_tables import (
    NAMES,
    View,
    averaged,
    axes_of,
    clean_sheets,
    compared,
    corruption_sheets,
)
from dsrc.evaluation.report.published import paper_sheets
from dsrc.evaluation.results import CLEAN, MCE, MEAN_AP, Row
from dsrc.evaluation.runner import Entry, Outcome
from dsrc.evaluation.table import Sheet, Stat
from sensors.corruptions import Family
from sim.errors import DataError, complaint
from sim.files import write_file

_CASE = ("method", "training", "dataset")
_SWEPT = ("channel", "agents", "pose_error", "delay_s", "loss")
_RESULTS = ("results.json", "results.csv", "timings.csv")
_COUNTS = ("frames", "truth", "detections", "bytes_per_frame", "message_age_s", "heard")


@dataclass(frozen=True, slots=True)
class Block:
    """A part of a document: text, and a picture's name and what it shows; either may be missing.

    Attributes:
        name: of its place in the document.
        text: Markdown.
        picture: file beside the table; "" for none.
        about: what the picture shows.
        tables: files with the text's numbers.
    """

    name: str
    text: str = ""
    picture: str = ""
    about: str = ""
    tables: tuple[str, ...] = ()

    @property
    def files(self) -> tuple[str, ...]:
        """What was written for the block."""
        return (*self.tables, self.picture) if self.picture else self.tables

    def below(self, folder: str) -> "Block":
        """Return the block with its name and its files in a folder."""
        picture = f"{folder}/{self.picture}" if self.picture else ""
        tables = tuple(f"{folder}/{table}" for table in self.tables)
        return replace(self, name=f"{folder}/{self.name}", picture=picture, tables=tables)

    def markdown(self, pictures: Path) -> str:
        """Return the text with the picture, which lies below the folder `pictures`."""
        picture = f"\n![{self.about}]({(pictures / self.picture).as_posix()})\n" if self.picture else ""
        return f"{self.text}{picture}"


def write_report(outcome: Outcome, out: Path) -> list[Block]:
    """Write `results.json`, `results.csv`, `timings.csv` and, in a folder for each dataset, tables and plots.

    The result files are the same for the same cells; times, which are not, are in `timings.csv` and in Table 1.

    Returns:
        The blocks for a document, names and pictures below the folder of their dataset.
    """
    made_by = provenance_of(outcome)
    listed = [_listed(entry, outcome) for entry in outcome.entries]
    tables = _difference_tables(outcome)
    differences = [
        {"dataset": dataset, "family": family, **one.listed()}
        for (dataset, family), table in tables.items()
        for one in table.differences
    ]
    result = {"provenance": made_by, "rows": listed, "differences": differences}
    text = json.dumps(result, indent=1, sort_keys=True, allow_nan=False)
    write_file(out / "results.json", text + "\n")
    write_file(out / "results.csv", _csv(listed, made_by))
    write_file(out / "timings.csv", _timings(outcome.entries))
    blocks = []
    for dataset in outcome.drives:
        folder = slug(dataset)
        own = {family: table for (name, family), table in tables.items() if name == dataset}
        blocks += [block.below(folder) for block in _dataset(outcome, dataset, own, out / folder, made_by)]
    return blocks


def _difference_tables(outcome: Outcome) -> dict[tuple[str, Family], DifferenceTable]:
    """Return by dataset and family the differences; none where no pair is asked for."""
    plan = outcome.plan
    if not plan.differences:
        return {}
    return {
        (dataset, family): difference_table(View.of(outcome, dataset, family), plan.differences, frames)
        for dataset, frames in outcome.frames.items()
        for family in plan.families
    }


def provenance_of(outcome: Outcome) -> dict[str, Any]:
    """Return what made a result: the plan, files by their hashes, versions, code and data."""
    plan = outcome.plan
    settings = msgspec.to_builtins(plan)
    settings["methods"] = {
        name: [
            {"file": one.path.name, "sha256": one.sha256, "training_seed": one.seed, "use": one.use} for one in several
        ]
        for name, several in outcome.trained.items()
    }
    settings["datasets"] = outcome.drives
    settings["pictures"]["teacher"] = Path(plan.pictures.teacher).name
    return {"settings": settings, "seed": plan.seed, "versions": versions(), "commit": commit()}


def slug(name: str) -> str:
    """Return a name as it is in paths."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-") or "dataset"


def _listed(entry: Entry, outcome: Outcome) -> dict[str, Any]:
    """Return everything about a row as JSON's types."""
    case, row = entry.case, entry.row
    one = outcome.trained[case.method][case.training]
    fields = {name: getattr(case, name) for name in (*_CASE, *_SWEPT)}
    condition = {"condition": case.condition.kind, "severity": case.condition.severity, "family": case.condition.family}
    numbers = {name: getattr(row, name) for name in _COUNTS}
    made_of = {"detector": one.sha256, "training_seed": one.seed, "cells": entry.digest}
    metrics = {name: None if math.isnan(value) else value for name, value in row.metrics.items()}
    return {**fields, **condition, **made_of, **numbers, "metrics": metrics}


def _csv(listed: list[dict[str, Any]], made_by: Mapping[str, Any]) -> str:
    """Return CSV with one line per row; its first line is a comment (#) that holds the provenance as JSON."""
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


def _timings(entries: list[Entry]) -> str:
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
    outcome: Outcome,
    dataset: str,
    tables: Mapping[Family, DifferenceTable],
    folder: Path,
    made_by: Mapping[str, Any],
) -> list[Block]:
    """Write tables and plots of a dataset; return its blocks, pictures by the names of their files.

    Those of the second family of corruptions have its name behind theirs; those of clean frames are there once.
    """
    plan, writer = outcome.plan, _Writer(folder, made_by)
    views = {family: View.of(outcome, dataset, family) for family in plan.families}
    first = views[plan.families[0]]
    looks = looks_of([*plan.sweeps.methods, *first.trained])  # curves lie closest, so theirs differ most
    for family, view in views.items():
        suffix = "" if view is first else f"_{family}"
        for sheet in corruption_sheets(view, plan.severities):
            writer.sheet(sheet, None if isinstance(sheet, str) else _figure_of(sheet, view, outcome, looks), suffix)
        if family in tables:
            table = tables[family]
            figure = difference_dots(table.differences, table.title)
            files = {".md": table.markdown(), ".csv": table.csv()}
            writer.block(f"differences{suffix}", table.markdown(), files, figure, table.title)
        if view.kinds():
            four = f"Figure 4. Mean of all methods under each corruption, {view.titled}"
            five = f"Figure 5. mCE against mean AP, {view.titled}"
            means, rows = mean_rows(view, averaged(view)), mean_rows(view, compared(view))
            writer.block(f"figure_4{suffix}", figure=mean_bars(means, title=four), about=four)
            writer.block(f"figure_5{suffix}", figure=robustness_scatter(rows, looks=looks, title=five), about=five)
    for sheet in clean_sheets(first, axes_of(outcome)):
        writer.sheet(sheet, None if isinstance(sheet, str) else _figure_of(sheet, first, outcome, looks))
    about = f"AP in clean frames against the bytes that are sent, {dataset}"
    writer.block("traffic", figure=traffic_scatter(_traffic(first), looks, about), about=about)
    return writer.blocks


class _Writer:
    """Writes tables and plots into a folder and keeps the blocks that show them.

    Args:
        folder: for the files.
        made_by: provenance, for the plots.
    """

    def __init__(self, folder: Path, made_by: Mapping[str, Any]) -> None:
        self.blocks: list[Block] = []
        self._folder, self._made_by, self._published = folder, made_by, paper_sheets()

    def sheet(self, sheet: Sheet | str, figure: Figure | None, suffix: str = "") -> None:
        """Write a table, with the paper's below it in its block; of one that is left out the line that says so."""
        if isinstance(sheet, str):
            name = sheet.split(" is ")[0].lower().replace(" ", "_")
            self.block(f"{name}{suffix}", f"{sheet}\n")
            return
        beside = f"\n{self._published[sheet.name].markdown()}" if sheet.name in self._published else ""
        files = {".md": sheet.markdown(), ".csv": sheet.csv()}
        self.block(f"{sheet.name}{suffix}", f"{sheet.markdown()}{beside}", files, figure, sheet.title)

    def block(
        self,
        name: str,
        text: str = "",
        files: Mapping[str, str] | None = None,
        figure: Figure | None = None,
        about: str = "",
    ) -> None:
        """Write the files of a block, by their endings, and its plot."""
        tables = {f"{name}{ending}": content for ending, content in (files or {}).items()}
        for file, content in tables.items():
            write_file(self._folder / file, content)
        picture = "" if figure is None else f"{name}.png"
        if figure is not None:
            write_file(self._folder / picture, png_bytes(figure, self._made_by))
        self.blocks.append(Block(name, text, picture, about if picture else "", tuple(tables)))


def _figure_of(sheet: Sheet, view: View, outcome: Outcome, looks: Mapping[str, Look]) -> Figure | None:
    """Return the plot of a sheet; none of one without lines, or that has no plot."""
    if not sheet.lines:
        return None
    for axis in axes_of(outcome):
        if axis.name == sheet.name:
            return lines_of_sheet(sheet, axis.label, axis.places, looks)
    if sheet.name == "severity":
        return lines_of_sheet(sheet, "severity, 0 for clean", [0, *sorted(outcome.plan.severities)], looks)
    if sheet.name in ("table_1", "visibility"):
        return map_of_sheet(sheet)
    if sheet.name == "table_2":
        return bars_of_sheet(sheet)
    if sheet.name in ("table_3", "table_4"):
        fusions = ("max", "attention") if sheet.name == "table_3" else ("none",)
        pairs = [(view.plain(fusion), view.whole(fusion)) for fusion in fusions]
        methods = [name for pair in pairs if None not in pair for name in pair if name]
        return corruption_bars(mean_rows(view, methods), looks=looks, title=sheet.title)
    return None


def mean_rows(view: View, methods: list[str]) -> list[Row]:
    """Return the mean over the trainings of methods: a row per condition, and the summaries where there are any."""
    rows = []
    for method in methods:
        first = view.rows(method)[0]

        def row(condition: str, stats: tuple[Stat, ...], method: str = method, first: Row = first) -> Row:
            metrics = {name: stat.mean for name, stat in zip(NAMES, stats, strict=True)}
            return Row(method, condition, 0, first.frames, first.truth, 0, metrics)

        rows += [row(kind, view.ap(view.rows(method, kind))) for kind in (CLEAN, *view.kinds())]
        if view.kinds():
            rows += [row(MEAN_AP, view.summary(method, mean_ap)), row(MCE, view.summary(method, mce))]
    return rows


def _traffic(view: View) -> dict[str, tuple[float, float, float]]:
    """Return by method kB per frame and AP in clean frames."""
    points = {}
    for method in compared(view):
        rows = view.rows(method)
        sent = sum(row.bytes_per_frame or 0.0 for row in rows) / len(rows)
        low, high = view.ap(rows)
        points[method] = (1e-3 * sent, low.mean, high.mean)
    return points


def publish(blocks: list[Block], out: Path, document: Path, name: str) -> Path:
    """Put the blocks between their markers in a document, and the files that it needs beside it in a folder `name`.

    A block `x/y` goes between the lines `<!-- begin NAME/x/y -->` and `<!-- end NAME/x/y -->`; without them it is
    added at the end. What stands elsewhere is left as it is. `out` may be that folder.

    Returns:
        The folder with result files, tables and pictures; cells stay where they are.

    Raises:
        DataError: a marker has begun and does not end.
    """
    folder = document.parent / document.stem / slug(name)
    for file in (*_RESULTS, *(path for block in blocks for path in block.files)):
        write_file(folder / file, (out / file).read_bytes())
    text = document.read_text(encoding="utf-8") if document.is_file() else f"# {document.stem.capitalize()}\n"
    for block in blocks:
        begin, end = (f"<!-- {word} {slug(name)}/{block.name} -->" for word in ("begin", "end"))
        content = f"{begin}\n{block.markdown(folder.relative_to(document.parent))}\n{end}"
        if begin not in text:
            text = f"{text.rstrip()}\n\n{content}\n"
            continue
        before, _, rest = text.partition(begin)
        _, ended, after = rest.partition(end)
        if not ended:
            raise DataError(complaint(document, begin, f"a line {end} behind it", "none"))
        text = f"{before}{content}{after}"
    write_file(document, text)
    return folder
