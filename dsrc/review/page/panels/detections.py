"""Detections: threshold, IoU and who detects."""

from typing import Any

from dsrc.review.page.controls import Choice, Control, Slider, Switch, detects, same
from dsrc.review.page.page import Shown
from dsrc.review.page.panels.panel import Panel, set_fields
from dsrc.review.state import IOU_THRESHOLDS


def _agents(shown: Shown) -> dict[str, Any]:
    return {"–": None} if shown.view is None else {agent.name: agent.agent_id for agent in shown.view.agents}


def _ego(shown: Shown) -> int | None:
    """Agent that detects: the one that is asked for, else that of the drawn frame."""
    drawn = None if shown.view is None else shown.view.ego.agent_id
    return drawn if shown.state.ego_id is None else shown.state.ego_id


def _methods(shown: Shown) -> dict[str, Any]:
    """Each method alone, and the shown one with those over it."""
    methods = shown.state.methods
    options: dict[str, Any] = {name: (name,) for name in shown.source.sets} or {"none": ()}
    return {**options, ", ".join(methods): methods} if len(methods) > 1 else options


class DetectionsPanel(Panel):
    """Open folder, hidden where nothing detects."""

    title, opened = "Detections", True
    table = (
        Control("threshold", Slider(0.0, 1.0, 0.01), "Score ≥", link="score", shown=detects),
        Control("iou", Choice(same(*IOU_THRESHOLDS)), "IoU ≥", link="iou", key="I", shown=detects),
        Control("ego_id", Choice(_agents, closed=False), "Ego", link="ego", shown=detects, read=_ego),
        Control("cooperative", Switch(), "Cooperative", link="cooperative", key="V", shown=detects),
        Control(
            "methods",
            Choice(_methods, closed=False),
            "Method",
            link="methods",
            shown=lambda shown: len(shown.source.sets) > 1,
            read=lambda shown: shown.state.methods or tuple(shown.source.sets)[:1],
        ),
    )

    def show(self, shown: Shown) -> None:
        """Hide the folder where all of its controls are hidden."""
        super().show(shown)
        set_fields(self.folder, visible=any(control.handle.visible for control in self.controls))
