"""Gallery: the listed errors as small pictures grouped by cause; a click opens one."""

from dsrc.review.errors.gallery import gallery_html
from dsrc.review.page.link import write_link
from dsrc.review.page.panels.widgets import build_controls, set_fields
from dsrc.review.page.protocol import Page, Shown
from sim.errors import SettingsError


class GalleryPanel:
    """Folder with a switch and the pictures."""

    def __init__(self, page: Page) -> None:
        """Build it, hidden until there is something to judge."""
        self._page = page
        self.folder = page.gui.add_folder("Errors by cause", visible=False, expand_by_default=page.state.gallery)
        with self.folder:
            self.controls = build_controls("Errors by cause", page)
            self.pictures = page.gui.add_html("")

    def show(self, shown: Shown) -> None:
        """Draw further pictures, of the errors that are listed now."""
        judged = bool(shown.model.methods(shown.state.drive)) and shown.model.labelled(shown.state.drive)
        set_fields(self.folder, visible=judged)
        for control in self.controls:
            control.show(shown)
        content = ""
        if judged and shown.state.gallery:
            try:
                pictures = self._page.gallery(shown.state)
            except SettingsError:
                pictures = []  # the list of errors says what is wrong
            content = gallery_html(pictures, [f"?{write_link(shown.model, one.opens, None)}" for one in pictures])
        if self.pictures.content != content:
            self.pictures.content = content
