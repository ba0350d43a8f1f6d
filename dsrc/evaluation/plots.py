"""Figures of results: AP per condition, mCE against mean AP, precision over recall, AP over a swept quantity.

A method has one style in all figures of a result. Markers and names at the lines distinguish methods in grey too; bars
are in the order of their legend.
"""

import io
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from dsrc.evaluation.metrics.ap import envelope, metric_name
from dsrc.evaluation.metrics.intervals import IOUS, Difference
from dsrc.evaluation.results import CLEAN, MCE, MEAN_AP, Row, condition_title, conditions_of, find_row, methods_of
from dsrc.evaluation.table import ResultTable, Stat

COLORS = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#6B6B6B",
    "#882255", "#332288", "#999933", "#000000",
)  # fmt: skip
"""Colours for any colour vision: seven of Okabe and Ito (2008), then of Tol's muted scheme (2021), and black."""
_INK, _GRID, _FRAME = "#22272E", "#E3E6EA", "#9AA3AD"
_MARKERS = "osD^vPX<>"
_DASHES = ("-", "--", ":")
_MOST_BARS = 6
_NAME_IN = 0.17  # from a line of 8 points to the next
_WIDTH_IN = 9.0
"""Width of most figures: nine hundred pixels, as wide as a README, leave letters of 8 points legible."""


class Style(NamedTuple):
    """Style of a method in figures.

    Attributes:
        color: of its lines, markers and bars.
        marker: of its points.
        dashes: of its lines.
        face: inside its markers.
    """

    color: str
    marker: str
    dashes: str
    face: str

    def line(self) -> dict[str, Any]:
        """Arguments of matplotlib for a line with markers."""
        return {**self.point(), "linestyle": self.dashes, "linewidth": 1.6}

    def point(self) -> dict[str, Any]:
        """Arguments of matplotlib for markers alone."""
        shape = {"marker": self.marker, "markersize": 6.5, "markerfacecolor": self.face, "markeredgewidth": 1.2}
        return {"color": self.color, "linestyle": "", **shape}

    def bar(self) -> dict[str, Any]:
        """Arguments of matplotlib for bars: hatched where the markers are hollow."""
        return {"facecolor": self.color, "edgecolor": "white", "hatch": "" if self.face == self.color else "///"}


def styles_of(methods: Sequence[str]) -> dict[str, Style]:
    """Styles of all methods of a result, no two alike; figures of some methods take theirs from it."""
    styles = {}
    for i, method in enumerate(dict.fromkeys(methods)):
        turn, color = i // len(COLORS), COLORS[i % len(COLORS)]
        styles[method] = Style(
            color,
            _MARKERS[i % len(_MARKERS)],
            _DASHES[turn % len(_DASHES)],
            "white" if turn % 2 else color,
        )
    return styles


@contextmanager
def figure_style() -> Iterator[None]:
    """Set matplotlib's style while a figure is made and drawn; global settings stay unchanged."""
    style: dict[Any, Any] = {
        "font.family": "DejaVu Sans",
        "font.size": 9,
        "text.color": _INK,
        "axes.labelcolor": _INK,
        "axes.edgecolor": _FRAME,
        "axes.titlesize": 10,
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
        "legend.fontsize": 8.5,
        "figure.titlesize": 11,
        "figure.titleweight": "bold",
        "figure.facecolor": "white",
    }
    with mpl.rc_context(style):
        yield


def panels(width: float, height: float, rows: int = 1, columns: int = 1, title: str = "") -> tuple[Figure, list[Axes]]:
    """Figure of a size, inches, and its panels row by row."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, x=0.01, ha="left")
    return figure, list(figure.subplots(rows, columns, squeeze=False).ravel())


def table_heatmap(sheet: ResultTable) -> Figure:
    """Draw a table's columns of AP as a heat map with numbers, a panel per IoU; the best of a column is bold."""
    shown = [i for i, column in enumerate(sheet.columns) if column.better == "high" and len(column.parts) == len(IOUS)]
    values = [[[line.cells[i][part].mean for i in shown] for line in sheet.lines] for part in range(len(IOUS))]
    return _map(sheet.title, [line.title for line in sheet.lines], [sheet.columns[i].title for i in shown], values)


