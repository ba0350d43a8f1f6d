"""Gallery: the listed errors as small pictures grouped by cause; a click opens one."""

from dsrc.review.errors.gallery import gallery_html
from dsrc.review.page.controls import Control, Switch, detects
from dsrc.review.page.page import Shown
from dsrc.review.page.panels.panel import Panel, set_fields
from sim.errors import SettingsError


class GalleryPanel(Panel):
    """Folder with a switch and the pictures, hidden where nothing is judged."""

    title = "Errors by cause"
    table = (Control("gallery", Switch(), "Pictures", link="gallery", shown=detects),)

    def is_open(self) -> bool:
        """Whether pictures are asked for."""
        return self._page.state.gallery

    def build(self) -> None:
        """Add the pictures below the switch."""
        self.folder.visible = False
        super().build()
        self.pictures = self._page.gui.add_html("")

    def show(self, shown: Shown) -> None:
        """Draw further pictures, of the errors that are listed now."""
        super().show(shown)
        set_fields(self.folder, visible=shown.judged)
        content = ""
        if shown.judged and shown.state.gallery:
            try:
                pictures = self._page.gallery(shown.state)
            except SettingsError:
                pictures = []  # the list of errors says what is wrong
            content = gallery_html(pictures, [f"?{self._page.link(one.opens)}" for one in pictures])
        set_fields(self.pictures, content=content)
