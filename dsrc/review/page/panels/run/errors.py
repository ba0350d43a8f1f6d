"""Errors: every error of the run in a list, average precision and its curve, the worst frames, and background work."""

import math
from functools import partial
from typing import Any, get_args

import numpy as np

from dsrc.review.errors.filters import KINDS
from dsrc.review.errors.index import ErrorTable
from dsrc.review.errors.notes import errors_csv
from dsrc.review.errors.report import BANDS, BROKEN, FIXED, RunReport, shown_error, versus_options
from dsrc.review.errors.score_plots import BINS, STEPS, curve_svg, histogram_svg
from dsrc.review.page.controls import Choice, Control, detects, named, same
from dsrc.review.page.page import Shown
from dsrc.review.page.panels.panel import Panel, clickable, set_fields
from dsrc.review.palette import Rgb
from dsrc.review.state import IOU_THRESHOLDS, Listed, ReviewState, Theme, other_run
from dsrc.review.texts import html_table, quoted
from dsrc.review.worker import Job
from sim.boxes import CLASSES
from sim.errors import SettingsError

ROWS = 8
"""Errors on a page of the list."""
FRAMES = 30
"""Worst frames in their list."""
_CHOSEN = (56, 150, 255)
_OTHER: dict[Theme, Rgb] = {"dark": (62, 70, 84), "light": (222, 227, 234)}
"""Colours of the other errors' buttons; the browser chooses a text that can be read on them."""
_NO_FRAME = "–"
_CLASSES = {"all": "", **{name: name for name in CLASSES}}
_SEEN = {"anybody or none": "", "the ego": "ego", "helpers alone": "helper", "nobody": "nobody"}


def _listed(shown: Shown) -> dict[str, Any]:
    """Kinds of errors; what is broken and fixed only against another run."""
    against = other_run(shown.state) is not None
    return {name: name for name in get_args(Listed) if against or name not in (BROKEN, FIXED)}


def _versus(shown: Shown) -> dict[str, Any]:
    return versus_options(shown.model, shown.state)


def _blamed(shown: Shown) -> dict[str, Any]:
    return {"all methods": "", **{name: name for name in shown.state.methods or list(shown.source.sets)[:1]}}