_CMAP = "cividis"
"""Colour map of even steps of lightness, for any colour vision and in grey."""


def _map(
    title: str, lines: Sequence[str], columns: Sequence[str], values: Sequence[Sequence[Sequence[float]]]
) -> Figure:
    """Draw a heat map of (IoU, line, column) AP; a column of means stands apart."""
    percent = 100 * np.array(values, float).reshape(len(IOUS), len(lines), len(columns))
    known = percent[np.isfinite(percent)]
    scale = Normalize(*((known.min(), known.max()) if known.size else (0.0, 100.0)))
    places = np.arange(len(columns)) + 0.25 * np.isin(columns, ["mAP", "mean AP"])
    with figure_style():
        figure, parts = panels(_WIDTH_IN, 1.9 + 0.24 * len(lines), columns=2, title=title)
        for axes, iou, numbers in zip(parts, IOUS, percent, strict=True):
            for x, column in zip(places, numbers.T, strict=True):
                texts = ["-" if math.isnan(value) else f"{value:.1f}" for value in column]
                best = f"{max(column, key=lambda value: -math.inf if math.isnan(value) else value):.1f}"
                for y, (value, text) in enumerate(zip(column, texts, strict=True)):
                    _cell(axes, x, y, scale(value), text, bold=text == best and len(lines) > 1)
            axes.set(xlim=(-0.5, max(places, default=0.0) + 0.5), ylim=(max(len(lines), 1) - 0.5, -0.5))
            axes.set_title(f"IoU {iou}")
            names = [column.replace(", ", "\n") for column in columns]
            turned = {"rotation": 45, "ha": "right", "rotation_mode": "anchor"} if len(columns) > 4 else {}
            axes.set_xticks(places, names, **turned)  # type: ignore[arg-type]
            axes.set_yticks(range(len(lines)), lines if axes is parts[0] else [""] * len(lines))
            axes.tick_params(length=0)
            axes.grid(visible=False)
            axes.spines[:].set_visible(False)
        bar = figure.colorbar(ScalarMappable(scale, _CMAP), ax=parts, fraction=0.02, pad=0.01)
        bar.set_label("average precision, %")
        bar.outline.set_visible(False)  # type: ignore[operator]
    return figure


def _cell(axes: Axes, x: float, y: float, value: float, text: str, *, bold: bool) -> None:
    """Draw a number on its colour, in black or white, whichever is legible; a missing one on white."""
    color = (1.0, 1.0, 1.0) if text == "-" else mpl.colormaps[_CMAP](float(value))[:3]
    axes.add_patch(Rectangle((x - 0.48, y - 0.46), 0.96, 0.92, color=color, linewidth=0))
    ink = "white" if np.dot(color, (0.299, 0.587, 0.114)) < 0.5 else "black"
    weight = "bold" if bold else "normal"
    axes.text(x, y, text, ha="center", va="center", fontsize=7.5, color=ink, fontweight=weight)


def corruption_bars(rows: Sequence[Row], styles: Mapping[str, Style] | None = None, title: str = "") -> Figure:
    """Draw AP as bars, a panel per IoU, a group per condition, a bar per method; many methods as a heat map."""
    methods, conditions = methods_of(rows), conditions_of(rows)
    title = title or "Detection under corruption (bird's-eye IoU)"
    titles = [condition_title(c) for c in conditions]
    values = [
        [[_metric(find_row(rows, m, c), metric_name("bev", iou)) for c in conditions] for m in methods] for iou in IOUS
    ]
    if len(methods) > _MOST_BARS:
        return _map(title, methods, titles, values)
    styles = styles or styles_of(methods)
    with figure_style():
        figure, parts = panels(_WIDTH_IN, 5.2, rows=2, title=title)
        for axes, iou, of_methods in zip(parts, IOUS, values, strict=True):
            series = {method: [Stat(value) for value in line] for method, line in zip(methods, of_methods, strict=True)}
            _grouped(axes, titles, series, [styles[m].bar() for m in methods])
            axes.set_title(f"IoU {iou}")
            axes.set_ylabel("average precision, %")
        _legend(figure, parts[0], below=True)
    return figure


