"""Figures of a result: AP per corruption, mCE against mean AP, precision over recall, AP over whatever is varied."""

import io
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from dsrc.evaluation.ap import Space, envelope, metric_name
from dsrc.evaluation.rows import CLEAN, MCE, MEAN_AP, Row, condition_title, conditions_of, find_row, methods_of
from dsrc.evaluation.sheets import Sheet

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#6B6B6B")
"""One colour per method, distinct with any colour vision (Okabe and Ito 2008)."""
_INK, _GRID = "#22272E", "#E3E6EA"
_MARKERS = "osD^vPX"


@contextmanager
def styled() -> Iterator[None]:
    """Set the look while a figure is made and drawn; global settings stay as they were."""
    look: dict[Any, Any] = {
        "font.family": "DejaVu Sans",
        "font.size": 10,
        "text.color": _INK,
        "axes.labelcolor": _INK,
        "axes.edgecolor": "#9AA3AD",
        "axes.titlesize": 11,
        "axes.titleweight": "bold",
        "axes.titlelocation": "left",
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.axisbelow": True,
        "axes.grid": True,
        "grid.color": _GRID,
        "xtick.color": _INK,
        "ytick.color": _INK,
        "legend.frameon": False,
        "figure.facecolor": "white",
    }
    with mpl.rc_context(look):
        yield


def panels(width: float, height: float, rows: int = 1, columns: int = 1) -> tuple[Figure, list[Axes]]:
    """Return a figure of a size, inches, and its panels row by row."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(rows, columns, squeeze=False).ravel())


def corruption_bars(rows: Sequence[Row], space: Space = "bev") -> Figure:
    """Draw AP at IoU 0.5 (light) and, inside it, at 0.7 (dark): a group per condition, a bar per method."""
    methods, conditions = methods_of(rows), conditions_of(rows)
    width = 0.8 / max(len(methods), 1)
    with styled():
        figure, (axes,) = panels(min(12.0, max(7.0, 1.0 + 0.6 * len(conditions) * len(methods) ** 0.75)), 4.2)
        for i, method in enumerate(methods):
            color = method_color(i)
            place = [c + (i - (len(methods) - 1) / 2) * width for c in range(len(conditions))]
            found = [find_row(rows, method, condition) for condition in conditions]
            for threshold, shade in ((0.5, _tint(color)), (0.7, color)):
                heights = [_metric(row, metric_name(space, threshold)) for row in found]
                axes.bar(place, heights, width * 0.88, color=shade, linewidth=0)
                if threshold == 0.5 and len(methods) <= len(COLORS):
                    _label_bars(axes, place, heights, size=8 if len(methods) < 4 else 6)
        axes.set_xticks(range(len(conditions)), [condition_title(c) for c in conditions])
        axes.tick_params(axis="x", length=0)
        axes.grid(visible=False, axis="x")
        axes.set_ylim(0, 1.0)
        axes.set_ylabel("average precision")
        figure.suptitle(
            f"Detection under corruption ({_space_title(space)})", x=0.012, ha="left", fontsize=12, fontweight="bold"
        )
        handles = [Patch(color=method_color(i), label=method) for i, method in enumerate(methods)]
        handles += [Patch(color=_tint("#777777"), label="IoU 0.5"), Patch(color="#777777", label="IoU 0.7")]
        figure.legend(handles=handles, loc="outside lower left", ncols=min(len(handles), 6), fontsize=9)
    return figure


def mean_bars(rows: Sequence[Row], space: Space = "bev") -> Figure:
    """Draw AP under each condition as the mean over all methods, as the paper's Figure 4."""
    methods, conditions = methods_of(rows), conditions_of(rows)
    with styled():
        figure, (axes,) = panels(min(12.0, 2.0 + 0.9 * len(conditions)), 3.6)
        for threshold, shade in ((0.5, _tint(COLORS[0])), (0.7, COLORS[0])):
            name = metric_name(space, threshold)
            heights = [
                sum(_metric(find_row(rows, method, condition), name) for method in methods) / max(len(methods), 1)
                for condition in conditions
            ]
            axes.bar(range(len(conditions)), heights, 0.7, color=shade, linewidth=0, label=f"IoU {threshold}")
            _label_bars(axes, range(len(conditions)), heights, size=8)
        axes.set_xticks(range(len(conditions)), [condition_title(c) for c in conditions])
        axes.tick_params(axis="x", length=0)
        axes.grid(visible=False, axis="x")
        axes.set_ylim(0, 1.0)
        axes.set_ylabel(f"mean of {len(methods)} methods, AP")
        _legend_below(figure, axes)
    return figure


