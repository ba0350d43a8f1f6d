"""Episode: what the driver does at the drawn step and why, how it ends, and the cause of a crash."""

from dsrc.review.page.page import Shown
from dsrc.review.page.panels.panel import Panel, set_fields
from dsrc.review.texts import moment_report


class EpisodePanel(Panel):
    """Open folder with the step and the cause in words, hidden in drives."""

    title, opened = "Episode", True

    def build(self) -> None:
        """Add the text; hidden until there is a step."""
        self.folder.visible = False
        self.text = self._page.gui.add_html("")

    def show(self, shown: Shown) -> None:
        """Write the step, and the cause once it is known."""
        moment, line = None if shown.view is None else shown.view.moment, shown.source.timeline()
        set_fields(self.folder, visible=moment is not None)
        if shown.view is not None and moment is not None and line is not None:
            why = self._page.why_crashed(shown.source)
            set_fields(self.text, content=moment_report(moment, line, shown.view.index, why))
