"""Stage: scene of one browser, with a root per drive of which one is shown."""

from collections.abc import Callable, Sequence

import viser
from numpy.typing import NDArray

from dsrc.review.page.scene import Clicked, SceneWriter, place_frame, set_sky
from dsrc.review.state import Theme
from dsrc.review.static import StaticPart
from dsrc.review.view import FrameView


def root_of(drive: int) -> str:
    """Node of the scene below which a drive is drawn, in the row of its model."""
    return f"/drive{drive}"


class Stage:
    """Scene of one browser: the newest frame below the root of its drive, sky and world of the theme; not thread-safe.

    Attributes:
        roots: nodes of the drives; a camera that follows moves them.
        writer: of the shown drive.
    """

    def __init__(self, client: viser.ClientHandle, drives: int, on_click: Callable[[Clicked], None]) -> None:
        """Draw nothing yet.

        Args:
            on_click: called with the object or detection that is clicked.
        """
        self._client, self._on_click = client, on_click
        self._theme: Theme | None = None
        self._cut = False
        self._world: Sequence[StaticPart] | None = None
        self.roots = [client.scene.add_frame(root_of(row), show_axes=False, visible=False) for row in range(drives)]
        self.writer = self._writer_of(0)

    def set_look(self, theme: Theme, cut: bool) -> None:
        """Set panels, sky and world to a theme, and let walls and plants end low, or stand as they are."""
        if (theme, cut) == (self._theme, self._cut):
            return
        if theme != self._theme:
            self._client.gui.configure_theme(
                dark_mode=theme == "dark",
                show_logo=False,
                show_share_button=False,
                brand_color=(56, 150, 255),
                control_width="medium",
            )
            set_sky(self._client.scene, theme)
        self._theme, self._cut = theme, cut
        if self._world is not None:
            self.place_world(self._world)

    def place_world(self, parts: Sequence[StaticPart]) -> None:
        """Draw the static world of the shown drive."""
        self._world = parts
        with self._client.atomic():
            self.writer.place_world(parts, self._theme or "light", self._cut)

    def draw(self, view: FrameView, drive: int, scene_from_review: Callable[[], NDArray]) -> None:
        """Draw a frame in place of the last one.

        Args:
            scene_from_review: function to the (4, 4) pose of the review frame, called once the frame is drawn.
        """
        if self.writer.root != root_of(drive):
            self.writer.clear()
            self._world = None
            self.writer = self._writer_of(drive)
        with self._client.atomic():
            self.writer.write(view)
            for row, root in enumerate(self.roots):
                root.visible = row == drive
            place_frame(self.roots[drive], scene_from_review())

    def _writer_of(self, drive: int) -> SceneWriter:
        return SceneWriter(self._client.scene, root_of(drive), on_click=self._on_click)