def lines_of_sheet(sheet: Sheet, label: str, places: Sequence[float]) -> Figure:
    """Draw the first columns of a sheet from left to right, a line per line, one panel per IoU.

    Args:
        sheet: whose cells are AP at IoU 0.5 and 0.7.
        label: of the horizontal axis.
        places: where each of them stands on it.
    """
    columns = len(places)
    ticks = [column.title.replace(", ", "\n").replace(" + ", "\n+ ") for column in sheet.columns[:columns]]
    with styled():
        figure, parts = panels(9.0, 4.4, columns=2)
        for part, (axes, threshold) in enumerate(zip(parts, (0.5, 0.7), strict=True)):
            for i, line in enumerate(sheet.lines):
                stats = [cell[part] for cell in line.cells[:columns]]
                spreads = [100 * s.spread for s in stats]
                axes.errorbar(
                    places, [100 * s.mean for s in stats],
                    yerr=None if all(map(math.isnan, spreads)) else spreads,
                    color=method_color(i), marker=method_marker(i), markersize=6, linewidth=1.8, capsize=2.5,
                    label=line.label,
                )  # fmt: skip
            axes.set_xticks(places, ticks)
            axes.set_title(f"IoU {threshold}")
            axes.set_xlabel(label)
        parts[0].set_ylabel("average precision, %")
        _legend_below(figure, parts[0])
    return figure


def traffic_scatter(points: Mapping[str, tuple[float, float, float]]) -> Figure:
    """Draw AP against what is sent, one panel per IoU.

    Args:
        points: by method kB per frame, AP at IoU 0.5 and AP at 0.7.
    """
    with styled():
        figure, parts = panels(9.0, 4.4, columns=2)
        for part, (axes, threshold) in enumerate(zip(parts, (0.5, 0.7), strict=True)):
            for i, (name, values) in enumerate(points.items()):
                axes.scatter(
                    [values[0]], [100 * values[1 + part]], s=80, color=method_color(i), marker=method_marker(i),
                    edgecolor="white", linewidth=0.8, label=name, zorder=3,
                )  # fmt: skip
            axes.margins(0.15)
            axes.set_xscale("symlog", linthresh=0.1)
            axes.set_xlim(-0.05, 10.0 * max([0.1, *(sent for sent, *_ in points.values())]))
            axes.set_title(f"IoU {threshold}")
            axes.set_xlabel("kB sent per frame by all collaborators")
        parts[0].set_ylabel("average precision, %")
        _legend_below(figure, parts[0])
    return figure


def robustness_scatter(rows: Sequence[Row], space: Space = "bev") -> Figure:
    """Draw mean AP over clean and all corruptions against mCE, one panel per IoU, as the paper's Figure 5."""
    methods = methods_of(rows)
    with styled():
        figure, parts = panels(9.0, 4.4, columns=2)
        for axes, threshold in zip(parts, (0.5, 0.7), strict=True):
            name = metric_name(space, threshold)
            for i, method in enumerate(methods):
                x = _metric(find_row(rows, method, MCE), name)
                y = _metric(find_row(rows, method, MEAN_AP), name)
                if math.isnan(x) or math.isnan(y):
                    continue
                axes.scatter(
                    [100 * x], [100 * y], s=90, color=method_color(i), marker=method_marker(i),
                    edgecolor="white", linewidth=0.8, label=method, zorder=3,
                )  # fmt: skip
            axes.margins(0.25)
            axes.set_title(f"IoU {threshold}")
            axes.set_xlabel("mCE, % of the clean AP lost (left is better)")
        parts[0].set_ylabel(f"mean AP, %, {_space_title(space)} (up is better)")
        _legend_below(figure, parts[0])
    return figure


