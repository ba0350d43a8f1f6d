"""Over time: plots of the selected object under the timeline; a click goes to its instant."""

from typing import Any

from dsrc.review.page.panels.widgets import set_fields
from dsrc.review.page.protocol import Page, Shown


class OverTimePanel:
    """Folder with one picture of plots, hidden where there is none."""

    def __init__(self, page: Page) -> None:
        """Build it, hidden."""
        self._page = page
        self.folder = page.gui.add_folder("Over time", visible=False)
        with self.folder:
            self.plots = page.gui.add_html("")
            # The script of the page sets it to the frame that is clicked.
            self.clicked = page.gui.add_number("Clicked frame", 0, visible=False)
        self.clicked.on_update(self._go)

    def show(self, shown: Shown) -> None:
        """Draw the plots, with the present in them."""
        drawn = "" if shown.view is None else self._page.over_time(shown.state, shown.view)
        set_fields(self.folder, visible=bool(drawn))
        set_fields(self.clicked, value=shown.state.frame)
        content = f'<div data-goto="{self.clicked._impl.uuid}" style="margin:0 .6em">{drawn}</div>' if drawn else ""
        set_fields(self.plots, content=content)

    def _go(self, event: Any) -> None:
        if event.client_id is not None:
            self._page.step(int(event.target.value) - self._page.state.frame)
