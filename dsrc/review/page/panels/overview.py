"""Overview: the start of the page, a table of what the run lost, whose numbers open the worst errors."""

from html import escape

from dsrc.review.page.link import write_link
from dsrc.review.page.protocol import Page, Shown
from dsrc.review.texts import html_table


class OverviewPanel:
    """Folder at the top of the page, open until an error is looked at."""

    def __init__(self, page: Page) -> None:
        """Build it, empty."""
        self._page = page
        chosen = page.state.object_id is not None or page.state.detection is not None
        with page.gui.add_folder("Overview", expand_by_default=not chosen):
            self.table = page.gui.add_html("")

    def show(self, shown: Shown) -> None:
        """Write lines and table, whose links are what the address bar shows there."""
        found = self._page.overview(shown.state)
        lines = "".join(f"<p style='margin:.2em .9em;font-size:.8em'>{escape(line)}</p>" for line in found.says)

        def link(row: int, column: int) -> str:
            opens = found.rows[row][column].opens
            return "" if opens is None else f"?{write_link(shown.model, opens, None)}"

        rows = [[cell.text for cell in row] for row in found.rows]
        table = html_table(found.head, rows, link) if rows else ""
        content = f'{lines}<div style="max-height:22em;overflow:auto">{table}</div>'
        if self.table.content != content:
            self.table.content = content
