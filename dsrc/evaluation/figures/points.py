"""Points: differences with their intervals, AP against bytes sent, mean AP against mCE."""

import math
from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dsrc.evaluation.metrics.ap import metric_name
from dsrc.evaluation.metrics.intervals import IOUS, Difference
from dsrc.evaluation.results import MCE, MEAN_AP, Row, condition_title, find_row, methods_of, metric_of
from dsrc.tables.figure import (
    INK,
    SHADES,
    WIDTH_IN,
    Style,
    add_legend,
    figure_style,
    panels,
    styles_of,
)


def difference_dots(differences: Sequence[Difference], title: str = "") -> Figure:
    """Draw the differences of a pair with their intervals, a panel per IoU, a line per condition.

    The upper bar of a line is the interval by frame, the lower one that by drive; dots are full where both exclude 0.
    """
    conditions = list(dict.fromkeys(one.condition for one in differences))
    with figure_style():
        figure, parts = panels(WIDTH_IN, 1.7 + 0.24 * len(conditions), columns=len(IOUS), title=title)
        for axes, iou in zip(parts, IOUS, strict=True):
            shown = [one for one in differences if one.iou == iou]
            axes.axvline(0.0, color=INK, linewidth=0.9)
            for y, one in enumerate(shown):
                _interval(axes, y, one, named=y == 0)
            first = iou == IOUS[0]
            axes.set_yticks(range(len(shown)), [condition_title(one.condition) if first else "" for one in shown])
            axes.set(ylim=(len(conditions) - 0.5, -0.5))
            axes.set_title(f"{shown[0].method} minus\n{shown[0].baseline}, IoU {iou}")
            axes.grid(visible=False, axis="y")
            axes.set_xlabel("difference, points of AP (mCE: less is better)")
        add_legend(figure, parts[0], below=True)
    return figure


def _interval(axes: Axes, y: float, one: Difference, *, named: bool) -> None:
    """Draw a difference and its two intervals, in points."""
    for bounds, off, style, label in (
        (one.by_frame, -0.14, SHADES[1], "95 % interval by frame"),
        (one.by_drive, 0.14, SHADES[2], "95 % interval by drive"),
    ):
        ends = [100 * bounds.low, 100 * bounds.high]
        color = style["facecolor"]
        axes.plot(
            ends, [y + off] * 2, color=color, linewidth=2.6, label=label if named else None, solid_capstyle="butt"
        )
    face = INK if one.resolved else "white"
    axes.plot([100 * one.value.mean], [y], "o", color=INK, markersize=5, markerfacecolor=face, markeredgewidth=1.2)


def traffic_scatter(
    points: Mapping[str, tuple[float, float, float]], styles: Mapping[str, Style] | None = None, title: str = ""
) -> Figure:
    """Draw AP against bytes sent, a panel per IoU.

    Args:
        points: kB per frame, AP at IoU 0.5 and AP at 0.7, by method.
    """
    styles = styles or styles_of(list(points))
    with figure_style():
        figure, parts = panels(WIDTH_IN, max(3.8, 0.6 + 0.19 * len(points)), columns=2, title=title)
        for part, (axes, iou) in enumerate(zip(parts, IOUS, strict=True)):
            for name, values in points.items():
                axes.plot([values[0]], [100 * values[1 + part]], label=name, **styles[name].point())
            axes.margins(0.15)
            axes.set_xscale("symlog", linthresh=0.1)
            axes.set_xlim(-0.05, 10.0 * max([0.1, *(sent for sent, *_ in points.values())]))
            axes.set_title(f"IoU {iou}")
            axes.set_xlabel("kB sent per frame by all collaborators")
        parts[0].set_ylabel("average precision, %")
        add_legend(figure, parts[0])
    return figure


def robustness_scatter(rows: Sequence[Row], styles: Mapping[str, Style] | None = None, title: str = "") -> Figure:
    """Draw mean AP over clean and all corruptions against mCE, one panel per IoU, as the paper's Figure 5."""
    methods = methods_of(rows)
    styles = styles or styles_of(methods)
    with figure_style():
        figure, parts = panels(WIDTH_IN, max(3.8, 0.6 + 0.19 * len(methods)), columns=2, title=title)
        for axes, iou in zip(parts, IOUS, strict=True):
            name = metric_name("bev", iou)
            for method in methods:
                x = metric_of(find_row(rows, method, MCE), name)
                y = metric_of(find_row(rows, method, MEAN_AP), name)
                if not (math.isnan(x) or math.isnan(y)):
                    axes.plot([100 * x], [100 * y], label=method, **styles[method].point())
            axes.margins(0.15)
            axes.set_title(f"IoU {iou}")
            axes.set_xlabel("mCE, % of the clean AP lost (left is better)")
        parts[0].set_ylabel("mean AP, %, bird's-eye IoU (up is better)")
        add_legend(figure, parts[0])
    return figure
