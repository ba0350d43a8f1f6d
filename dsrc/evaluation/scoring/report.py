"""Scores as a table, CSV, JSON, Markdown and a figure, with the card of the protocol beside each number."""

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.table import Table
from rich.text import Text

from dsrc.evaluation.figures.style import COLORS, figure_style, panels, png_bytes
from dsrc.evaluation.metrics.ap import SPACES, THRESHOLDS, metric_name
from dsrc.evaluation.scoring.score import Score
from dsrc.evaluation.table import markdown_table
from sim.files import write_file

_MOST_COLUMNS = 3
_METRICS = [(space, threshold) for space in SPACES for threshold in THRESHOLDS]
_TITLES = {"bev": "BEV", "3d": "3D"}
_SHIFT = {"bev": -0.13, "3d": 0.13}
"""Distance of markers from the line of their protocol, rows: equal numbers stay visible."""


def score_table(scores: Sequence[Score]) -> Group:
    """Tables of average precision for the terminal, %, one for each set, and the card of each protocol below them."""
    tables = [_table(name, [one for one in scores if one.name == name]) for name in _names(scores)]
    cards = {one.protocol.name: one.protocol.card for one in scores}
    lines = [Text.assemble((name, "bold"), f": {card}") for name, card in cards.items()]
    return Group(*tables, *lines, *map(Text, _notes(scores)))


def _table(name: str, scores: Sequence[Score]) -> Table:
    title = Text(f"Average precision of {name}, %")
    table = Table(
        title=title, title_justify="left", header_style="bold", pad_edge=False, box=SIMPLE_HEAD, padding=(0, 0)
    )
    table.add_column("protocol", no_wrap=True)
    for space, threshold in _METRICS:
        head = _TITLES[space] if threshold == THRESHOLDS[0] else ""
        table.add_column(f"{head}\n{threshold}", justify="right", no_wrap=True)
    for head in ("true\nboxes", "found"):
        table.add_column(head, justify="right", no_wrap=True)
    for one in scores:
        table.add_row(one.protocol.name, *_texts(one), str(one.truth), str(one.detections))
    return table


def write_scores(out: Path, scores: Sequence[Score], made_by: Mapping[str, Any]) -> None:
    """Write `scores.json`, `scores.csv`, `scores.md` and `scores.png` into a folder.

    Args:
        out: folder.
        scores: see `dsrc.evaluation.scoring.score.score`.
        made_by: provenance.
    """
    rows = [_listed(one) for one in scores]
    content = json.dumps({"provenance": made_by, "rows": rows}, indent=1, sort_keys=True, allow_nan=False)
    write_file(out / "scores.json", content + "\n")
    text = io.StringIO()
    text.write(f"# {json.dumps(made_by, sort_keys=True, allow_nan=False)}\n")
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_file(out / "scores.csv", text.getvalue())
    write_file(out / "scores.md", score_markdown(scores))
    write_file(out / "scores.png", png_bytes(score_figure(scores), made_by))


def score_markdown(scores: Sequence[Score]) -> str:
    """Markdown: a table with what each protocol counts and where it is published."""
    heads = [f"{_TITLES[space]} {threshold}" for space, threshold in _METRICS]
    names = _names(scores)
    rows = [["detections", "protocol", *heads, "true boxes", "found", "counted", "source"]]
    rows.append(["---", "---", *["---:"] * (len(heads) + 2), "---", "---"])
    for one in scores:
        about = [str(one.truth), str(one.detections), one.protocol.card, one.protocol.source]
        rows.append([one.name, one.protocol.name, *_texts(one), *about])
    if len(names) == 1:
        rows = [row[1:] for row in rows]
    title = "**Average precision, %, of the same boxes under each protocol**"
    return "\n\n".join([title, markdown_table(rows), *_notes(scores)]) + "\n"


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
            axes.plot(values, places, linestyle="", marker=marker, color=color, markerfacecolor=face, label=label)
    axes.set(xlim=(0, 100), ylim=(len(protocols) - 0.5, -0.5), xlabel="average precision, %")


def _value(one: Score | None, space: Any, threshold: float) -> float:
    return math.nan if one is None else one.ap.get((space, threshold), math.nan)


def _names(scores: Sequence[Score]) -> list[str]:
    return list(dict.fromkeys(one.name for one in scores))


def _notes(scores: Sequence[Score]) -> list[str]:
    return list(dict.fromkeys(f"{one.name}: {one.note}." for one in scores if one.note))


def _texts(one: Score) -> list[str]:
    """Average precisions in percent, "-" for those that the protocol does not have or that are unknown."""
    values = [_value(one, *metric) for metric in _METRICS]
    return ["-" if math.isnan(value) else f"{100 * value:.1f}" for value in values]


def _listed(one: Score) -> dict[str, Any]:
    """Fields of a score, JSON types."""
    values = {metric_name(*metric): _value(one, *metric) for metric in _METRICS}
    numbers = {name: None if math.isnan(value) else value for name, value in values.items()}
    about = {"counted": one.protocol.card, "source": one.protocol.source, "note": one.note}
    counts = {"frames": one.frames, "truth": one.truth, "found": one.detections}
    return {"detections": one.name, "protocol": one.protocol.name, **numbers, **counts, **about}
