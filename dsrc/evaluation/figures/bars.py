"""Bars and heat maps of AP: per condition, of tables and of differences."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dsrc.evaluation.metrics.ap import metric_name
from dsrc.evaluation.metrics.intervals import IOUS, Difference
from dsrc.evaluation.results import (
    MCE,
    MEAN_CORRUPTED,
    Row,
    condition_title,
    conditions_of,
    find_row,
    methods_of,
    metric_of,
)
from dsrc.tables.figure import (
    INK,
    WIDTH_IN,
    Style,
    add_legend,
    draw_cell,
    figure_style,
    panels,
    styles_of,
)
from dsrc.tables.table import Stat, Table

_MOST_BARS = 6
_GAINS, _STRONG = "RdBu", 10.0
"""Colours of differences, and the points that have the strongest."""
_WHITE = (1.0, 1.0, 1.0)


def corruption_bars(rows: Sequence[Row], styles: Mapping[str, Style] | None = None, title: str = "") -> Figure:
    """Draw AP as bars, a panel per IoU, a group per condition, a bar per method; many methods as a heat map."""
    methods, conditions = methods_of(rows), conditions_of(rows)
    title = title or "Detection under corruption (bird's-eye IoU)"
    titles = [condition_title(c) for c in conditions]
    values = [
        [[metric_of(find_row(rows, m, c), metric_name("bev", iou)) for c in conditions] for m in methods]
        for iou in IOUS
    ]
    if len(methods) > _MOST_BARS:
        return _map(title, methods, titles, values)
    styles = styles or styles_of(methods)
    with figure_style():
        figure, parts = panels(WIDTH_IN, 5.2, rows=2, title=title)
        for axes, iou, of_methods in zip(parts, IOUS, values, strict=True):
            series = {method: [Stat(value) for value in line] for method, line in zip(methods, of_methods, strict=True)}
            draw_groups(axes, titles, series, [styles[m].bar() for m in methods])
            axes.set_title(f"IoU {iou}")
            axes.set_ylabel("average precision, %")
        add_legend(figure, parts[0], below=True)
    return figure


def draw_groups(
    axes: Axes, groups: Sequence[str], series: Mapping[str, Sequence[Stat]], fills: Sequence[Mapping[str, Any]]
) -> None:
    """Draw a bar of each series in each group, in percent, with its number above it and its spread where known."""
    width = 0.84 / max(len(series), 1)
    for i, ((name, stats), fill) in enumerate(zip(series.items(), fills, strict=True)):
        places = [group + (i - (len(series) - 1) / 2) * width for group in range(len(groups))]
        heights, spreads = [100 * s.mean for s in stats], [100 * s.spread for s in stats]
        known = None if all(map(math.isnan, spreads)) else spreads
        axes.bar(places, heights, 0.92 * width, yerr=known, ecolor=INK, capsize=2, label=name, **fill)
        for x, height, spread in zip(places, heights, spreads, strict=True):
            if not math.isnan(height):
                top = height + (0.0 if math.isnan(spread) else spread) + 1.2
                text = f"{height:.1f}" if len(groups) * len(series) <= 24 else f"{height:.0f}"
                axes.text(x, top, text, ha="center", va="bottom", fontsize=7)
    axes.set_xticks(range(len(groups)), [name if "+" in name else name.replace(" ", "\n", 1) for name in groups])
    axes.tick_params(axis="x", length=0)
    axes.grid(visible=False, axis="x")
    axes.set(ylim=(0, 108), yticks=range(0, 101, 20))


_CMAP = "cividis"
"""Colour map of even steps of lightness, for any colour vision and in grey."""


def table_heatmap(sheet: Table) -> Figure:
    """Draw a table's columns of AP as a heat map with numbers, a panel per IoU; the best of a column is bold.

    A column where less is better, such as mCE, has numbers alone: the colours are those of AP.
    """
    shown = [i for i, column in enumerate(sheet.columns) if column.better and len(column.parts) == len(IOUS)]
    values = [[[row.stat(i, part).mean for i in shown] for row in sheet.rows] for part in range(len(IOUS))]
    columns = [sheet.columns[i] for i in shown]
    losses = [column.better == "low" for column in columns]
    return _map(sheet.title, [row.title for row in sheet.rows], [column.title for column in columns], values, losses)


def _map(
    title: str,
    lines: Sequence[str],
    columns: Sequence[str],
    values: Sequence[Sequence[Sequence[float]]],
    losses: Sequence[bool] = (),
) -> Figure:
    """Draw a heat map of (IoU, line, column) AP; columns of means and losses, without colours, stand apart."""
    percent = 100 * np.array(values, float).reshape(len(IOUS), len(lines), len(columns))
    lost = np.array(losses or [False] * len(columns), bool)
    known = percent[np.isfinite(percent) & ~lost]
    scale = Normalize(*((known.min(), known.max()) if known.size else (0.0, 100.0)))
    apart = lost | np.isin(columns, ["mAP", "mean AP"])
    places = np.arange(len(columns)) + 0.25 * (np.cumsum(apart) > 0)
    with figure_style():
        figure, parts = panels(WIDTH_IN, 1.9 + 0.24 * len(lines), columns=2, title=title)
        for axes, iou, numbers in zip(parts, IOUS, percent, strict=True):
            for x, column, less in zip(places, numbers.T, lost, strict=True):
                texts = ["-" if math.isnan(value) else f"{value:.1f}" for value in column]
                ranks = np.nan_to_num(-column if less else column, nan=-math.inf)
                best = f"{column[ranks.argmax()]:.1f}" if len(column) else ""
                for y, (value, text) in enumerate(zip(column, texts, strict=True)):
                    color = _WHITE if text == "-" or less else mpl.colormaps[_CMAP](float(scale(value)))[:3]
                    draw_cell(axes, x, y, color, text, bold=text == best and len(lines) > 1)
            _frame(axes, places, columns, lines, named=axes is parts[0])
            axes.set_title(f"IoU {iou}")
        bar = figure.colorbar(ScalarMappable(scale, _CMAP), ax=parts, fraction=0.02, pad=0.01)
        bar.set_label("average precision, %")
        bar.outline.set_visible(False)  # type: ignore[operator]
    return figure


def difference_map(differences: Sequence[Difference], title: str = "") -> Figure:
    """Draw differences as a heat map with numbers, a panel per IoU, a line per pair, a column per condition.

    Differences that both intervals resolve have a colour and bold numbers: blue where the method is better, red where
    it is worse, darkest from ten points on.
    """
    pairs = list(dict.fromkeys((one.method, one.baseline) for one in differences))
    conditions = list(dict.fromkeys(one.condition for one in differences))
    lines = [f"{method} \N{MINUS SIGN} {baseline}" for method, baseline in pairs]
    places = np.arange(len(conditions)) + 0.25 * np.isin(conditions, [MEAN_CORRUPTED, MCE])
    scale = Normalize(-_STRONG, _STRONG, clip=True)
    with figure_style():
        figure, parts = panels(WIDTH_IN, len(IOUS) * (1.5 + 0.24 * len(lines)), rows=len(IOUS), title=title)
        for axes, iou in zip(parts, IOUS, strict=True):
            for one in (one for one in differences if one.iou == iou):
                x, y = places[conditions.index(one.condition)], pairs.index((one.method, one.baseline))
                value = 100 * one.value.mean
                gain = -value if one.condition == MCE else value
                color = mpl.colormaps[_GAINS](float(scale(gain)))[:3] if one.resolved else _WHITE
                draw_cell(axes, x, y, color, "-" if math.isnan(value) else f"{value:+.1f}", bold=one.resolved)
            _frame(axes, places, list(map(condition_title, conditions)), lines, named=True)
            axes.set_title(f"IoU {iou}, points; coloured: both intervals exclude 0; blue: better")
    return figure


def _frame(
    axes: Axes, places: NDArray[np.float64], columns: Sequence[str], lines: Sequence[str], *, named: bool
) -> None:
    """Name the columns of a heat map and, if wanted, its lines."""
    axes.set(xlim=(-0.5, max(places, default=0.0) + 0.5), ylim=(max(len(lines), 1) - 0.5, -0.5))
    names = [column.replace(", ", "\n") for column in columns]
    turned = {"rotation": 45, "ha": "right", "rotation_mode": "anchor"} if len(columns) > 4 else {}
    axes.set_xticks(places, names, **turned)  # type: ignore[arg-type]
    axes.set_yticks(range(len(lines)), lines if named else [""] * len(lines))
    axes.tick_params(length=0)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
