"""Overview: the start of the page, a table of what the run lost, whose numbers open the worst errors."""

from html import escape

from dsrc.review.page.page import Shown
from dsrc.review.page.panels.panel import Panel, set_fields
from dsrc.review.texts import html_table


class OverviewPanel(Panel):
    """Folder, open until an error is looked at; open for several episodes, each of which selects whom the ego meets."""

    title = "Overview"

    def is_open(self) -> bool:
        """Whether nothing is selected, or there are several episodes."""
        episodes = self._page.source.kind == "episode" and len(self._page.model.sources) > 1
        return episodes or not self._page.state.selects

    def build(self) -> None:
        """Add the table, empty."""
        self.table_html = self._page.gui.add_html("")

    def show(self, shown: Shown) -> None:
        """Write lines and table, whose links are what the address bar shows there."""
        found = self._page.overview(shown.state)
        lines = "".join(f"<p style='margin:.2em .9em;font-size:.8em'>{escape(line)}</p>" for line in found.says)

        def link(row: int, column: int) -> str:
            opens = found.rows[row][column].opens
            return "" if opens is None else f"?{self._page.link(opens)}"

        rows = [[cell.text for cell in row] for row in found.rows]
        table = html_table(found.head, rows, link) if rows else ""
        set_fields(self.table_html, content=f'{lines}<div style="max-height:22em;overflow:auto">{table}</div>')
