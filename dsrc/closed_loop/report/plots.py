"""Figures of a campaign: collision rate and driving score by perception and corruption, over severity, delay and loss.

Rates have Wilson intervals, means bootstrap intervals, see `dsrc.closed_loop.metrics.statistics`. A perception has one
style in all figures.
"""

import math
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dsrc.closed_loop.campaign.episode import EpisodeResult
from dsrc.closed_loop.causes.cause import Cause
from dsrc.closed_loop.metrics.comparison import Result, Value, collided, counted, metric
from dsrc.closed_loop.metrics.statistics import Estimate, mean, paired_rates, rate
from dsrc.closed_loop.report.findings import counted_causes, joined_calibrations
from dsrc.evaluation.figures.curves import draw_reliability
from dsrc.evaluation.metrics.calibration import Reliability
from dsrc.evaluation.results import condition_title
from dsrc.tables.figure import COLORS, WIDTH_IN, Style, add_legend, draw_cell, figure_style, panels, styles_of
from sensors.corruptions import CLEAN
from sim.radio import IDEAL

_CMAP = "RdBu_r"
_LETTERS = 100
"""Letters that fit side by side below the axis of a figure."""


def driving_score(result: Result) -> float:
    """Return CARLA's driving score (2.1), 0 to 1."""
    return metric(result, "driving_score_2_1")


_SHOWN: tuple[tuple[str, Value, Callable[[Sequence[float]], Estimate]], ...] = (
    ("collision rate, %", collided, rate),
    ("driving score 2.1, %", driving_score, mean),
)
"""Axis label, function and estimate of what both panels show."""


