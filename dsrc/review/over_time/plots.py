"""Plots of a run over its frames as one SVG: strips with one axis of frames, the present, marks and levels."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from dsrc.review.palette import Rgb, css

_WIDTH, _HEIGHT, _HEAD, _EDGE = 280.0, 30.0, 18.0, 6.0
"""Of the picture, of a strip and of the first line above it, and the margin at both sides, px."""
_LETTER, _LINE, _GAP = 6.4, 13.0, 6.0
"""Width of a letter, height of further lines, and space between two texts of a line, px."""
_RANGE = 8
"""Letters of the range of an axis, which stands in the first line."""
_TEXT, _FAINT, _CARD, _GROUND, _AXIS = "#1c2430", "#5f6b7c", "#eef0f3", "#ffffff", "#c3cad4"
"""Colours of the plots in both themes: colours of agents and verdicts are made for light ground."""


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """Course of one quantity.

    Attributes:
        name: shown before its present value; "" where the title of its strip is enough.
        rgb: colour.
        rows: (K,) frames with a value, ascending.
        values: (K,) float64; NaN or infinity interrupts the line.
        dashed: whether it is drawn dashed.
    """

    name: str
    rgb: Rgb
    rows: NDArray[np.int64]
    values: NDArray[np.float64]
    dashed: bool = False

    def at(self, row: int) -> float:
        """Value at the nearest known frame at or before a row; NaN before the first."""
        found = int(np.searchsorted(self.rows, row, side="right")) - 1
        return float(self.values[found]) if found >= 0 else float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class Strip:
    """Plot of some quantities of one unit.

    Attributes:
        title: with the unit.
        lines: from the lowest to the topmost.
        level: value that is drawn across, such as a threshold; None for none.
        high: upper end of its axis; None for the largest value. The lower one is 0, or the least value below it.
        digits: decimals of the present values.
    """

    title: str
    lines: Sequence[Line]
    level: float | None = None
    high: float | None = None
    digits: int = 1


def plots_svg(
    strips: Sequence[Strip], ends: tuple[int, int], now: int, marks: Mapping[str, int], edges: tuple[str, str]
) -> str:
    """SVG of strips below each other, "" where none of them has a value.

    A click goes to a frame: the script of a live page reads `data-ends`, see `page/browser.py`.

    Args:
        ends: frames at the left and the right edge.
        now: frame that is shown.
        marks: frames by what happens in them.
        edges: what is written below the edges.
    """
    strips = [strip for strip in strips if any(np.isfinite(line.values).any() for line in strip.lines)]
    if not strips:
        return ""

    def x(row: int) -> float:
        return _EDGE + (_WIDTH - 2.0 * _EDGE) * (row - ends[0]) / max(ends[1] - ends[0], 1)

    bottom, parts = 0.0, list[str]()
    for strip in strips:
        said = _said(strip, now)
        bottom += _HEAD + _LINE * (len(said) - 1)
        parts.append(_strip(strip, said, x, bottom))
        bottom += _HEIGHT
    lines, taken = 0, list[float]()
    for name, row in sorted(marks.items(), key=lambda mark: mark[1]):
        half = 0.5 * _LETTER * len(name)
        middle = min(max(x(row), _EDGE + half), _WIDTH - _EDGE - half)
        line = next((n for n, end in enumerate(taken) if end < middle - half), len(taken))
        taken[line:line] = [] if line < len(taken) else [0.0]
        taken[line] = middle + half + _LETTER
        lines = max(lines, line + 1)
        parts.append(f'<path d="M{x(row):.1f} {_HEAD}V{bottom + 2}" stroke="{_FAINT}" stroke-dasharray="2 2"/>')
        parts.append(_text(middle, bottom + _LINE * (line + 1), name, _TEXT, "middle"))
    parts.append(f'<path d="M{x(now):.1f} {_HEAD}V{bottom}" stroke="{_TEXT}" stroke-width="1.2"/>')
    height = bottom + _LINE * lines + 15.0
    parts.append(_text(_EDGE, height - 3.0, edges[0], _FAINT, "start"))
    parts.append(_text(_WIDTH - _EDGE, height - 3.0, edges[1], _FAINT, "end"))
    style = f"background:{_CARD};border-radius:4px;cursor:crosshair;display:block;font:12px system-ui,sans-serif"
    goes = f'data-ends="{ends[0]},{ends[1]},{_EDGE / _WIDTH:.5f}"'
    return f'<svg {goes} viewBox="0 0 {_WIDTH:g} {height:g}" width="100%" style="{style}">{"".join(parts)}</svg>'


def _said(strip: Strip, now: int) -> list[list[str]]:
    """Lines above a strip, as text elements: its title, the present values and its level."""
    words = [(strip.title, _TEXT)]
    for line in strip.lines:
        value = line.at(now)
        shown = f"{value:.{strip.digits}f}" if np.isfinite(value) else "–"
        words.append((f"{line.name} {shown}".strip(), css(line.rgb)))
    words += [] if strip.level is None else [(f"≥ {strip.level:g}", _FAINT)]
    lines, at = [list[str]()], 0.0
    for text, fill in words:
        width = _LETTER * len(text) + _GAP
        if at + width > _WIDTH - 2.0 * _EDGE - (_LETTER * _RANGE if len(lines) == 1 else 0.0):
            lines.append([])
            at = 0.0
        gap = f' dx="{_GAP:g}"' if lines[-1] else ""
        lines[-1].append(f'<tspan fill="{fill}"{gap}>{escape(text)}</tspan>')
        at += width
    return lines


def _strip(strip: Strip, said: list[list[str]], x: Callable[[int], float], top: float) -> str:
    """SVG of a strip whose upper edge is at `top`, below what is said of it."""
    known = [line.values[np.isfinite(line.values)] for line in strip.lines]
    values = np.append(np.concatenate(known), 0.0 if strip.level is None else strip.level)
    low, high = min(float(values.min()), 0.0), float(values.max()) if strip.high is None else strip.high
    high = high if high > low else low + 1.0
    right, first = _WIDTH - _EDGE, top - 4.0 - _LINE * (len(said) - 1)

    def place(value: float) -> float:
        return top + _HEIGHT * (high - min(max(value, low), high)) / (high - low)

    parts = [f'<rect x="{_EDGE}" y="{top}" width="{right - _EDGE}" height="{_HEIGHT}" fill="{_GROUND}"/>']
    if low < 0.0:
        parts.append(f'<path d="M{_EDGE} {place(0.0):.1f}H{right}" stroke="{_AXIS}"/>')
    if strip.level is not None:
        parts.append(f'<path d="M{_EDGE} {place(strip.level):.1f}H{right}" stroke="{_FAINT}" stroke-dasharray="5 3"/>')
    for line in strip.lines:
        path = _path([x(row) for row in line.rows.tolist()], line.values.tolist(), place)
        style = 'stroke-width="1.5" stroke-linecap="round"' + (' stroke-dasharray="3 2.5"' if line.dashed else "")
        parts.append(f'<path d="{path}" fill="none" stroke="{css(line.rgb)}" {style}/>')
    for number, words in enumerate(said):
        parts.append(f'<text x="{_EDGE}" y="{first + _LINE * number:g}">{"".join(words)}</text>')
    return "".join([*parts, _text(right, first, _range(low, high), _FAINT, "end")])


def _range(low: float, high: float) -> str:
    """Text of the ends of an axis: the upper one alone where the lower is 0."""
    upper = f"{high:.0f}" if high >= 100.0 else f"{high:.3g}"
    return f"{low:.3g} to {upper}" if low else upper


def _path(x: list[float], values: list[float], place: Callable[[float], float]) -> str:
    """Path through the finite values; one between two gaps is a dot."""
    parts, before = [], False
    for at, value in zip(x, values, strict=True):
        finite = bool(np.isfinite(value))
        if finite:
            parts.append(f"{'L' if before else 'M'}{at:.1f} {place(value):.1f}{'' if before else 'h0'}")
        before = finite
    return "".join(parts)


def _text(x: float, y: float, text: str, fill: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:g}" fill="{fill}" text-anchor="{anchor}">{escape(text)}</text>'