def mean_bars(rows: Sequence[Row], title: str = "") -> Figure:
    """Draw AP under each condition as the mean over all methods, as the paper's Figure 4."""
    methods, conditions = methods_of(rows), conditions_of(rows)
    with figure_style():
        figure, (axes,) = panels(_WIDTH_IN, 3.4, title=title)
        series = {}
        for iou in IOUS:
            found = [[_metric(find_row(rows, m, c), metric_name("bev", iou)) for m in methods] for c in conditions]
            series[f"IoU {iou}"] = [Stat(sum(values) / max(len(values), 1)) for values in found]
        _grouped(axes, [condition_title(c) for c in conditions], series, _SHADES[::2])
        axes.set_ylabel(f"AP, %, mean of {len(methods)} methods")
        _legend(figure, axes, below=True)
    return figure


_SHADES = [{"facecolor": color} for color in ("#9CC7E4", "#4A93C4", "#0B4F80")]
"""Fills of bars that are not methods: one hue, from light to dark."""


def table_bars(sheet: ResultTable) -> Figure:
    """Draw the columns of a table of AP as bars, a group per line, a panel per IoU."""
    with figure_style():
        figure, parts = panels(_WIDTH_IN, 5.2, rows=2, title=sheet.title)
        for part, (axes, iou) in enumerate(zip(parts, IOUS, strict=True)):
            series = {c.title: [line.cells[k][part] for line in sheet.lines] for k, c in enumerate(sheet.columns)}
            _grouped(axes, [line.label for line in sheet.lines], series, _SHADES)
            axes.set_title(f"IoU {iou}")
            axes.set_ylabel("average precision, %")
        _legend(figure, parts[0], below=True)
    return figure


def _grouped(
    axes: Axes, groups: Sequence[str], series: Mapping[str, Sequence[Stat]], fills: Sequence[Mapping[str, Any]]
) -> None:
    """Draw a bar of each series in each group, in percent, with its number above it and its spread where known."""
    width = 0.84 / max(len(series), 1)
    for i, ((name, stats), fill) in enumerate(zip(series.items(), fills, strict=True)):
        places = [group + (i - (len(series) - 1) / 2) * width for group in range(len(groups))]
        heights, spreads = [100 * s.mean for s in stats], [100 * s.spread for s in stats]
        known = None if all(map(math.isnan, spreads)) else spreads
        axes.bar(places, heights, 0.92 * width, yerr=known, ecolor=_INK, capsize=2, label=name, **fill)
        for x, height, spread in zip(places, heights, spreads, strict=True):
            if not math.isnan(height):
                top = height + (0.0 if math.isnan(spread) else spread) + 1.2
                text = f"{height:.1f}" if len(groups) * len(series) <= 24 else f"{height:.0f}"
                axes.text(x, top, text, ha="center", va="bottom", fontsize=7)
    axes.set_xticks(range(len(groups)), [name if "+" in name else name.replace(" ", "\n", 1) for name in groups])
    axes.tick_params(axis="x", length=0)
    axes.grid(visible=False, axis="x")
    axes.set(ylim=(0, 108), yticks=range(0, 101, 20))


