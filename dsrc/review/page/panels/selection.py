"""Selection: card of the selected object or detection."""

from dsrc.review.page.panels.widgets import build_controls
from dsrc.review.page.protocol import Page, Shown
from dsrc.review.texts import selection_report


class SelectionPanel:
    """Open folder with a list of the objects and the card."""

    def __init__(self, page: Page) -> None:
        """Build it with nothing selected."""
        with page.gui.add_folder("Selection"):
            self.controls = build_controls("Selection", page)
            self.card = page.gui.add_markdown("")

    def show(self, shown: Shown) -> None:
        """Write the card."""
        for control in self.controls:
            control.show(shown)
        if shown.view is not None:
            gone = shown.state.object_id is not None and shown.view.details is None
            self.card.content = "Not in this frame." if gone else selection_report(shown.view.details)
