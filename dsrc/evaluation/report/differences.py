"""Differences between pairs of methods, with intervals by frame and by drive."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dsrc.evaluation.config import DifferenceSpec
from dsrc.evaluation.metrics.intervals import (
    IOUS,
    LEVEL,
    RESAMPLES,
    Difference,
    Interval,
    draw_weights,
    percentile_interval,
    resampled_ap,
)
from dsrc.evaluation.report.dataset_results import DatasetResults
from dsrc.evaluation.report.notes import sample_note
from dsrc.evaluation.results import CLEAN, MCE, MEAN_CORRUPTED, condition_title
from dsrc.tables.files import csv_text
from dsrc.tables.table import Column, Stat, Strong, Table, TableRow

SEED = 0
"""Seed of the resamples: the same rows have the same intervals."""

_Metrics = dict[str, NDArray[np.float64]]
"""(S, T, R) AP, or mCE, of each training at each IoU threshold in each resample, by condition."""


@dataclass(frozen=True, slots=True)
class DifferenceTable:
    """Table of differences in a dataset under one family of corruptions.

    Attributes:
        title: one line.
        note: explanation below the table.
        summary_note: explanation below the summary.
        marked: names of methods with their footnote marks.
        footnotes: of the methods.
        differences: by pair, condition and IoU, in this order.
    """

    title: str
    note: str
    summary_note: str
    marked: Mapping[str, str]
    footnotes: tuple[str, ...]
    differences: tuple[Difference, ...]

    def markdown(self) -> str:
        """Markdown: title, table with intervals that exclude 0 in bold, resolved differences, footnotes and note."""
        columns = [Column("Condition", align="left")]
        columns += [Column(f"{text}{iou}") for iou in IOUS for text in ("AP@", "by frame, ", "by drive, ")]
        rows = [
            TableRow(self._pair(group[0]), (_titled(group[0].condition), *(t for one in group for t in _texts(one))))
            for group in _groups(self.differences, len(IOUS))
        ]
        return self._table(columns, rows, (self.claims(), *self.footnotes), self.note).markdown()

    def summary(self) -> str:
        """Markdown: title, a line per pair with its clean frames, mean of the corruptions and mCE, and a note.

        Intervals are those by drive; bold is what both intervals resolve.
        """
        shown = [one for one in self.differences if one.condition in (CLEAN, MEAN_CORRUPTED, MCE)]
        heads = dict.fromkeys(f"{_titled(one.condition)}, {one.iou:g}" for one in shown)
        rows = [TableRow(self._pair(group[0]), tuple(map(_by_drive, group))) for group in _groups(shown, len(heads))]
        return self._table([*map(Column, heads)], rows, self.footnotes, self.summary_note).markdown()

    def terminal(self) -> Table:
        """Table of clean frames and the mean of the corruptions for the terminal; what is resolved stands below it."""
        columns = [Column("condition", align="left")]
        columns += [Column(f"{text}{iou}") for iou in IOUS for text in ("AP@", "by frame ")]
        shown = [one for one in self.differences if one.condition in (CLEAN, MEAN_CORRUPTED)]
        rows = [
            TableRow(
                self._pair(group[0]), (_titled(group[0].condition), *(t for one in group for t in _texts(one)[:2]))
            )
            for group in _groups(shown, len(IOUS))
        ]
        title = "Differences, points, with 95 % intervals"
        return Table(
            "differences", title, "difference", tuple(columns), tuple(rows), caption=self.claims(), grouped=True
        )

    def _table(self, columns: Sequence[Column], rows: Sequence[TableRow], below: tuple[str, ...], note: str) -> Table:
        head = "Difference"
        return Table("differences", self.title, head, tuple(columns), tuple(rows), note, footnotes=below)

    def csv(self) -> str:
        """CSV with a line per difference, unscaled; unknown numbers are empty."""
        return csv_text([one.listed() for one in self.differences])

    def claims(self) -> str:
        """Sentence that lists the differences resolved by both intervals."""
        found: dict[str, list[str]] = {}
        for one in self.differences:
            if one.resolved:
                what = f"{condition_title(one.condition)} at {one.iou:g} ({_signed(one.value.mean)})"
                found.setdefault(self._pair(one), []).append(what)
        if not found:
            known = any(not math.isnan(one.by_drive.low) for one in self.differences)
            why = "of each of them at least one interval holds 0 or is unknown"
            why = why if known else "frames of one drive say nothing of other drives"
            return f"No difference is resolved: {why}."
        listed = "; ".join(f"{pair}: {', '.join(several)}" for pair, several in found.items())
        return f"Resolved, both intervals exclude 0: {listed}. No other difference is."

    def _pair(self, one: Difference) -> str:
        return f"{self.marked[one.method]} − {self.marked[one.baseline]}"


def stored_differences(results: Path) -> DifferenceTable:
    """Differences of a `results.json` that this process wrote."""
    listed = json.loads(results.read_text(encoding="utf-8"))["differences"]
    found = tuple(Difference.of_listed(one) for one in listed)
    names = {name: name for one in found for name in (one.method, one.baseline)}
    return DifferenceTable("", "", "", names, (), found)


def difference_table(
    results: DatasetResults, pairs: Sequence[DifferenceSpec], drives: Sequence[int], runs: Sequence[int]
) -> DifferenceTable:
    """Differences of pairs of methods in clean frames, under each corruption, in their mean and in mCE.

    Args:
        results: of the dataset, with the detections of the pairs' methods.
        drives: (D,) evaluated frames of each drive; drives without any are left out.
        runs: (D,) number of the run of traffic of each drive: drives of one run are drawn together.
    """
    runs = [run for run, frames in zip(runs, drives, strict=True) if frames]
    drives = [frames for frames in drives if frames]
    known, of_drive = np.unique(np.array(runs, np.int64), return_inverse=True)
    methods = list(dict.fromkeys(name for pair in pairs for name in (pair.method, pair.baseline)))
    by_frame = _resampled(results, methods, np.arange(sum(drives)))
    by_drive = _resampled(results, methods, np.repeat(of_drive, drives))
    units = sum(drives), len(known)
    found = tuple(one for pair in pairs for one in _differences(results, pair, by_frame, by_drive, units))
    what = (
        "Method less baseline, points of average precision in bird's-eye view at IoU 0.5 and 0.7, sorted over all "
        f"frames. {results.level} mCE: share of the clean AP lost, less is better."
    )
    drawn = f"{len(drives)} drives"
    if len(known) < len(drives):
        drawn = f"the {len(known)} runs of traffic that {len(drives)} drives show"
    bootstrap = (
        f"{RESAMPLES} resamples of {sum(drives)} frames and of {drawn} (expanded percentile bootstrap): "
        "both methods on the same resamples, AP computed anew in each"
    )
    sample = (
        "The trainings of a method are averaged in each resample, so what another training would change is in no "
        "interval. Where two methods have trainings of two or more common seeds, only these count"
    )
    trained = sample_note(results, methods, spread=False)
    note = (
        f"{what} In brackets the {LEVEL:.0%} interval of {bootstrap}. Bold: the interval excludes 0, as one of twenty "
        "does by chance; of a difference, both do. Frames of one drive are alike, so the interval by frame is too "
        f"narrow for other drives. {sample}, and ± is the standard deviation of the difference between seeds.{trained}"
    )
    summary_note = (
        f"{what} In brackets the {LEVEL:.0%} interval by drive. Bold: it excludes 0, and the interval by frame, which "
        f"is in the whole table, does too; {bootstrap}. {sample}.{trained}"
    )
    marked = {name: results.marked(name, name) for name in methods}
    return DifferenceTable(
        f"Differences, {results.titled}", note, summary_note, marked, results.footnotes(methods), found
    )


def _differences(
    results: DatasetResults,
    pair: DifferenceSpec,
    by_frame: Mapping[str, _Metrics],
    by_drive: Mapping[str, _Metrics],
    units: tuple[int, int],
) -> list[Difference]:
    """Differences of a pair, by condition and IoU.

    Args:
        by_frame: metrics of methods in the sample, then in resamples of its frames.
        by_drive: likewise, of its runs of traffic.
        units: numbers of frames and runs.
    """
    names = (pair.method, pair.baseline)
    first, second = ([one.seed for one in results.trained[name]] for name in names)
    paired = _paired(first, second)
    orders = paired or (list(range(len(first))), list(range(len(second))))
    listed = []
    for condition in by_frame[pair.method]:
        for k, iou in enumerate(IOUS):
            frame, drive = (
                [metrics[name][condition][order, k] for name, order in zip(names, orders, strict=True)]
                for metrics in (by_frame, by_drive)
            )
            values, values_by_drive = (a.mean(axis=0) - b.mean(axis=0) for a, b in (frame, drive))
            spread = Stat.of(list(frame[0][:, 0] - frame[1][:, 0])).spread if paired else math.nan
            value = Stat(float(values[0]), spread)
            resampled = zip((values[1:], values_by_drive[1:]), units, strict=True)
            frames, drives = (percentile_interval(of_unit, number) for of_unit, number in resampled)
            seeds = tuple(first[place] for place in paired[0]) if paired else ()
            listed.append(Difference(*names, condition, iou, value, frames, drives, seeds))
    return listed


def _paired(first: Sequence[int | None], second: Sequence[int | None]) -> tuple[list[int], list[int]] | None:
    """Places of two methods' trainings with the same seeds, in one order; None for fewer than two common seeds.

    None as well where a method has a seed twice: which of its trainings to take would be a choice. One training of a
    method says little of its mean, so a single common seed leaves all trainings in.
    """
    common = sorted({seed for seed in first if seed is not None} & {seed for seed in second if seed is not None})
    if len(common) < 2 or len(set(first)) < len(first) or len(set(second)) < len(second):
        return None
    return [first.index(seed) for seed in common], [second.index(seed) for seed in common]


def _resampled(results: DatasetResults, methods: Sequence[str], group: NDArray[np.int64]) -> dict[str, _Metrics]:
    """Metrics of methods in the sample itself, then in its resamples.

    Args:
        group: see `draw_weights`.
    """
    drawn = draw_weights(group, RESAMPLES, np.random.default_rng(SEED))
    weights = np.concatenate([np.ones((1, len(group)), np.float32), drawn])
    return {method: _metrics(results, method, weights) for method in methods}


def _metrics(results: DatasetResults, method: str, weights: NDArray[np.float32]) -> _Metrics:
    """Metrics of a method in resamples of (R, F) weights."""
    found = {
        kind: np.stack([resampled_ap(e.ranked, weights) for e in results.found(method, kind) if e.ranked is not None])
        for kind in (CLEAN, *results.kinds())
    }
    if results.corruptions():
        clean, corrupted = found[CLEAN], np.stack([found[kind] for kind in results.corruptions()])
        lost = np.divide(clean - corrupted, clean, out=np.full(corrupted.shape, math.nan), where=clean > 0)
        found |= {MEAN_CORRUPTED: corrupted.mean(axis=0), MCE: lost.mean(axis=0)}
    return found


def _titled(condition: str) -> str:
    title = condition_title(condition)
    return title if condition == MCE else title.capitalize()


def _signed(value: float) -> str:
    return "-" if math.isnan(value) else f"{100 * value:+.1f}"


def _groups(differences: Sequence[Difference], size: int) -> list[Sequence[Difference]]:
    return [differences[start : start + size] for start in range(0, len(differences), size or 1)]


def _texts(one: Difference) -> tuple[str, str, str]:
    """Texts of a difference and its intervals."""
    spread = "" if math.isnan(one.value.spread) else f" ± {100 * one.value.spread:.1f}"
    value = f"{_signed(one.value.mean)}{spread}"
    return Strong(value) if one.resolved else value, _bounds(one.by_frame), _bounds(one.by_drive)


def _by_drive(one: Difference) -> str:
    """Text of a difference with its interval by drive."""
    bounds = "" if math.isnan(one.by_drive.low) else f" {one.by_drive.points}"
    text = f"{_signed(one.value.mean)}{bounds}"
    return Strong(text) if one.resolved else text


def _bounds(interval: Interval) -> str:
    if math.isnan(interval.low):
        return "-"
    return Strong(interval.points) if interval.excludes_zero else interval.points
