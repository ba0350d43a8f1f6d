"""Plots of the paper: the mean over all methods, its Figure 4, and the parts of DSRC."""

import math
from collections.abc import Sequence

from matplotlib.figure import Figure

from dsrc.evaluation.figures.bars import draw_groups
from dsrc.evaluation.metrics.ap import metric_name
from dsrc.evaluation.metrics.intervals import IOUS
from dsrc.evaluation.results import Row, condition_title, conditions_of, find_row, methods_of, metric_of
from dsrc.tables.figure import INK, SHADES, WIDTH_IN, add_legend, figure_style, panels
from dsrc.tables.table import Stat, Table


def mean_bars(rows: Sequence[Row], title: str = "") -> Figure:
    """Draw AP under each condition as the mean over all methods, as the paper's Figure 4."""
    methods, conditions = methods_of(rows), conditions_of(rows)
    with figure_style():
        figure, (axes,) = panels(WIDTH_IN, 3.4, title=title)
        series = {}
        for iou in IOUS:
            found = [[metric_of(find_row(rows, m, c), metric_name("bev", iou)) for m in methods] for c in conditions]
            series[f"IoU {iou}"] = [Stat(sum(values) / max(len(values), 1)) for values in found]
        draw_groups(axes, [condition_title(c) for c in conditions], series, SHADES[::2])
        axes.set_ylabel(f"AP, %, mean of {len(methods)} methods")
        add_legend(figure, axes, below=True)
    return figure


def table_dots(sheet: Table) -> Figure:
    """Draw the columns of a table of AP as points with their spreads, a line each, a panel per IoU.

    The axis holds the points and not 0: lines differ by less than a bar could show.
    """
    with figure_style():
        figure, parts = panels(WIDTH_IN, 1.7 + 0.34 * len(sheet.rows), columns=len(IOUS), title=sheet.title)
        for part, (axes, iou) in enumerate(zip(parts, IOUS, strict=True)):
            for k, (column, fill, marker) in enumerate(zip(sheet.columns, SHADES, "osD", strict=False)):
                stats = [line.stat(k, part) for line in sheet.rows]
                means, spreads = [100 * s.mean for s in stats], [100 * s.spread for s in stats]
                axes.errorbar(
                    means, range(len(stats)), xerr=None if all(map(math.isnan, spreads)) else spreads,
                    fmt=marker, color=fill["facecolor"], markersize=6.5, label=column.title,
                    ecolor=INK, elinewidth=0.9, capsize=2.5,
                )  # fmt: skip
                for y, mean in enumerate(means):
                    if not math.isnan(mean):
                        axes.text(mean, y - 0.17, f"{mean:.1f}", ha="center", va="bottom", fontsize=7)
            names = [line.title if iou == IOUS[0] else "" for line in sheet.rows]
            axes.set_yticks(range(len(sheet.rows)), names)
            axes.set(ylim=(len(sheet.rows) - 0.5, -0.7))
            axes.margins(x=0.1)
            axes.grid(visible=False, axis="x")
            axes.set_title(f"IoU {iou}")
            axes.set_xlabel("average precision, %")
        add_legend(figure, parts[0], below=True)
    return figure
