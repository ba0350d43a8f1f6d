"""How the pictures and tables of the examples look: one dark style, PNG files small enough for a repository."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize, to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from dsrc.tables.document import replace_block
from dsrc.tables.table import Table

PAGE, PANEL, EMPTY, GRID, FAINT, INK = "#11151B", "#171C24", "#0A0D11", "#2B333F", "#8D99A8", "#E4E9EF"
COLORS = ("#4FB3FF", "#FFB454", "#5EDC9A", "#FF7B8A", "#C7A0FF", "#F2E96B", "#9FB0C3")
HIGHLIGHT = "#FF8A3D"
DPI = 110


@contextmanager
def style() -> Iterator[None]:
    """Set the look while a figure is made and saved; global settings stay as they were."""
    look: dict[Any, Any] = {
        "font.family": "DejaVu Sans",
        "font.size": 9,
        "text.color": INK,
        "axes.labelcolor": INK,
        "axes.titlecolor": INK,
        "axes.facecolor": PANEL,
        "axes.edgecolor": GRID,
        "axes.titlesize": 9.5,
        "axes.titlelocation": "left",
        "axes.axisbelow": True,
        "grid.color": GRID,
        "grid.linewidth": 0.6,
        "xtick.color": FAINT,
        "ytick.color": FAINT,
        "xtick.labelsize": 8,
        "ytick.labelsize": 8,
        "legend.frameon": False,
        "legend.fontsize": 8,
        "figure.facecolor": PAGE,
        "savefig.facecolor": PAGE,
    }
    with mpl.rc_context(look):
        yield


def new_figure(width: float, height: float, title: str, note: str = "") -> Figure:
    """Return an empty figure, inches, with a title line and a fainter one below it."""
    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title + ("\n" if note else ""), x=0.012, ha="left", fontsize=12, fontweight="bold")
    if note:
        figure.text(0.0125, 1.0 - 0.42 / height, note, ha="left", va="center", fontsize=8.5, color=FAINT)
    return figure


def part_of(name: str, start: float, end: float) -> Colormap:
    """Return a part of a named colour map: one that stands out from the dark."""
    return LinearSegmentedColormap.from_list(name, mpl.colormaps[name](np.linspace(start, end, 256)))


def colorbar(
    axes: Axes, norm: Normalize, cmap: str | Colormap, label: str, ticks: Sequence[float] | None = None
) -> None:
    """State the colour scale of a panel beside it."""
    scale = ScalarMappable(norm, cmap)
    bar = axes.figure.colorbar(scale, ax=axes, pad=0.012, fraction=0.03, aspect=28)
    if ticks is not None:
        bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
        bar.minorticks_off()
    bar.set_label(label, fontsize=8)
    bar.outline.set_visible(False)  # type: ignore[operator]
    bar.ax.tick_params(labelsize=7.5, length=2)


def save(figure: Figure, path: Path, colors: int | None = None, keep: Sequence[str] = ()) -> Path:
    """Write a PNG; one of 256 colours takes a third of the room of one with all of them.

    Args:
        figure: to draw.
        path: of the PNG.
        colors: how many; all when left out.
        keep: colours that stay exactly what they are, such as those of a legend.
    """
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels: NDArray[np.uint8] = np.asarray(canvas.buffer_rgba())[..., :3]
    image = Image.fromarray(np.ascontiguousarray(pixels))
    if colors is not None:
        palette = image.quantize(colors - len(keep), Image.Quantize.MEDIANCUT, kmeans=2)
        found = palette.getpalette() or []
        exact = [round(255 * part) for color in keep for part in to_rgb(color)]
        palette.putpalette([*exact, *found[: 3 * (colors - len(keep))]])
        image = image.quantize(palette=palette, dither=Image.Dither.NONE)
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save(path, optimize=True)
    return path


def put_table(document: Path | None, name: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a Markdown table, or write it between the lines `<!-- begin NAME -->` and `<!-- end ...` of a document."""
    text = Table.of(head, rows, len(head)).markdown().rstrip()
    if document is None:
        print(text)
        return
    replace_block(document, name, text)