class ErrorsPanel(Panel):
    """Folder with filters, the errors from the worst on, scores of the run and a button that detects in all of it."""

    title = "Errors of the run"
    table = (
        Control("listed", Choice(_listed), "List", link="errors", shown=detects),
        Control(
            "versus",
            Choice(_versus),
            "Against",
            link="against",
            shown=lambda shown: detects(shown) and len(_versus(shown)) > 1,
        ),
        Control("error_method", Choice(_blamed), "Of", link="of", shown=lambda shown: len(shown.state.methods) > 1),
        Control("error_class", Choice(named(_CLASSES)), "Class", link="class", shown=detects),
        Control("error_range", Choice(same(*BANDS)), "Distance, m", link="distance", shown=detects),
        Control("error_seen_by", Choice(named(_SEEN)), "Seen by", link="seen", shown=detects),
    )

    def build(self) -> None:
        """Add the widgets, hidden until there is something to judge."""
        self._first = 0
        self._report: RunReport | None = None
        gui, self.folder.visible = self._page.gui, False
        self.progress = gui.add_markdown("")
        self.bar: Any = gui.add_progress_bar(0.0, visible=False)
        self.detect = gui.add_button("Detect in all frames", visible=False)
        with gui.add_folder("Filters", expand_by_default=False):
            super().build()
        self.rows = [gui.add_button("", visible=False) for _ in range(ROWS)]
        self.pages = gui.add_button_group("Errors", ("‹", "›"))
        self.frames = gui.add_dropdown("Worst frames", (_NO_FRAME,))
        self.scores = gui.add_html("")
        self.plots = gui.add_html("")
        self.recall: Any = gui.add_number("Clicked recall", -1, visible=False)
        self.bin: Any = gui.add_number("Clicked bar", -1, visible=False)
        self.csv = gui.add_button("Save list as CSV")
        for number, button in enumerate(self.rows):
            button.on_click(partial(self._open, number))
        self.pages.on_click(lambda event: self._turn(-ROWS if event.target.value == "‹" else ROWS))
        self.frames.on_update(self._to_frame)
        self.detect.on_click(lambda _: self._page.cancel() if self._page.detecting() else self._page.detect_all())
        self.recall.on_update(self._to_recall)
        self.bin.on_update(self._to_bin)
        self.csv.on_click(lambda _: self._save())

    def show(self, shown: Shown) -> None:
        """Write list, scores and progress; a list that is only longer than shown is written again every two seconds."""
        set_fields(self.folder, visible=shown.judged)
        if not shown.judged:
            return
        super().show(shown)
        try:
            report = self._page.report(shown.state)
        except SettingsError as error:
            self._clear(str(error))
            return
        if report is not self._report:
            self._first, self._report = 0, report
            self._show_scores(shown.state, report)
            self._show_frames(report)
        self._show_rows(shown.state, report)
        self._show_progress(shown, report)

    def _clear(self, why: str) -> None:
        """Say why there is no report, and leave nothing of the one before."""
        self._first, self._report = 0, None
        self.progress.content, self.frames.options = quoted(why), (_NO_FRAME,)
        self.scores.content = self.plots.content = ""
        for handle in (*self.rows, self.pages, self.bar, self.detect):
            handle.visible = False
        self.csv.disabled = True

    def _show_progress(self, shown: Shown, report: RunReport) -> None:
        jobs = self._page.detecting()
        text = f"**{len(report.errors)} errors** in {report.known} of {report.total} frames"
        against = f" · against {quoted(report.versus)}" if report.versus else ""
        self.progress.content = f"{text}{against}{_running(jobs)}"
        self.bar.visible = bool(jobs)
        if jobs:
            self.bar.value = 100.0 * sum(job.done for job in jobs) / max(sum(job.total for job in jobs), 1)
        lacking = report.known < report.total and shown.model.computes(shown.state)
        self.detect.visible = bool(jobs) or lacking
        set_fields(self.detect, label="Stop detecting" if jobs else "Detect in all frames")

    def _show_scores(self, state: ReviewState, report: RunReport) -> None:
        head = ("", *(f"AP{100 * iou:.0f}" for iou in IOU_THRESHOLDS), "TP", "FP", "FN")
        rows = []
        for name, c in report.counts.items():
            precisions = [report.curves[name, iou].ap for iou in IOU_THRESHOLDS]
            shown = ("–" if math.isnan(ap) else f"{ap:.2f}" for ap in precisions)
            rows.append((name, *shown, *map(str, (c.tp, c.fp, c.fn))))
        self.scores.content = html_table(head, rows)
        curve, histogram = curve_svg(report, state), histogram_svg(report, state, next(iter(report.counts)))
        plots = [(curve, self.recall), (histogram, self.bin)]
        set_fields(self.plots, content="".join(clickable(*plot, "margin:.3em .6em") for plot in plots))

    def _to_recall(self, event: Any) -> None:
        """Set the threshold that has the clicked recall, and select the detection that decides it."""
        if event.client_id is None or self._report is None:
            return
        page, method = self._page, next(iter(self._report.counts))
        state, curve = page.state, self._report.curves[method, page.state.iou]
        row = min(int(np.searchsorted(curve.recall, event.target.value / STEPS)), len(curve.score) - 1)
        self.recall.value = -1
        if row < 0:
            return
        with page.using_model:
            run = page.model.run(state.drive, method, page.model.setup(state))
        one = int(np.flatnonzero(run.table.score == curve.score[row])[0])
        threshold, frame = np.floor(1e4 * curve.score[row]) / 1e4, run.table.position[run.frame_of[one]]
        page.update(threshold=float(threshold), frame=int(frame))
        page.update(detection=int(run.rank[one]))

    def _to_bin(self, event: Any) -> None:
        """Go to the next listed error whose score lies in the clicked bar."""
        if event.client_id is None or self._report is None:
            return
        page, errors, low = self._page, self._report.errors, event.target.value / BINS
        self.bin.value = -1
        rows = np.flatnonzero((errors.score >= low) & (errors.score < low + 1.0 / BINS))
        if not len(rows):
            page.tell(f"No listed error has a score of {low:.2f} to {low + 1.0 / BINS:.2f}.")
            return
        page.show_error(errors, int(rows[np.searchsorted(rows, shown_error(errors, page.state), "right") % len(rows)]))

    def _show_frames(self, report: RunReport) -> None:
        frames = report.frames
        worst = min(FRAMES, int(np.count_nonzero(frames.loss > 0.0)))
        kinds = (("missed", frames.missed), ("false", frames.false), ("poor", frames.poor))
        names = []
        for rank in range(worst):
            counts = ", ".join(f"{count[rank]} {name}" for name, count in kinds if count[rank])
            names.append(f"{rank + 1}: frame {frames.row[rank]}, {counts}")
        options = (_NO_FRAME, *names)
        set_fields(self.frames, options=options)

    def _show_rows(self, state: ReviewState, report: RunReport) -> None:
        errors = report.errors
        chosen = shown_error(errors, state)
        for number, button in enumerate(self.rows):
            row = self._first + number
            set_fields(button, visible=row < len(errors))
            if row < len(errors):
                color = _CHOSEN if row == chosen else _OTHER[state.theme]
                set_fields(button, label=_title(errors, row), color=color)
        set_fields(self.pages, visible=len(errors) > ROWS)
        self.csv.disabled = len(errors) == 0

    def _open(self, number: int, _: object = None) -> None:
        report = self._report
        if report is None or self._first + number >= len(report.errors):
            return
        self._page.show_error(report.errors, self._first + number)

    def _turn(self, rows: int) -> None:
        if self._report is not None:
            last = max(len(self._report.errors) - 1, 0) // ROWS * ROWS
            self._first = min(max(self._first + rows, 0), last)
            self._show_rows(self._page.state, self._report)

    def _to_frame(self, event: Any) -> None:
        place = tuple(self.frames.options).index(event.target.value)
        # The list is set to its head when it is written again.
        if self._report is not None and place and event.client_id is not None:
            self._page.update(frame=int(self._report.frames.row[place - 1]))

    def _save(self) -> None:
        if self._report is None:
            return
        page = self._page
        drive = page.model.title(page.state.drive)
        page.download("errors.csv", errors_csv(drive, self._report.errors, page.notes))


def _title(errors: ErrorTable, row: int) -> str:
    """Label of an error in the list: frame, kind and class, distance, points that are left."""
    label, kind = errors.label[row], KINDS[errors.kind[row]]
    what = f"{kind} {CLASSES[label] if label >= 0 else 'object'}"
    if kind == "false":
        what = f"false {errors.score[row]:.2f}"
    elif kind == "poor":
        what += f" {errors.iou[row]:.2f}"
    points = f", {errors.points[row, 3]} pts" if errors.points[row, 3] >= 0 else ""
    method = f", {errors.methods[errors.method[row]]}" if len(errors.methods) > 1 else ""
    return f"{errors.row[row]}: {what}, {errors.distance_m[row]:.0f} m{points}{method}"


def _running(jobs: list[Job]) -> str:
    if not jobs:
        return ""
    left = [job.left_s for job in jobs]
    known = [one for one in left if one is not None]
    wait = f", {math.ceil(sum(known))} s left" if len(known) == len(left) else ""
    return f" · detecting{wait}"
