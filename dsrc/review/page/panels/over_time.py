"""Over time: plots of the selected object under the timeline; a click goes to its instant."""

from typing import Any

from dsrc.review.page.page import Shown
from dsrc.review.page.panels.panel import Panel, clickable, set_fields


class OverTimePanel(Panel):
    """Open folder with one picture of plots, hidden where there is none."""

    title, opened = "Over time", True

    def build(self) -> None:
        """Add the picture and the frame that is clicked in it."""
        self.folder.visible = False
        self.plots = self._page.gui.add_html("")
        self.clicked = self._page.gui.add_number("Clicked frame", 0, visible=False)
        self.clicked.on_update(self._go)

    def show(self, shown: Shown) -> None:
        """Draw the plots, with the present in them."""
        drawn = "" if shown.view is None else self._page.over_time(shown.state, shown.view)
        set_fields(self.folder, visible=bool(drawn))
        set_fields(self.clicked, value=shown.state.frame)
        set_fields(self.plots, content=clickable(drawn, self.clicked, "margin:0 .6em") if drawn else "")

    def _go(self, event: Any) -> None:
        if event.client_id is not None:
            self._page.step(int(event.target.value) - self._page.state.frame)
