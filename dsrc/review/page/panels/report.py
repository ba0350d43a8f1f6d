"""Report: counts of the drawn frame and of the frames seen."""

from dsrc.review.page.protocol import Page, Shown
from dsrc.review.texts import frame_report, notice


class ReportPanel:
    """Table of TP, FP, FN, precision and recall, and why it is missing."""

    def __init__(self, page: Page) -> None:
        """Build it, empty."""
        self.text = page.gui.add_markdown("")
        self.notice = page.gui.add_markdown("", visible=False)

    def show(self, shown: Shown) -> None:
        """Write the report of the drawn frame."""
        if shown.view is not None:
            self.text.content = frame_report(shown.view)
            self.notice.content = notice(shown.view)
            self.notice.visible = bool(self.notice.content)