def collision_and_score(results: Sequence[Result], title: str = "") -> Figure:
    """Draw collision rate and driving score, a point with its 95 % interval per perception and corruption or fault.

    Args:
        results: of one severity of each corruption.
    """
    perceptions = _perceptions(results)
    titles = dict.fromkeys(map(_disturbance, sorted(results, key=_corrupted)))
    groups = {title: [one for one in results if _disturbance(one) == title] for title in titles}
    width = max(_LETTERS // max(len(groups), 1), 10)
    styles = styles_of(perceptions)
    with figure_style():
        figure, parts = panels(WIDTH_IN, 5.4, rows=2, title=title)
        for axes, (label, value, estimate) in zip(parts, _SHOWN, strict=True):
            for i, name in enumerate(perceptions):
                found = [estimate(_values(group, value, perception=name)) for group in groups.values()]
                shift = 0.72 * ((i + 0.5) / len(perceptions) - 0.5)
                _points(axes, [k + shift for k in range(len(groups))], found, styles[name], name, line=False)
            for k in range(1, len(groups)):
                axes.axvline(k - 0.5, color="#E3E6EA", linewidth=0.8)
            axes.set_xticks(range(len(groups)), [_wrapped(title, width) for title in groups])
            axes.tick_params(axis="x", length=0)
            axes.grid(visible=False, axis="x")
            axes.set(xlim=(-0.5, max(len(groups), 1) - 0.5), ylim=(-3, 103), yticks=range(0, 101, 20), ylabel=label)
        add_legend(figure, parts[0], below=True)
    return figure


def rate_over_severity(results: Sequence[Result]) -> Figure:
    """Draw the collision rate over the severity from clean on, a panel per corruption, a curve per perception."""
    perceptions = _perceptions(results)
    kinds = [kind for kind in _kinds(results) if kind != CLEAN]
    styles = styles_of(perceptions)
    columns = min(max(len(kinds), 1), 3)
    rows = max(math.ceil(len(kinds) / columns), 1)
    with figure_style():
        figure, parts = panels(WIDTH_IN, 0.9 + 2.3 * rows, rows=rows, columns=columns)
        for axes, kind in zip(parts, kinds, strict=False):
            severities = sorted({one.severity for one in results if one.corruption == kind})
            for i, name in enumerate(perceptions):
                clean = rate(_values(results, collided, perception=name, corruption=CLEAN))
                found = [
                    rate(_values(results, collided, perception=name, corruption=kind, severity=s)) for s in severities
                ]
                known = [] if math.isnan(clean.value) else [(0, clean)]
                known += list(zip(severities, found, strict=True))
                shift = 0.06 * (i - (len(perceptions) - 1) / 2)
                _points(axes, [x + shift for x, _ in known], [y for _, y in known], styles[name], name)
            axes.set_title(condition_title(kind))
            axes.set(ylim=(-3, 103), yticks=range(0, 101, 20), xlim=(-0.4, 5.4), xticks=range(6))
            axes.set_xticklabels(["clean", *map(str, range(1, 6))])
        for axes in parts[len(kinds) :]:
            axes.set_visible(False)
        for row in range(rows):
            parts[row * columns].set_ylabel("collision rate, %")
        for axes in parts[max(len(kinds) - columns, 0) : len(kinds)]:
            axes.set_xlabel("severity")
        add_legend(figure, parts[0], below=True)
    return figure


def deadly_corruptions(results: Sequence[Result]) -> Figure:
    """Draw which corruption kills: its crashes more than clean, in points, by scenario, a panel per perception.

    Crashes are compared in pairs of one scenario and seed. A cell is bold where McNemar's exact test has p < 0.05.

    Args:
        results: of a campaign, of one severity: each clean episode is one half of one pair per corruption.
    """
    kinds = [kind for kind in _kinds(results) if kind != CLEAN]
    scenarios = list(dict.fromkeys(one.scenario for one in results))
    names = [name for name in _perceptions(results) if _chosen(results, perception=name, corruption=set(kinds))]
    lines = [*scenarios, "all"] if len(scenarios) > 1 else scenarios
    columns = min(max(len(names), 1), 2)
    rows = max(math.ceil(len(names) / columns), 1)
    scale = Normalize(-100.0, 100.0)
    with figure_style():
        height = 0.9 + rows * (1.3 + 0.26 * len(lines))
        figure, parts = panels(WIDTH_IN, height, rows=rows, columns=columns)
        for place, (axes, name) in enumerate(zip(parts, names, strict=False)):
            for y, scenario in enumerate(lines):
                for x, kind in enumerate(kinds):
                    where = {"perception": name} | ({} if scenario == "all" else {"scenario": scenario})
                    found = _harm(
                        _chosen(results, corruption=kind, **where), _chosen(results, corruption=CLEAN, **where)
                    )
                    points = 100 * found[0]
                    unknown = math.isnan(points)
                    color = (1.0, 1.0, 1.0) if unknown else mpl.colormaps[_CMAP](float(scale(points)))[:3]
                    text = "-" if unknown else f"{points:+.0f}" if round(points) else "0"
                    draw_cell(axes, x, y + 0.25 * (scenario == "all"), color, text, bold=found[1] < 0.05)
            axes.set(xlim=(-0.5, max(len(kinds), 1) - 0.5), ylim=(len(lines) - 0.25, -0.5))
            axes.set_title(name)
            axes.set_xticks(range(len(kinds)), [condition_title(k) for k in kinds], rotation=40, ha="right",
                            rotation_mode="anchor")  # fmt: skip
            ticks = [y + 0.25 * (line == "all") for y, line in enumerate(lines)]
            axes.set_yticks(ticks, lines if place % columns == 0 else [""] * len(lines))
            axes.tick_params(length=0)
            axes.grid(visible=False)
            axes.spines[:].set_visible(False)
        for axes in parts[len(names) :]:
            axes.set_visible(False)
        bar = figure.colorbar(ScalarMappable(scale, _CMAP), ax=parts, fraction=0.025, pad=0.01)
        bar.set_label("collision rate minus clean,\npoints (bold: p < 0.05)")
        bar.outline.set_visible(False)  # type: ignore[operator]
    return figure


def _harm(corrupted: Sequence[Result], clean: Sequence[Result]) -> tuple[float, float]:
    """Return difference of the collision rates over pairs of equal scenario and seed, and its p-value."""
    before = {(one.scenario, one.seed): collided(one) for one in counted(clean)}
    both = [(collided(one), before[key]) for one in counted(corrupted) if (key := (one.scenario, one.seed)) in before]
    if not both:
        return math.nan, 1.0
    found = paired_rates([a for a, _ in both], [b for _, b in both])
    return found.difference.value, found.p_value


def cost_of_channel(results: Sequence[Result], quantities: Mapping[str, Callable[[Result], float]]) -> Figure:
    """Draw collision rate and driving score over a quantity of the channel: a column of panels per quantity.

    Args:
        results: clean episodes through several channels.
        quantities: function from a result to the quantity by axis label, e.g. latency in s or share of lost packets;
            results for which it is NaN are left out.
    """
    perceptions = _perceptions(results)
    styles = styles_of(perceptions)
    columns = max(len(quantities), 1)
    with figure_style():
        figure, parts = panels(WIDTH_IN, 5.2, rows=2, columns=columns)
        for column, (label, quantity) in enumerate(quantities.items()):
            places = sorted({x for one in results if not math.isnan(x := quantity(one))})
            width = (places[-1] - places[0]) if len(places) > 1 else 1.0
            for row, (name_of_y, value, estimate) in enumerate(_SHOWN):
                axes = parts[row * columns + column]
                for i, name in enumerate(perceptions):
                    own = _chosen(results, perception=name)
                    found = [estimate([value(one) for one in counted(own) if quantity(one) == x]) for x in places]
                    shift = 0.008 * width * (i - (len(perceptions) - 1) / 2)
                    _points(axes, [x + shift for x in places], found, styles[name], name)
                axes.set(ylim=(-3, 103), yticks=range(0, 101, 20), ylabel="" if column else name_of_y)
                axes.set_xlabel(label if row else "")
                axes.set_xticks(places if len(places) <= 8 else places[:: math.ceil(len(places) / 8)])
        add_legend(figure, parts[0], below=True)
    return figure


def shares_of_causes(results: Sequence[EpisodeResult], causes: Mapping[str, Cause]) -> Figure:
    """Draw the causes of crashes, a bar per perception and condition, stacked by what came late."""
    kinds, counts = counted_causes(results, causes)
    fills = dict(zip(kinds, COLORS, strict=False))
    with figure_style():
        figure, (axes,) = panels(WIDTH_IN, 1.2 + 0.3 * len(counts))
        for y, own in enumerate(counts.values()):
            left = 0
            for kind in kinds:
                axes.barh(y, own[kind], 0.7, left, color=fills[kind], edgecolor="white", label=None if y else kind)
                if own[kind]:
                    axes.text(left + 0.5 * own[kind], y, str(own[kind]), ha="center", va="center", color="white")
                left += own[kind]
        axes.set_yticks(range(len(counts)), [f"{perception}, {condition}" for perception, condition in counts])
        axes.set(ylim=(len(counts) - 0.5, -0.5), xlabel="crashes")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(visible=False, axis="y")
        add_legend(figure, axes, below=True)
    return figure


def reliability_in_the_loop(results: Sequence[EpisodeResult], found: Mapping[str, Reliability]) -> Figure:
    """Draw the share of right detections over their score, a curve per perception, clean where there are such."""
    joined = joined_calibrations(results, found)
    first = CLEAN if any(title == CLEAN for _, title in joined) else next(title for _, title in joined)
    curves = {perception: own for (perception, title), (_, own) in joined.items() if title == first}
    return draw_reliability(curves, styles_of(_perceptions(results)), f"share right, {first} (bird's-eye IoU 0.5)")


def _points(
    axes: Axes, places: Sequence[float], found: Sequence[Estimate], style: Style, name: str, *, line: bool = True
) -> None:
    """Draw estimates with their intervals, in percent; unknown ones are left out."""
    known = [(x, y) for x, y in zip(places, found, strict=True) if not math.isnan(y.value)]
    if not known:
        return
    x = [place for place, _ in known]
    y = 100 * np.array([one.value for _, one in known])
    ends = 100 * np.array([(one.low, one.high) for _, one in known])
    bars = np.nan_to_num(np.abs(np.stack([y - ends[:, 0], ends[:, 1] - y])))
    drawn = style.line() if line else style.point()
    axes.errorbar(x, y, yerr=bars, capsize=2.0, elinewidth=1.0, label=name, **{**drawn, "markersize": 5.0})


def _perceptions(results: Sequence[Result]) -> list[str]:
    return list(dict.fromkeys(one.perception for one in results))


def _disturbance(one: Result) -> str:
    """Return the title of a corruption without its severity, of faults, or of a channel."""
    own = one.fault or ("" if one.corruption == CLEAN else condition_title(one.corruption))
    channel = "" if one.channel == IDEAL else one.channel
    return ", ".join(part for part in (own, channel) if part) or CLEAN


def _wrapped(title: str, width: int) -> str:
    """Return a title in lines of so many letters, which part neither words nor a number from its unit."""
    return textwrap.fill(re.sub(r"(\d) s\b", "\\1\u00a0s", title), width, break_long_words=False)


def _corrupted(one: Result) -> int:
    """Return the place of a result: clean, corrupted, with faults."""
    return 2 if one.fault or one.channel != IDEAL else int(one.corruption != CLEAN)


def _kinds(results: Sequence[Result]) -> list[str]:
    """Return the kinds of corruption, clean first, the others in the order of their first results."""
    kinds = list(dict.fromkeys(one.corruption for one in results))
    return [kind for kind in (CLEAN,) if kind in kinds] + [kind for kind in kinds if kind != CLEAN]


def _chosen(results: Sequence[Result], **wanted: object) -> list[Result]:
    """Return results whose fields have these values, or one of a set of them."""
    return [
        one
        for one in results
        if all(getattr(one, k) in v if isinstance(v, set) else getattr(one, k) == v for k, v in wanted.items())
    ]


def _values(results: Sequence[Result], value: Value, **wanted: object) -> list[float]:
    return [value(one) for one in counted(_chosen(results, **wanted))]