def table_lines(
    sheet: ResultTable, label: str, places: Sequence[float], styles: Mapping[str, Style] | None = None
) -> Figure:
    """Draw the first columns of a table over their places, a curve per line with its name at its end, a panel per IoU.

    Args:
        sheet: table of AP at IoU 0.5 and 0.7.
        label: of the horizontal axis.
        places: of the columns on it.
        styles: of the lines.
    """
    columns = len(places)
    styles = styles or styles_of([line.label for line in sheet.lines])
    ticks = [column.title.replace(", ", "\n").replace(" + ", "\n+ ") for column in sheet.columns[:columns]]
    with figure_style():
        figure, parts = panels(_WIDTH_IN, max(4.0, 1.5 + _NAME_IN * len(sheet.lines)), columns=2, title=sheet.title)
        for part, (axes, iou) in enumerate(zip(parts, IOUS, strict=True)):
            for line in sheet.lines:
                stats = [cell[part] for cell in line.cells[:columns]]
                spreads = [100 * s.spread for s in stats]
                axes.errorbar(
                    places, [100 * s.mean for s in stats],
                    yerr=None if all(map(math.isnan, spreads)) else spreads,
                    capsize=2.5, label=line.label, **styles[line.label].line(),
                )  # fmt: skip
            axes.set_xticks(places, ticks)
            axes.set_title(f"IoU {iou}")
            axes.set_xlabel(label)
            ends = {line.label: 100 * line.cells[columns - 1][part].mean for line in sheet.lines}
            _name_ends(axes, places[-1], ends, styles)
        parts[0].set_ylabel("average precision, %")
    return figure


def _name_ends(axes: Axes, x: float, ends: Mapping[str, float], styles: Mapping[str, Style]) -> None:
    """Label the curves at their right ends (x, y), one label below the other, with leader lines."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high)
    known = sorted((name for name, y in ends.items() if not math.isnan(y)), key=lambda name: ends[name])
    step = _NAME_IN / (axes.get_figure(root=True).get_figheight() - 1.3)  # type: ignore[union-attr]
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


def difference_dots(differences: Sequence[Difference], title: str = "") -> Figure:
    """Draw differences with their intervals, a row of panels per pair, a panel per IoU, a line per condition.

    The upper bar of a line is the interval by frame, the lower one that by drive; dots are full where both exclude 0.
    """
    pairs = list(dict.fromkeys((one.method, one.baseline) for one in differences))
    conditions = list(dict.fromkeys(one.condition for one in differences))
    height = 0.9 + len(pairs) * (0.8 + 0.24 * len(conditions))
    with figure_style():
        figure, parts = panels(_WIDTH_IN, height, rows=max(len(pairs), 1), columns=len(IOUS), title=title)
        wanted = [(pair, iou) for pair in pairs for iou in IOUS]
        for axes, (pair, iou) in zip(parts, wanted, strict=False):
            shown = [one for one in differences if (one.method, one.baseline) == pair and one.iou == iou]
            axes.axvline(0.0, color=_INK, linewidth=0.9)
            for y, one in enumerate(shown):
                _interval(axes, y, one, named=y == 0)
            first = iou == IOUS[0]
            axes.set_yticks(range(len(shown)), [condition_title(one.condition) if first else "" for one in shown])
            axes.set(ylim=(len(conditions) - 0.5, -0.5))
            axes.set_title(f"{pair[0]} minus\n{pair[1]}, IoU {iou}")
            axes.grid(visible=False, axis="y")
        for axes in parts[-len(IOUS) :]:
            axes.set_xlabel("difference, points of AP (mCE: less is better)")
        _legend(figure, parts[0], below=True)
    return figure


def _interval(axes: Axes, y: float, one: Difference, *, named: bool) -> None:
    """Draw a difference and its two intervals, in points."""
    for bounds, off, style, label in (
        (one.by_frame, -0.14, _SHADES[1], "95 % interval by frame"),
        (one.by_drive, 0.14, _SHADES[2], "95 % interval by drive"),
    ):
        ends = [100 * bounds.low, 100 * bounds.high]
        color = style["facecolor"]
        axes.plot(
            ends, [y + off] * 2, color=color, linewidth=2.6, label=label if named else None, solid_capstyle="butt"
        )
    face = _INK if one.resolved else "white"
    axes.plot([100 * one.value.mean], [y], "o", color=_INK, markersize=5, markerfacecolor=face, markeredgewidth=1.2)


def traffic_scatter(
    points: Mapping[str, tuple[float, float, float]], styles: Mapping[str, Style] | None = None, title: str = ""
) -> Figure:
    """Draw AP against bytes sent, a panel per IoU.

    Args:
        points: kB per frame, AP at IoU 0.5 and AP at 0.7, by method.
        styles: of the methods.
        title: of the figure.
    """
    styles = styles or styles_of(list(points))
    with figure_style():
        figure, parts = panels(_WIDTH_IN, max(3.8, 0.6 + 0.19 * len(points)), columns=2, title=title)
        for part, (axes, iou) in enumerate(zip(parts, IOUS, strict=True)):
            for name, values in points.items():
                axes.plot([values[0]], [100 * values[1 + part]], label=name, **styles[name].point())
            axes.margins(0.15)
            axes.set_xscale("symlog", linthresh=0.1)
            axes.set_xlim(-0.05, 10.0 * max([0.1, *(sent for sent, *_ in points.values())]))
            axes.set_title(f"IoU {iou}")
            axes.set_xlabel("kB sent per frame by all collaborators")
        parts[0].set_ylabel("average precision, %")
        _legend(figure, parts[0])
    return figure


def robustness_scatter(rows: Sequence[Row], styles: Mapping[str, Style] | None = None, title: str = "") -> Figure:
    """Draw mean AP over clean and all corruptions against mCE, one panel per IoU, as the paper's Figure 5."""
    methods = methods_of(rows)
    styles = styles or styles_of(methods)
    with figure_style():
        figure, parts = panels(_WIDTH_IN, max(3.8, 0.6 + 0.19 * len(methods)), columns=2, title=title)
        for axes, iou in zip(parts, IOUS, strict=True):
            name = metric_name("bev", iou)
            for method in methods:
                x = _metric(find_row(rows, method, MCE), name)
                y = _metric(find_row(rows, method, MEAN_AP), name)
                if not (math.isnan(x) or math.isnan(y)):
                    axes.plot([100 * x], [100 * y], label=method, **styles[method].point())
            axes.margins(0.15)
            axes.set_title(f"IoU {iou}")
            axes.set_xlabel("mCE, % of the clean AP lost (left is better)")
        parts[0].set_ylabel("mean AP, %, bird's-eye IoU (up is better)")
        _legend(figure, parts[0])
    return figure


