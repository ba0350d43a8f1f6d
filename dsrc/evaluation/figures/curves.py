"""Curves: AP over a swept quantity, precision over recall and over score, losses over the epochs of a training."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dsrc.evaluation.metrics.ap import envelope
from dsrc.evaluation.metrics.calibration import IOU, Reliability, reliability
from dsrc.evaluation.metrics.intervals import IOUS
from dsrc.evaluation.results import CLEAN, Row, condition_title, find_row, methods_of
from dsrc.tables.figure import NAME_IN, WIDTH_IN, Style, add_legend, figure_style, panels, styles_of
from dsrc.tables.table import Table


def table_lines(sheet: Table, label: str, places: Sequence[float], styles: Mapping[str, Style] | None = None) -> Figure:
    """Draw the first columns of a table over their places, a curve per line with its name at its end, a panel per IoU.

    Args:
        sheet: table of AP at IoU 0.5 and 0.7.
        places: of the columns on it.
    """
    columns = len(places)
    styles = styles or styles_of([line.label for line in sheet.rows])
    ticks = [column.title.replace(", ", "\n").replace(" + ", "\n+ ") for column in sheet.columns[:columns]]
    with figure_style():
        figure, parts = panels(WIDTH_IN, max(4.0, 1.5 + NAME_IN * len(sheet.rows)), columns=2, title=sheet.title)
        for part, (axes, iou) in enumerate(zip(parts, IOUS, strict=True)):
            for line in sheet.rows:
                stats = [line.stat(i, part) for i in range(columns)]
                spreads = [100 * s.spread for s in stats]
                axes.errorbar(
                    places, [100 * s.mean for s in stats],
                    yerr=None if all(map(math.isnan, spreads)) else spreads,
                    capsize=2.5, label=line.label, **styles[line.label].line(),
                )  # fmt: skip
            axes.set_xticks(places, ticks)
            axes.set_title(f"IoU {iou}")
            axes.set_xlabel(label)
            ends = {line.label: 100 * line.stat(columns - 1, part).mean for line in sheet.rows}
            _name_ends(axes, places[-1], ends, styles)
        parts[0].set_ylabel("average precision, %")
    return figure


def _name_ends(axes: Axes, x: float, ends: Mapping[str, float], styles: Mapping[str, Style]) -> None:
    """Label the curves at their right ends (x, y), one label below the other, with leader lines."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high)
    known = sorted((name for name, y in ends.items() if not math.isnan(y)), key=lambda name: ends[name])
    step = NAME_IN / (axes.get_figure(root=True).get_figheight() - 1.3)  # type: ignore[union-attr]
    heights = apart([(ends[name] - low) / (high - low) for name in known], step)
    for name, height in zip(known, heights, strict=True):
        leader = {"arrowstyle": "-", "color": styles[name].color, "linewidth": 0.8, "relpos": (0, 0.5)}
        leader |= {"patchA": None, "shrinkA": 2, "shrinkB": 4}
        axes.annotate(
            name, (x, ends[name]), (1.09, height), textcoords="axes fraction", va="center", fontsize=8,
            annotation_clip=False, arrowprops=leader,
        )  # fmt: skip


def apart(wanted: Sequence[float], step: float) -> list[float]:
    """Ascending places in 0 to 1, at least a step apart where there is room; neighbours that collide move together."""
    groups: list[list[float]] = []

    def middle(group: list[float]) -> float:
        half = (len(group) - 1) / 2 * step
        return min(max(sum(group) / len(group), half), max(1.0 - half, half))

    for place in wanted:
        groups.append([place])
        while len(groups) > 1 and middle(groups[-1]) - middle(groups[-2]) < step * sum(map(len, groups[-2:])) / 2:
            last = groups.pop()
            groups[-1] += last
    return [middle(group) + (i - (len(group) - 1) / 2) * step for group in groups for i in range(len(group))]


