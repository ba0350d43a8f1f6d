"""Share: the view as a page, a picture or a link, and views that are saved beside the run."""

import json
import logging
from html import escape
from typing import Any

from dsrc.review.page.browser import COPY_KEY, PICTURE_KEY
from dsrc.review.page.offline.pages import over_sky, picture_parts, views_html
from dsrc.review.page.page import Shown
from dsrc.review.page.panels.panel import Panel, set_fields
from sim.errors import DataError, UserError

log = logging.getLogger(__name__)

PATIENCE_S = 60.0
"""Longest time for which a browser draws a picture, s."""


class SharePanel(Panel):
    """Open folder with three buttons, and one of saved views in it."""

    title, opened = "Share", True

    def build(self) -> None:
        """Add buttons and the folder of saved views."""
        gui = self._page.gui
        shares = {"Page": self._save_page, "Picture": self._save_picture, "Link": self._copy_link}
        self.buttons = gui.add_button_group("View as", tuple(shares))
        with gui.add_folder("Saved views", expand_by_default=False, visible=self._page.notes is not None):
            self.list = gui.add_html("")
            self.name: Any = gui.add_text("Name", "")
            self.save = gui.add_button_group("View", ("Save", "Remove"))
        self.buttons.on_click(lambda event: self._share(shares[event.target.value]))
        self.save.on_click(lambda event: self._keep(event.target.value == "Save"))

    def show(self, _: Shown) -> None:
        """List the saved views."""
        views = {} if self._page.notes is None else self._page.notes.views
        lines = "".join(
            f'<a href="?{escape(link)}" style="display:block;color:inherit">{escape(name)}</a>'
            for name, link in sorted(views.items())
        )
        shown = lines or "None yet."
        set_fields(self.list, content=f'<div style="margin:0 .9em;font-size:.85em">{shown}</div>')

    def _share(self, how: Any) -> None:
        try:
            how()
        except Exception as error:
            if not isinstance(error, UserError):
                log.exception("the view is not shared")
            self._page.tell(f"The view is not shared: {error}")

    def _name(self, kind: str) -> str:
        state = self._page.state
        return f"{self._page.model.names[state.drive]}_{state.frame}.{kind}".replace("/", "_")

    def _save_page(self) -> None:
        page = self._page
        page.tell("Writing the page \u2026")
        html = views_html(page.model, page.views(), using_model=page.using_model)
        page.tell("")
        page.download(self._name("html"), html)

    def _save_picture(self) -> None:
        page, camera = self._page, self._page.client.camera
        state, view = page.state, page.view
        if view is None:
            return
        image = page.client.get_render(
            camera.image_height, camera.image_width, transport_format="png", timeout=PATIENCE_S
        )
        with page.using_model:
            parts = picture_parts(page.model, state, view, over_sky(image, state.theme))
        page.client.local_storage.set_item(PICTURE_KEY, json.dumps([self._name("png"), *parts]))

    def _copy_link(self) -> None:
        self._page.client.local_storage.set_item(COPY_KEY, "")

    def _keep(self, save: bool) -> None:
        """Save the view under the name, in place of one of that name, or remove that."""
        page, name = self._page, self.name.value.strip()
        if page.notes is None or not name:
            page.tell("A saved view needs a name." if page.notes is not None else "")
            return
        try:
            page.notes.put_view(name, page.link(page.state, page.camera.pose) if save else "")
        except (DataError, OSError) as error:
            page.tell(f"The view is not saved: {error}")
        self.show(page.shown)
