"""Legend: what the frame counts, and what colours mean."""

from dsrc.review.page.page import Shown
from dsrc.review.page.panels.panel import Panel, set_fields
from dsrc.review.texts import frame_report, legend, notice_text

_WIDTH_PX = 315
"""Of a window of 700 px less than half."""


class LegendPanel(Panel):
    """Window over the lower left of the scene, which stays where the panels are folded."""

    def build(self) -> None:
        """Add the window, empty."""
        self.window = self._page.gui.add_panel()
        self.window.float(x=12, y=-12, width=_WIDTH_PX)
        with self.window.add_tab("Legend"):
            self.text = self._page.gui.add_markdown("")
            self.notice = self._page.gui.add_markdown("", visible=False)
            self.legend = self._page.gui.add_html("")

    def show(self, shown: Shown) -> None:
        """Write the report of the drawn frame, why it is missing, and the legend."""
        if shown.view is not None:
            set_fields(self.text, content=frame_report(shown.view))
            notice = notice_text(shown.view)
            set_fields(self.notice, content=notice, visible=bool(notice))
            set_fields(self.legend, content=legend(shown.view))