def precision_recall_curves(rows: Sequence[Row]) -> Figure:
    """Draw precision over recall in clean frames of each method whose row has curves, a panel per IoU."""
    styles = styles_of(methods_of(rows))
    with figure_style():
        figure, parts = panels(WIDTH_IN, 3.8, columns=2)
        for axes, iou in zip(parts, IOUS, strict=True):
            for method, style in styles.items():
                row = find_row(rows, method, CLEAN)
                if row is None or row.result is None or ("bev", iou) not in row.result.curves:
                    continue
                curve = row.result.curves["bev", iou]
                recall, precision = envelope(curve.recall, curve.precision)
                axes.plot(
                    recall[:-1], precision[:-1], color=style.color, linestyle=style.dashes, linewidth=2, label=method
                )
                axes.plot(curve.recall, curve.precision, color=style.color, linewidth=0.7, alpha=0.5)
            axes.set(xlim=(0, 1), ylim=(0, 1.02), xlabel="recall", title=f"IoU {iou}")
        parts[0].set_ylabel(f"precision, {condition_title(CLEAN)} (bird's-eye IoU)")
        add_legend(figure, parts[0])
    return figure


def reliability_curves(rows: Sequence[Row]) -> Figure:
    """Draw precision over score in clean frames, a curve for each method whose row has curves."""
    found = {}
    for method in methods_of(rows):
        row = find_row(rows, method, CLEAN)
        if row is not None and row.result is not None and IOU in row.result.curves:
            curve = row.result.curves[IOU]
            found[method] = reliability(curve.score, np.diff(curve.recall, prepend=0.0) > 0.0)
    return draw_reliability(found, styles_of(methods_of(rows)), "precision, clean (bird's-eye IoU 0.5)")


def draw_reliability(found: Mapping[str, Reliability], styles: Mapping[str, Style], ylabel: str) -> Figure:
    """Draw precision over score, a curve of each name with its ECE; dots grow with the number of detections."""
    with figure_style():
        figure, (axes,) = panels(0.7 * WIDTH_IN, 4.0)
        axes.plot([0, 1], [0, 1], color="0.6", linewidth=0.8)
        for name, bins in found.items():
            style, label = styles[name], f"{name}, ECE {100 * bins.error:.1f} %"
            axes.plot(bins.score, bins.precision, color=style.color, linestyle=style.dashes, linewidth=2, label=label)
            size = 8.0 + 120.0 * bins.count / max(bins.count.max(), 1)
            axes.scatter(bins.score, bins.precision, s=size, color=style.color, zorder=3, clip_on=False)
        axes.set(xlim=(0, 1), ylim=(0, 1.02), xlabel="score; dots grow with the number of detections", ylabel=ylabel)
        add_legend(figure, axes)
    return figure


def training_curves(epochs: Sequence[Mapping[str, str]], title: str = "") -> Figure:
    """Draw the parts of the loss, average precision and learning rate over the epochs.

    Precisions on validation frames are named `val/ap_...`; on training frames, where none are held out, `train/ap_...`.

    Args:
        epochs: rows of a training's `metrics.csv`; numbers may be empty or missing.
    """
    names = list(dict.fromkeys(name for row in epochs for name in row))
    precisions = [name for name in names if name.startswith(("val/ap_", "train/ap_"))]
    others = ("train/loss", "train/heading", *precisions)
    where = {name.partition("/")[0] for name in precisions}
    on = "training frames" if where == {"train"} else "validation frames"
    shown_in = {
        "Loss, each part with its weight": [n for n in names if n.startswith("train/") and n not in others],
        f"Average precision on {on}, %": precisions,
        "Learning rate": ["lr"],
    }
    with figure_style():
        figure, axes = panels(13.0, 3.8, columns=3, title=title)
        for panel, (heading, shown) in zip(axes, shown_in.items(), strict=True):
            scale = 100.0 if heading.endswith("%") else 1.0
            for name, style in styles_of(shown).items():
                known = [(int(row["epoch"]) + 1, scale * float(row[name])) for row in epochs if row.get(name)]
                label = name.partition("/")[2].replace("_", " ")
                label = f"IoU 0.{label[-2:-1]}, bird's eye" if label.startswith("ap bev ") else label
                panel.plot(*zip(*known, strict=True), label=label, **{**style.line(), "markersize": 4.0})
            panel.set(title=heading, xlabel="epoch")
            panel.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
            if len(shown) > 1:
                panel.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
        axes[0].set_yscale("log")
        axes[1].set_ylim(0, 100)
        axes[2].set_ylim(bottom=0)
    return figure
