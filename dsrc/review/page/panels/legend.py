"""Legend: what the frame counts, and what colours mean."""

from dsrc.review.page.page import Shown
from dsrc.review.page.panels.panel import Panel, set_fields
from dsrc.review.texts import summary

_WIDTH_PX = 340
"""Of a window of 700 px less than half."""


class LegendPanel(Panel):
    """Window over the lower left of the scene, which stays where the panels are folded."""

    def build(self) -> None:
        """Add the window, empty."""
        self.window = self._page.gui.add_panel()
        self.window.float(x=12, y=-12, width=_WIDTH_PX)
        with self.window.add_tab("Legend"):
            self.text = self._page.gui.add_html("")

    def show(self, shown: Shown) -> None:
        """Write what the drawn frame counts, why it is missing, and the legend."""
        if shown.view is not None:
            set_fields(self.text, content=summary(shown.view))
