"""Scores as a table, CSV, JSON, Markdown and a figure, with the card of the protocol beside each number."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dsrc.evaluation.metrics.ap import SPACES, THRESHOLDS, metric_name
from dsrc.evaluation.scoring.score import Score
from dsrc.tables.figure import COLORS, figure_style, panels, write_figure
from dsrc.tables.files import Scalar, csv_text, json_text
from dsrc.tables.table import Cell, Column, Stat, Table, TableRow
from sim.files import write_file

_MOST_COLUMNS = 3
_METRICS = [(space, threshold) for space in SPACES for threshold in THRESHOLDS]
_TITLES = {"bev": "BEV", "3d": "3D"}
_SHIFT = {"bev": -0.13, "3d": 0.13}
"""Distance of markers from the line of their protocol, rows: equal numbers stay visible."""


def score_tables(scores: Sequence[Score]) -> list[Table]:
    """Tables of average precision for a terminal, %, one for each set; the last explains the protocols."""
    names = _names(scores)
    cards = {one.protocol.name: one.protocol.card for one in scores}
    about = "\n".join([*(f"{name}: {card}" for name, card in cards.items()), *_notes(scores)])
    tables = [score_table([o for o in scores if o.name == name], f"Average precision of {name}, %") for name in names]
    return [*tables[:-1], replace(tables[-1], caption=about)]


def score_table(
    scores: Sequence[Score], title: str = "Average precision, %, of the same boxes under each protocol"
) -> Table:
    """Table of average precision, %: what each protocol gives and counts, and where it is published.

    Args:
        scores: see `dsrc.evaluation.scoring.score.score`.
    """
    several = len(_names(scores)) > 1
    columns = [Column("protocol", align="left")] if several else []
    columns += [Column(f"{_TITLES[space]} {threshold}", ("",), scale=100.0, digits=1) for space, threshold in _METRICS]
    columns += [Column("true boxes"), Column("found")]
    columns += [Column(head, align="left", terminal=False) for head in ("counted", "source")]
    rows = []
    for one in scores:
        cells: list[Cell] = [one.protocol.name] if several else []
        cells += [(Stat(_value(one, *metric)),) for metric in _METRICS]
        cells += [one.truth, one.detections, one.protocol.card, one.protocol.source]
        rows.append(TableRow(one.name if several else one.protocol.name, tuple(cells)))
    head, note = "detections" if several else "protocol", "\n\n".join(_notes(scores))
    return Table("scores", title, head, tuple(columns), tuple(rows), note)


def write_scores(out: Path, scores: Sequence[Score], made_by: Mapping[str, object]) -> None:
    """Write `scores.json`, `scores.csv`, `scores.md` and `scores.png` into a folder.

    Args:
        scores: see `dsrc.evaluation.scoring.score.score`.
    """
    rows = [_listed(one) for one in scores]
    write_file(out / "scores.json", json_text({"provenance": made_by, "rows": rows}))
    write_file(out / "scores.csv", csv_text(rows, made_by=made_by))
    write_file(out / "scores.md", score_table(scores).markdown())
    write_figure(out / "scores.png", score_figure(scores), made_by)


def score_figure(scores: Sequence[Score]) -> Figure:
    """Draw average precision, a panel per set of detections, a line per protocol, a colour per IoU threshold."""
    names = _names(scores)
    protocols = list(dict.fromkeys(one.protocol.name for one in scores))
    rows = math.ceil(len(names) / _MOST_COLUMNS)
    columns = math.ceil(len(names) / rows)  # four panels are two by two
    with figure_style():
        height = 1.2 + rows * (0.6 + 0.26 * len(protocols))
        figure, parts = panels(9.0, height, rows, columns, title="The same boxes under each protocol")
        for number, (axes, name) in enumerate(zip(parts, names, strict=False)):
            _panel(axes, {one.protocol.name: one for one in scores if one.name == name}, protocols)
            axes.set_title(name.replace(", ", "\n"))
            axes.set_yticks(range(len(protocols)), protocols if number % columns == 0 else [""] * len(protocols))
        for axes in parts[len(names) :]:
            axes.set_visible(False)
        figure.legend(*parts[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(_METRICS))
    return figure


def _panel(axes: Axes, scores: Mapping[str, Score], protocols: Sequence[str]) -> None:
    for color, threshold in zip(COLORS, THRESHOLDS, strict=False):
        for space, marker, face in (("bev", "o", color), ("3d", "s", "white")):
            places = np.arange(len(protocols)) + _SHIFT[space]
            values = [100 * _value(scores.get(protocol), space, threshold) for protocol in protocols]
            label = f"{_TITLES[space]}, IoU {threshold}"
            axes.plot(
                values, places, marker, color=color, markerfacecolor=face, label=label, linestyle="", clip_on=False
            )
    axes.set(xlim=(0, 100), ylim=(len(protocols) - 0.5, -0.5), xlabel="average precision, %")


def _value(one: Score | None, space: Any, threshold: float) -> float:
    return math.nan if one is None else one.ap.get((space, threshold), math.nan)


def _names(scores: Sequence[Score]) -> list[str]:
    return list(dict.fromkeys(one.name for one in scores))


def _notes(scores: Sequence[Score]) -> list[str]:
    return list(dict.fromkeys(f"{one.name}: {one.note}." for one in scores if one.note))


def _listed(one: Score) -> dict[str, Scalar]:
    """Fields of a score, JSON types."""
    values = {metric_name(*metric): _value(one, *metric) for metric in _METRICS}
    numbers = {name: None if math.isnan(value) else value for name, value in values.items()}
    about = {"counted": one.protocol.card, "source": one.protocol.source, "note": one.note}
    counts = {"frames": one.frames, "truth": one.truth, "found": one.detections}
    return {"detections": one.name, "protocol": one.protocol.name, **numbers, **counts, **about}
