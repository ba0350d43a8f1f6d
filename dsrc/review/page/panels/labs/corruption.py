"""Corruption lab: a corruption with its parameters, what it does to the points and to the AP of the drive."""

from dataclasses import replace
from typing import Any

from dsrc.review.labs.parameters import CorruptionParameter, changed, parameters_of
from dsrc.review.page.controls import Choice, Control, Slider, Switch, same
from dsrc.review.page.page import Shown
from dsrc.review.page.panels.panel import BoundControl, Panel, set_fields
from dsrc.review.state import IOU_THRESHOLDS, ReviewState
from dsrc.review.texts import fates_table
from sensors.corruptions import CLEAN, CORRUPTIONS, EVERYONE, FAMILIES

_WHOLE_RUN: dict[str, Any] = {
    "listed": "all", "versus": "", "error_method": "", "error_class": "", "error_range": "any", "error_seen_by": "",
}  # fmt: skip
"""Fields of a state whose scores are those of all objects."""


def _known(state: ReviewState) -> tuple[CorruptionParameter, ...]:
    return parameters_of(state.corruption, state.severity, state.family)


def _control(parameter: CorruptionParameter) -> Control:
    """Control of a parameter, which changes its value alone."""
    name, widget = parameter.name, Slider(parameter.low, parameter.high, parameter.step)

    def read(shown: Shown) -> Any:
        usual = next((one.value for one in _known(shown.state) if one.name == name), parameter.value)
        return dict(shown.state.parameters).get(name, usual)

    def write(shown: Shown, value: Any) -> dict[str, Any]:
        return {"parameters": changed(shown.state.parameters, name, value, _known(shown.state))}

    choice = Switch() if isinstance(parameter.value, bool) else Choice(same(*parameter.choices))
    shape = choice if parameter.choices else widget
    return Control("parameters", shape, name.replace("_", " "), read=read, write=write)


def _corruptions(shown: Shown) -> dict[str, Any]:
    """Corruptions, and what stored detections are of beside them: faults."""
    stored = (condition.kind for one in shown.source.sets.values() for condition in one.conditions() or ())
    return {kind: kind for kind in (CLEAN, *CORRUPTIONS, *stored)}


def _corruptible(shown: Shown) -> dict[str, Any]:
    """Agents that a corruption may be of: all, some by their part, each alone, and those of the link."""
    agents, asked = () if shown.view is None else shown.view.agents, shown.state.corrupted_agents
    names = {"all agents": EVERYONE, "the ego": "ego", "the helpers": "helpers"}
    names |= {"vehicles": "vehicles", "roadside units": "roadside"}
    names |= {f"{agent.name} alone": str(agent.agent_id) for agent in agents}
    return names if asked in names.values() else {**names, asked: asked}


def _corrupted(shown: Shown) -> bool:
    return shown.state.corruption in CORRUPTIONS


class CorruptionLabPanel(Panel):
    """Folder with the corruption, its parameters, the points that it adds, moves and removes, and the AP under it."""

    title = "Corruption lab"
    table = (
        Control("corruption", Choice(_corruptions), "Corruption", link="corruption"),
        Control("severity", Slider(1, 5, 1), "Severity", link="severity", enabled=_corrupted),
        Control("family", Choice(same(*FAMILIES)), "Settings", link="family", enabled=_corrupted),
        Control("corrupted_agents", Choice(_corruptible, closed=False), "Agents", link="who", enabled=_corrupted),
        Control("parameters", None, link="parameters"),
    )

    def build(self) -> None:
        """Add the widgets; those of the parameters come with the corruption."""
        super().build()
        gui, page = self._page.gui, self._page
        self._shapes: tuple[Any, ...] = ()
        self.parameters: dict[str, BoundControl] = {}
        self._folder = gui.add_folder("Parameters", visible=False)
        self.reset = gui.add_button("Parameters of the severity", visible=False)
        self.reset.on_click(lambda _: page.update(parameters=()))
        self.effects = gui.add_html("", visible=False)
        self.fates = gui.add_button("Colour points by their fate", visible=False)
        self.fates.on_click(lambda _: page.update(color_by="agent" if page.state.color_by == "fate" else "fate"))
        self.scores = gui.add_markdown("", visible=False)
        self.detect = gui.add_button("AP over the drive", visible=False)
        self.detect.on_click(self._detect)

    def show(self, shown: Shown) -> None:
        """Set the controls and parameters, count the points of the drawn frame, and write the AP that is known."""
        super().show(shown)
        self._show_parameters(shown)
        corrupted = shown.state.corruption != CLEAN
        set_fields(self.effects, visible=corrupted and shown.view is not None)
        if corrupted and shown.view is not None:
            set_fields(self.effects, content=fates_table(shown.view))
        other = "agent" if shown.state.color_by == "fate" else "fate"
        set_fields(self.fates, visible=corrupted, label=f"Colour points by their {other}")
        self._show_scores(shown)

    def _show_parameters(self, shown: Shown) -> None:
        known = _known(shown.state)
        # Values alone move the widgets that there are; a slider under the mouse must not be built again.
        shapes = tuple(replace(parameter, value=type(parameter.value)()) for parameter in known)
        if shapes != self._shapes:
            for bound in self.parameters.values():
                bound.handle.remove()
            with self._folder:
                self.parameters = {one.name: BoundControl(_control(one), self._page) for one in known}
            self._shapes = shapes
        for control in self.parameters.values():
            control.show(shown)
        set_fields(self._folder, visible=bool(known))
        set_fields(self.reset, visible=bool(known) and bool(shown.state.parameters))

    def _show_scores(self, shown: Shown) -> None:
        """Write the AP of the judged method on clean and on corrupted sweeps, as far as its detections are known."""
        state = shown.state
        method = shown.model.method(state)
        judged = state.corruption != CLEAN and shown.judged
        set_fields(self.scores, visible=judged)
        if not judged:
            set_fields(self.detect, visible=False)
            return
        lacking, jobs = False, bool(self._page.detecting())
        clean_and_corrupted = (CLEAN, CLEAN), (state.corruption.replace("_", " "), state.corruption)
        rows = []
        for title, corruption in clean_and_corrupted:
            run = self._page.report(replace(state, corruption=corruption, methods=(method,), **_WHOLE_RUN))
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
