"""Ruler: distance, heading and time between two places that are clicked on the ground."""

from typing import Any

import numpy as np

from dsrc.review.page.controls import Control
from dsrc.review.page.page import Shown
from dsrc.review.page.panels.panel import Panel, set_fields
from dsrc.review.texts import ruler_report
from sim.geometry import invert, transform_points


class RulerPanel(Panel):
    """Folder with a button that starts and removes the ruler, and what it measures."""

    title = "Ruler"
    table = (Control("ruler", None, link="ruler"),)

    def build(self) -> None:
        """Add button and text, without a ruler."""
        self.measuring = False
        self.button = self._page.gui.add_button("Measure")
        self.text = self._page.gui.add_markdown("")
        self.button.on_click(lambda _: self._end() if self.measuring else self._start())

    def show(self, shown: Shown) -> None:
        """Write what is measured, or what to do."""
        ends, said = len(shown.state.ruler) // 2, "" if shown.view is None else ruler_report(shown.view)
        ask = ("Click the first place on the ground.", "Click the second place.")
        set_fields(self.text, content=ask[ends] if self.measuring and ends < len(ask) else said)
        set_fields(self.button, label="Cancel" if self.measuring else "Measure")

    def _start(self) -> None:
        self.measuring = True
        self._page.update(ruler=())
        self._page.scene.on_click()(self._take)
        self.show(self._page.shown)

    def _end(self) -> None:
        self.measuring = False
        self._page.scene.remove_click_callback()
        if len(self._page.state.ruler) < 4:
            self._page.update(ruler=())
        self.show(self._page.shown)

    def _take(self, event: Any) -> None:
        """Take the place of the ground at the ego's height that is clicked."""
        page, view = self._page, self._page.view
        if view is None or not self.measuring:
            return
        review_from_scene = invert(page.camera.scene_from_review)
        origin = np.array(event.ray_origin)
        start, beyond = transform_points(review_from_scene, np.stack([origin, origin + event.ray_direction]))
        down = start[2] - beyond[2]
        if down <= 1e-6:
            page.tell("The ruler lies on the ground: click below the horizon.")
            return
        place = start + (start[2] - view.ego.review_from_body[2, 3]) / down * (beyond - start)
        page.update(ruler=(*page.state.ruler[:2], *np.round(place[:2], 2).tolist()))
        if len(page.state.ruler) == 4:
            self._end()
