"""Table, plots and files of the gauge of realism."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dsrc.realism.figures import FIGURES, FigureOf, Samples
from dsrc.realism.gauge import Row, counts_of, families_of
from dsrc.tables.figure import COLORS, INK, WIDTH_IN, figure_style, panels, write_figure
from dsrc.tables.files import csv_text, json_text
from dsrc.tables.table import Column, Table, TableRow
from sim.files import write_file

RESULTS = "realism.json"
_COLUMNS = 4
_PANEL_IN = 1.75


def realism_table(rows: Sequence[Row]) -> Table:
    """Table of figures by family, real and simulated values side by side."""
    columns = (
        Column("figure", align="left"),
        Column("real"),
        Column("simulated"),
        Column("distance"),
        Column("interval"),
        Column("halves"),
        Column("spreads"),
    )
    lines = []
    for row in rows:
        title = f"{row.figure.title}, {row.figure.unit}" if row.figure.unit else row.figure.title
        interval = f"{_number(row.low)}-{_number(row.high)}"
        values = _number(row.distance), interval, _number(row.halves), _number(row.relative)
        lines.append(TableRow(row.figure.family, (title, _number(row.real[1]), _number(row.simulated[1]), *values)))
    caption = (
        "Values: median. Distance: Wasserstein's, with its 95 % interval; halves: between halves of the real sweeps; "
        "spreads: the distance in standard deviations of the real figure; none where the real values are all alike, or "
        "one each of fewer than four sweeps."
    )
    return Table("realism", "Real and simulated sweeps", "family", columns, tuple(lines), caption=caption, grouped=True)


def family_table(rows: Sequence[Row]) -> Table:
    """Table of one number per family: the mean distance in spreads of the real figures."""
    counts = counts_of(rows)
    return Table.of(
        ("family", "in spreads", "of figures"),
        [
            (family, _number(value), f"{counts[family][0]} of {counts[family][1]}")
            for family, value in families_of(rows).items()
        ],
        name="families",
        title="Distance by family",
    )


def distributions(real: Sequence[Samples], simulated: Sequence[Samples]) -> Figure:
    """Draw the distribution of each figure that real or simulated sweeps have."""
    shown = [figure for figure in FIGURES if any(figure.name in one for one in (*real, *simulated))]
    count = math.ceil(len(shown) / _COLUMNS)
    with figure_style():
        figure, all_axes = panels(WIDTH_IN, 0.6 + _PANEL_IN * count, count, _COLUMNS, "Real and simulated sweeps")
        for axes in all_axes[len(shown) :]:
            axes.set_visible(False)
        for one, axes in zip(shown, all_axes, strict=False):
            _draw(axes, one, real, simulated)
        figure.legend(*all_axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def write_realism(
    out: Path,
    rows: Sequence[Row],
    real: Sequence[Samples],
    simulated: Sequence[Samples],
    made_by: Mapping[str, object],
) -> None:
    """Write `realism.json`, `realism.csv`, `realism.md` and `realism.png` into a folder."""
    records = [
        {
            "family": row.figure.family,
            "figure": row.figure.name,
            "unit": row.figure.unit,
            "real_sweeps": row.sweeps[0],
            "simulated_sweeps": row.sweeps[1],
            **{f"real_{name}": value for name, value in zip(("10", "50", "90"), row.real, strict=True)},
            **{f"simulated_{name}": value for name, value in zip(("10", "50", "90"), row.simulated, strict=True)},
            "distance": row.distance,
            "low": row.low,
            "high": row.high,
            "halves": _known(row.halves),
            "spreads": _known(row.relative),
        }
        for row in rows
    ]
    families = {family: _known(value) for family, value in families_of(rows).items()}
    write_file(out / RESULTS, json_text({"provenance": made_by, "families": families, "figures": records}))
    write_file(out / "realism.csv", csv_text(records, list(records[0]) if records else []))
    write_file(out / "realism.md", f"{family_table(rows).markdown()}\n{realism_table(rows).markdown()}")
    write_figure(out / "realism.png", distributions(real, simulated), made_by)


def _draw(axes: Axes, figure: FigureOf, real: Sequence[Samples], simulated: Sequence[Samples]) -> None:
    """Draw the share of values below each value: thin for each sweep of several values, thick for all."""
    for color, label, sweeps in ((INK, "real", real), (COLORS[1], "simulated", simulated)):
        samples = [np.sort(sweep[figure.name]) for sweep in sweeps if figure.name in sweep]
        for sample in samples:
            if len(sample) > 1:
                axes.plot(sample, np.linspace(0.0, 1.0, len(sample)), color=color, alpha=0.15, linewidth=0.6)
        if samples:
            weights = np.concatenate([np.full(len(one), 1.0 / len(one)) for one in samples])
            values = np.concatenate(samples)
            order = np.argsort(values)
            below = np.concatenate([[0.0], np.cumsum(weights[order]) / weights.sum()])
            steps = values[order][[0, *range(len(order))]]
            axes.step(steps, below, color=color, linewidth=1.6, label=label, where="post")
    axes.set_title(figure.title if figure.family == figure.name else f"{figure.family}: {figure.title}", fontsize=7.5)
    axes.set_xlabel(figure.unit, fontsize=7)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.tick_params(labelsize=7)
    axes.set_ylim(0.0, 1.0)


def _number(value: float) -> str:
    return "-" if not math.isfinite(value) else f"{value:.2f}" if abs(value) >= 0.1 or value == 0.0 else f"{value:.2g}"


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