def precision_recall_curves(rows: Sequence[Row]) -> Figure:
    """Draw precision over recall in clean frames of each method whose row has curves, a panel per IoU."""
    styles = styles_of(methods_of(rows))
    with figure_style():
        figure, parts = panels(_WIDTH_IN, 3.8, columns=2)
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
        _legend(figure, parts[0])
    return figure


def training_curves(epochs: Sequence[Mapping[str, str]], title: str = "") -> Figure:
    """Draw the parts of the loss, average precision and learning rate over the epochs.

    Precisions on validation frames are named `val/ap_...`; on training frames, where none are held out, `train/ap_...`.

    Args:
        epochs: rows of a training's `metrics.csv`; numbers may be empty or missing.
        title: of the figure.
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


def png_bytes(figure: Figure, made_by: Mapping[str, Any] | None = None, dpi: int = 150) -> bytes:
    """PNG of a figure; `made_by` goes into its description, where image tools show it."""
    description = json.dumps(made_by or {}, sort_keys=True)
    buffer = io.BytesIO()
    with figure_style():
        figure.savefig(buffer, format="png", dpi=dpi, metadata={"Description": description})
    return buffer.getvalue()


def _legend(figure: Figure, axes: Axes, *, below: bool = False) -> None:
    """Add a legend outside the panels, at their right or below them."""
    handles, labels = axes.get_legend_handles_labels()
    if handles and below:
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(handles), 4))
    elif handles:
        figure.legend(handles, labels, loc="outside right upper")


def _metric(row: Row | None, name: str) -> float:
    return math.nan if row is None else row.metrics.get(name, math.nan)
