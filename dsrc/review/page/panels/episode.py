"""Episode: what the driver does at the drawn step and why, how it ends, and the cause of a crash."""

from dsrc.review.page.panels.widgets import set_fields
from dsrc.review.page.protocol import Page, Shown
from dsrc.review.texts import moment_report, quoted


class EpisodePanel:
    """Folder with the step and the cause in words; hidden in drives."""

    def __init__(self, page: Page) -> None:
        """Build it, hidden."""
        self._page = page
        self.folder = page.gui.add_folder("Episode", visible=False)
        with self.folder:
            self.text = page.gui.add_markdown("")

    def show(self, shown: Shown) -> None:
        """Write the step, and the cause once it is known."""
        moment = None if shown.view is None else shown.view.moment
        set_fields(self.folder, visible=moment is not None)
        line = shown.model.timeline(shown.state.drive)
        if shown.view is None or moment is None or line is None:
            return
        why = self._page.why_crashed(shown.state.drive)
        cause = f"**{quoted(why)}**\n\n" if why else ""
        set_fields(self.text, content=f"{cause}{moment_report(moment, line, shown.view.index)}")
