"""Corruption lab: a corruption with its parameters, what it does to the points and to the AP of the drive."""

import math
from dataclasses import replace
from typing import Any

from dsrc.review.labs.parameters import CorruptionParameter, changed, parameters_of
from dsrc.review.page.panels.widgets import build_controls, set_fields
from dsrc.review.page.protocol import Page, Shown
from dsrc.review.state import IOU_THRESHOLDS, ReviewState
from dsrc.review.texts import fates_table
from sensors.corruptions import CLEAN

_PATIENCE_S = 2.0
"""Age up to which scores may lack frames that were detected in since, s."""
_WHOLE_RUN: dict[str, Any] = {
    "listed": "all", "versus": "", "error_method": "", "error_class": "", "error_range": "any", "error_seen_by": "",
}  # fmt: skip
"""Fields of a state whose scores are those of all objects."""


def _known(state: ReviewState) -> tuple[CorruptionParameter, ...]:
    return parameters_of(state.corruption, state.severity, state.family)


class _BoundParameter:
    """Widget of one parameter: what a user sets changes the state, what the state is sets the widget."""

    def __init__(self, parameter: CorruptionParameter, page: Page) -> None:
        self.name = parameter.name
        self._page = page
        self._written: Any = self
        label, gui = parameter.name.replace("_", " "), page.gui
        if not parameter.choices:
            value = _inside(parameter, parameter.value)
            self.handle: Any = gui.add_slider(label, parameter.low, parameter.high, parameter.step, initial_value=value)
        elif isinstance(parameter.value, bool):
            self.handle = gui.add_checkbox(label, parameter.value)
        else:
            self.handle = gui.add_dropdown(
                label, tuple(map(str, parameter.choices)), initial_value=str(parameter.value)
            )
        self.handle.on_update(self._take)

    def show(self, parameter: CorruptionParameter, value: object) -> None:
        """Set the widget to a value."""
        wanted = value if isinstance(value, bool) else str(value) if parameter.choices else _inside(parameter, value)
        if self.handle.value != wanted:
            self._written = wanted
            self.handle.value = wanted

    def _take(self, event: Any) -> None:
        value = event.target.value
        # Setting a widget fires this too: what was written here is not the user's.
        if event.client_id is None and value == self._written:
            return
        self._written = self
        state = self._page.state
        known = _known(state)
        parameter = next((one for one in known if one.name == self.name), None)
        if parameter is None:
            return
        if parameter.choices:
            value = next((choice for choice in parameter.choices if str(choice) == str(value)), parameter.value)
        else:
            if not math.isfinite(value):
                return
            value = type(parameter.value)(_inside(parameter, value))
        self._page.update(parameters=changed(state.parameters, self.name, value, known))


def _inside(parameter: CorruptionParameter, value: Any) -> float:
    return min(max(value, parameter.low), parameter.high)


class CorruptionLabPanel:
    """Folder with the corruption, its parameters, the points that it adds, moves and removes, and the AP under it."""

    def __init__(self, page: Page) -> None:
        """Build the folder; the parameters come with the corruption."""
        self._page = page
        self._shapes: tuple[Any, ...] = ()
        self.parameters: dict[str, _BoundParameter] = {}
        with page.gui.add_folder("Corruption lab", expand_by_default=False):
            self.controls = build_controls("Corruption lab", page)
            self._folder = page.gui.add_folder("Parameters", visible=False)
            self.reset = page.gui.add_button("Parameters of the severity", visible=False)
            self.reset.on_click(lambda _: page.update(parameters=()))
            self.effects = page.gui.add_html("", visible=False)
            self.fates = page.gui.add_button("Colour points by their fate", visible=False)
            self.fates.on_click(lambda _: page.update(color_by="agent" if page.state.color_by == "fate" else "fate"))
            self.scores = page.gui.add_markdown("", visible=False)
            self.detect = page.gui.add_button("AP over the drive", visible=False)
            self.detect.on_click(self._detect)

    def show(self, shown: Shown) -> None:
        """Set the controls and parameters, count the points of the drawn frame, and write the AP that is known."""
        for control in self.controls:
            control.show(shown)
        self._show_parameters(shown.state)
        corrupted = shown.state.corruption != CLEAN
        set_fields(self.effects, visible=corrupted and shown.view is not None)
        if corrupted and shown.view is not None:
            set_fields(self.effects, content=fates_table(shown.view))
        other = "agent" if shown.state.color_by == "fate" else "fate"
        set_fields(self.fates, visible=corrupted, label=f"Colour points by their {other}")
        self._show_scores(shown)

    def _show_parameters(self, state: ReviewState) -> None:
        known = _known(state)
        # Values alone move the widgets that there are; a slider under the mouse must not be built again.
        shapes = tuple(replace(parameter, value=type(parameter.value)()) for parameter in known)
        if shapes != self._shapes:
            for bound in self.parameters.values():
                bound.handle.remove()
            with self._folder:
                self.parameters = {parameter.name: _BoundParameter(parameter, self._page) for parameter in known}
            self._shapes = shapes
        values = dict(state.parameters)
        for parameter in known:
            self.parameters[parameter.name].show(parameter, values.get(parameter.name, parameter.value))
        set_fields(self._folder, visible=bool(known))
        set_fields(self.reset, visible=bool(values) and bool(known))

    def _show_scores(self, shown: Shown) -> None:
        """Write the AP of the judged method on clean and on corrupted sweeps, as far as its detections are known."""
        state = shown.state
        method = shown.model.method(state)
        judged = state.corruption != CLEAN and bool(method) and shown.model.labelled(state.drive)
        set_fields(self.scores, visible=judged)
        if not judged:
            set_fields(self.detect, visible=False)
            return
        lacking, jobs = False, bool(self._page.detecting())
        patience = _PATIENCE_S if jobs or self._page.playing else 0.0
        clean_and_corrupted = (CLEAN, CLEAN), (state.corruption.replace("_", " "), state.corruption)
        rows = []
        for title, corruption in clean_and_corrupted:
            run = self._page.report(replace(state, corruption=corruption, methods=(method,), **_WHOLE_RUN), patience)
            lacking |= run.known < run.total
            known = [f"{100 * run.curves[method, iou].ap:.1f}" if run.known else "–" for iou in IOU_THRESHOLDS]
            rows.append(f"| {title} | {' | '.join(known)} | {run.known} of {run.total} |")
        label = "Stop" if jobs else "AP over the drive"
        set_fields(self.detect, visible=jobs or (lacking and shown.model.computes(state)), label=label)
        head = " | ".join(f"AP{100 * iou:.0f}" for iou in IOU_THRESHOLDS)
        table = "\n".join(rows)
        set_fields(self.scores, content=f"| % | {head} | frames |\n|:--|{'--:|' * (len(IOU_THRESHOLDS) + 1)}\n{table}")

    def _detect(self, _: object) -> None:
        if self._page.detecting():
            self._page.cancel()
            return
        # Against clean sweeps: these are detected in as well.
        self._page.update(versus="")
        self._page.detect_all()