def precision_recall_curves(rows: Sequence[Row], condition: str = CLEAN, space: Space = "bev") -> Figure:
    """Draw precision over recall of each method that still has its curves, one panel per IoU."""
    with styled():
        figure, parts = panels(9.0, 4.4, columns=2)
        for axes, threshold in zip(parts, (0.5, 0.7), strict=True):
            for i, method in enumerate(methods_of(rows)):
                row = find_row(rows, method, condition)
                if row is None or row.result is None or (space, threshold) not in row.result.curves:
                    continue
                curve = row.result.curves[space, threshold]
                recall, precision = envelope(curve.recall, curve.precision)
                axes.plot(recall[:-1], precision[:-1], color=method_color(i), linewidth=2, label=method)
                axes.plot(curve.recall, curve.precision, color=method_color(i), linewidth=0.7, alpha=0.5)
            axes.set(xlim=(0, 1), ylim=(0, 1.02), xlabel="recall", title=f"IoU {threshold}")
        parts[0].set_ylabel(f"precision, {condition_title(condition)} ({_space_title(space)})")
        _legend_below(figure, parts[0])
    return figure


def training_curves(epochs: Sequence[Mapping[str, str]]) -> Figure:
    """Draw the parts of the loss, the validations' average precision and the learning rate over the epochs.

    Args:
        epochs: rows of a training's `metrics.csv`; what an epoch lacks is empty or missing.
    """
    names = list(dict.fromkeys(name for row in epochs for name in row))
    parts = [name for name in names if name.startswith("train/") and name != "train/loss"]
    shown_in = {
        "loss, each part with its weight": parts,
        "average precision in validation": [name for name in names if name.startswith("val/ap_")],
        "learning rate": ["lr"],
    }
    with styled():
        figure, axes = panels(13.0, 3.8, columns=3)
        for panel, (title, shown) in zip(axes, shown_in.items(), strict=True):
            for i, name in enumerate(shown):
                known = [(int(row["epoch"]) + 1, float(row[name])) for row in epochs if row.get(name)]
                label = name.removeprefix("train/").removeprefix("val/").replace("_", " ")
                panel.plot(*zip(*known, strict=True), color=method_color(i), marker=".", label=label)
            panel.set(title=title, xlabel="epochs")
            if len(shown) > 1:
                panel.legend(fontsize=9)
        axes[0].set_yscale("log")
        axes[1].set_ylim(0, 1)
        axes[2].set_ylim(bottom=0)
    return figure


def png_bytes(figure: Figure, made_by: Mapping[str, Any] | None = None, dpi: int = 150) -> bytes:
    """Return a figure as PNG; `made_by` goes into its description, where image tools show it."""
    description = json.dumps(made_by or {}, sort_keys=True)
    buffer = io.BytesIO()
    with styled():
        figure.savefig(buffer, format="png", dpi=dpi, metadata={"Description": description})
    return buffer.getvalue()


def _legend_below(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(handles), 4), fontsize=9)


def _label_bars(axes: Axes, place: Sequence[float], heights: Sequence[float], size: float) -> None:
    for x, height in zip(place, heights, strict=True):
        if not math.isnan(height):
            axes.text(x, height + 0.008, f"{100 * height:.0f}", ha="center", va="bottom", fontsize=size)


def method_color(row: int) -> str:
    """Return the colour of the method in this row; the eighth has that of the first, darker, and so on."""
    darker = 0.55 ** (row // len(COLORS))
    red, green, blue = to_rgb(COLORS[row % len(COLORS)])
    return to_hex((red * darker, green * darker, blue * darker))


def method_marker(row: int) -> str:
    """Return the marker of the method in this row."""
    return _MARKERS[(row + row // len(_MARKERS)) % len(_MARKERS)]


def _tint(color: str, strength: float = 0.4) -> tuple[float, float, float]:
    """Return an opaque light version of a colour."""
    red, green, blue = to_rgb(color)
    return tuple(1 - strength * (1 - c) for c in (red, green, blue))  # type: ignore[return-value]


def _metric(row: Row | None, name: str) -> float:
    return math.nan if row is None else row.metrics.get(name, math.nan)


def _space_title(space: Space) -> str:
    return "bird's-eye IoU" if space == "bev" else "3D IoU"
