"""Selection: the card of an object or a detection, and a list of the objects."""

from typing import Any

from dsrc.review.page.controls import Choice, Control
from dsrc.review.page.page import Shown
from dsrc.review.page.panels.panel import Panel, set_fields
from dsrc.review.texts import paragraphs, selection_report
from sim.boxes import CLASSES


def _objects(shown: Shown) -> dict[str, Any]:
    """Objects of the frame, and the selected one even while absent."""
    selected = shown.state.object_id
    objects: dict[str, Any] = {"none": None}
    if shown.view is not None:
        truth = shown.view.truth
        names = [CLASSES[label] for label in truth.label.tolist()]
        objects |= {f"{name} {number}": number for name, number in zip(names, truth.object_id.tolist(), strict=True)}
    if selected not in objects.values():
        objects[f"object {selected}"] = selected
    return objects


class SelectionPanel(Panel):
    """Open folder."""

    title, opened = "Selection", True
    table = (
        Control("object_id", Choice(_objects, closed=False), "Object", link="object"),
        Control("detection", None, link="detection"),
    )

    def build(self) -> None:
        """Add the card above the list."""
        self.card = self._page.gui.add_html("")
        super().build()

    def show(self, shown: Shown) -> None:
        """Write the card."""
        super().show(shown)
        if shown.view is not None:
            gone = shown.state.object_id is not None and shown.view.details is None
            card = paragraphs("Not in this frame.") if gone else selection_report(shown.view.details)
            set_fields(self.card, content=card)
