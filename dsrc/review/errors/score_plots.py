"""Plots of the scores of a run as SVG: precision over recall, and a histogram of hits and false detections."""

from html import escape

import numpy as np
from numpy.typing import NDArray

from dsrc.evaluation.metrics.ap import Curve
from dsrc.review import palette
from dsrc.review.errors.report import RunReport, curve_on_grid
from dsrc.review.palette import css, method_color
from dsrc.review.state import ReviewState

BINS = 20
"""Bars of the histogram, from score 0 to 1."""
STEPS = 100
"""Steps of the recall that a click tells apart."""
_W, _H, _EDGE, _TOP = 280.0, 110.0, 8.0, 18.0


def curve_svg(report: RunReport, state: ReviewState) -> str:
    """SVG of a curve per method at the IoU of a state, with the point of its threshold."""
    grid = np.linspace(0.0, 1.0, STEPS + 1)
    parts = []
    for row, (name, counts) in enumerate(report.counts.items()):
        precision = curve_on_grid(report.curves[name, state.iou], grid)
        known = np.isfinite(precision)
        path = "L".join(f"{_x(r):.1f} {_y(p):.1f}" for r, p in zip(grid[known], precision[known], strict=True))
        color = css(method_color(row))
        parts.append(f'<path d="M{path}" fill="none" stroke="{color}" stroke-width="2"/>' if path else "")
        if counts.recall is not None and counts.precision is not None:
            at = f'cx="{_x(counts.recall):.1f}" cy="{_y(counts.precision):.1f}"'
            parts.append(f'<circle {at} r="4" fill="{color}"><title>{escape(name)}</title></circle>')
    return _svg(parts, f"precision over recall, at score {state.threshold:g}", f"0,{STEPS}")


def histogram_svg(report: RunReport, state: ReviewState, method: str) -> str:
    """SVG of how many detections of a method have which score, hits below false ones, and the threshold."""
    curve = report.curves[method, state.iou]
    hit = hits_of(curve)
    counts = [np.histogram(curve.score[rows], BINS, (0.0, 1.0))[0] for rows in (hit, ~hit)]
    most, width, parts = max(int(np.sum(counts, axis=0).max()), 1), (_W - 2.0 * _EDGE) / BINS, []
    for number, (hits, false) in enumerate(zip(*counts, strict=True)):
        top = 1.0 - hits / most
        for share, low, rgb in ((hits / most, top, palette.TP), (false / most, top - false / most, palette.FP)):
            if share:
                size = f'x="{_x(number / BINS) + 0.5:.1f}" y="{_y(1.0 - low):.1f}" width="{width - 1.0:.1f}"'
                parts.append(f'<rect {size} height="{share * (_H - _TOP):.1f}" fill="{css(rgb)}"/>')
    at = _x(state.threshold)
    parts.append(f'<path d="M{at:.1f} {_TOP}V{_H}" stroke="#1c2430" stroke-dasharray="3 2"/>')
    return _svg(parts, f"scores of hits and false detections, up to {most}", f"-0.5,{BINS - 0.5}")


def hits_of(curve: Curve) -> NDArray[np.bool_]:
    """(D,) mask of the detections of a curve that are hits."""
    return np.diff(curve.recall, prepend=0.0) > 0.0


def _x(share: float) -> float:
    return _EDGE + share * (_W - 2.0 * _EDGE)


def _y(share: float) -> float:
    return _H - share * (_H - _TOP)


def _svg(parts: list[str], title: str, ends: str) -> str:
    style = "background:#eef0f3;border-radius:4px;cursor:crosshair;display:block;font:12px system-ui,sans-serif"
    ground = f'<rect x="{_EDGE}" y="{_TOP}" width="{_W - 2.0 * _EDGE}" height="{_H - _TOP}" fill="#fff"/>'
    text = f'<text x="{_EDGE}" y="13" fill="#1c2430">{escape(title)}</text>'
    goes = f'data-ends="{ends},{_EDGE / _W:.5f}" viewBox="0 0 {_W:g} {_H + 4.0:g}" width="100%"'
    return f'<svg {goes} style="{style}">{ground}{"".join(parts)}{text}</svg>'
