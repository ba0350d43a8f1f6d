"""Episode: what the driver does at the drawn step and why, and speed, wanted acceleration and contact over time."""

import math
from typing import Any

import numpy as np
from viser import uplot

from dsrc.review import palette
from dsrc.review.page.panels.widgets import set_fields
from dsrc.review.page.protocol import Page, Shown
from dsrc.review.palette import css
from dsrc.review.sources.moment import RUNNING, EpisodeTimeline
from dsrc.review.state import Theme
from dsrc.review.texts import moment_report

_HEIGHT_PX = 170
_GROWS_S = 5.0
"""Steps in which the axis of time of a running episode grows, s."""


class EpisodePanel:
    """Folder with the step in words and the course of speed, blue, and wanted acceleration, amber; hidden in drives."""

    def __init__(self, page: Page) -> None:
        """Build it, hidden."""
        self._page = page
        self._known: tuple[int, int, bool] | None = None
        self._line: EpisodeTimeline | None = None
        self.folder = page.gui.add_folder("Episode", visible=False)
        with self.folder:
            self.text = page.gui.add_markdown("")
            self.plot: Any = None
        self._drawn: Any = None

    def show(self, shown: Shown) -> None:
        """Write the step, and mark it in the course."""
        view = shown.view
        moment = None if view is None else view.moment
        set_fields(self.folder, visible=moment is not None)
        if view is None or moment is None:
            return
        drive = shown.state.drive
        known = drive, shown.model.frame_count(drive), shown.model.grows(drive)
        if self._known != known:
            self._known, self._line = known, shown.model.timeline(drive)
        if self._line is None:
            return
        self.text.content = moment_report(moment, self._line, view.index)
        self._draw(self._line, view.index, shown.state.theme)

    def _draw(self, line: EpisodeTimeline, row: int, theme: Theme) -> None:
        """Draw speed and wanted acceleration, the present and the contact."""
        data = (line.time_s, line.speed_mps, line.wanted_mps2, _mark(line, row), _mark(line, line.contact_row))
        drawn = _times(line), _range(line), theme
        if self.plot is not None and self._drawn == drawn:
            self.plot.data = data
            return
        # Scales are fixed: those that uPlot finds by itself are not those of data that come later, nor of NaN.
        self._drawn = drawn
        scales = {"x": uplot.Scale(time=False, range=drawn[0]), "y": uplot.Scale(range=drawn[1])}
        dot = {"show": True, "size": 9}
        series = (
            uplot.Series(label="time"),
            uplot.Series(label="speed, m/s", stroke=css(palette.AGENT_COLORS[0]), width=2),
            uplot.Series(label="wanted, m/s²", stroke=css(palette.FN), width=1),
            uplot.Series(label="now", stroke=css(palette.method_color(0)), width=0, points=dot),  # type: ignore[typeddict-item]
            uplot.Series(label="contact", stroke=css(palette.FP), width=0, points=dot),  # type: ignore[typeddict-item]
        )
        if self.plot is not None:
            self.plot.data, self.plot.series, self.plot.scales = data, series, scales
            return
        with self.folder:
            self.plot = self._page.gui.add_uplot(
                data,
                series,
                scales=scales,
                legend=uplot.Legend(show=False),
                axes=(uplot.Axis(label="s", stroke=css(palette.OTHER)), uplot.Axis(stroke=css(palette.OTHER))),
                height=_HEIGHT_PX,
            )


def _times(line: EpisodeTimeline) -> tuple[float, float]:
    """First second and the last; that of a running episode grows in steps, since rescaling draws the plot anew."""
    first, last = (float(line.time_s[row]) for row in (0, -1))
    if line.outcome != RUNNING:
        return first, max(last, first + 0.1)
    return first, first + _GROWS_S * max(math.ceil((last - first) / _GROWS_S), 1)


def _range(line: EpisodeTimeline) -> tuple[float, float]:
    """Bounds of what is plotted, multiples of 5 m/s and m/s²: a running episode rescales seldom."""
    values = np.concatenate([line.speed_mps, line.wanted_mps2])
    values = values[np.isfinite(values)]
    return 5.0 * math.floor(values.min(initial=0.0) / 5.0), 5.0 * math.ceil(values.max(initial=1.0) / 5.0)


def _mark(line: EpisodeTimeline, row: int | None) -> Any:
    """(T,) speed at one step, NaN elsewhere."""
    mark = np.full(len(line.time_s), np.nan)
    if row is not None:
        mark[row] = line.speed_mps[row]
    return mark
