"""Figure of a report: style, panels, legend, and the PNG with its provenance.

A method has one style in all figures of a result. Markers and names at the lines distinguish methods in grey too; bars
are in the order of their legend.
"""

import io
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from sim.files import write_file

COLORS = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#6B6B6B",
    "#882255", "#332288", "#999933", "#000000",
)  # fmt: skip
"""Colours for any colour vision: seven of Okabe and Ito (2008), then of Tol's muted scheme (2021), and black."""
INK, _GRID, _FRAME = "#22272E", "#E3E6EA", "#9AA3AD"
_MARKERS = "osD^vPX<>"
_DASHES = ("-", "--", ":")
NAME_IN = 0.17  # from a line of 8 points to the next
WIDTH_IN = 9.0
"""Width of most figures: nine hundred pixels, as wide as a README, leave letters of 8 points legible."""
SHADES = [{"facecolor": color} for color in ("#9CC7E4", "#4A93C4", "#0B4F80")]
"""Fills of bars that are not methods: one hue, from light to dark."""


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
        "text.color": INK,
        "axes.labelcolor": INK,
        "axes.edgecolor": _FRAME,
        "axes.titlesize": 10,
        "axes.titleweight": "bold",
        "axes.titlelocation": "left",
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.axisbelow": True,
        "axes.grid": True,
        "grid.color": _GRID,
        "xtick.color": INK,
        "ytick.color": INK,
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


def add_legend(figure: Figure, axes: Axes, *, below: bool = False) -> None:
    """Add a legend outside the panels, at their right or below them."""
    handles, labels = axes.get_legend_handles_labels()
    if handles and below:
        rows = math.ceil(len(handles) / 5)
        columns = math.ceil(len(handles) / rows)  # full rows, where four beside one would stand else
        figure.legend(handles, labels, loc="outside lower center", ncols=columns)
    elif handles:
        figure.legend(handles, labels, loc="outside right upper")


def draw_cell(axes: Axes, x: float, y: float, color: Sequence[float], text: str, *, bold: bool) -> None:
    """Draw a cell of a heat map: a number on a colour, in black or white, whichever is legible."""
    axes.add_patch(Rectangle((x - 0.48, y - 0.46), 0.96, 0.92, color=color, linewidth=0))
    red, green, blue = color[:3]
    ink = "white" if 0.299 * red + 0.587 * green + 0.114 * blue < 0.5 else INK
    weight = "bold" if bold else "normal"
    axes.text(x, y, text, ha="center", va="center", fontsize=7.5, color=ink, fontweight=weight)


def png_bytes(figure: Figure, made_by: Mapping[str, object] | None = None, dpi: int = 150) -> bytes:
    """PNG of a figure; `made_by` goes into its description, where image tools show it."""
    description = json.dumps(made_by or {}, sort_keys=True)
    buffer = io.BytesIO()
    with figure_style():
        figure.savefig(buffer, format="png", dpi=dpi, metadata={"Description": description})
    return buffer.getvalue()


def write_figure(path: Path, figure: Figure, made_by: Mapping[str, object] | None = None, dpi: int = 150) -> None:
    """Write the PNG of a figure, see `png_bytes`; an interrupted one leaves what was there."""
    write_file(path, png_bytes(figure, made_by, dpi))
