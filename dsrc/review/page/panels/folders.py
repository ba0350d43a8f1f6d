"""Folders that hold rows of the table of controls and nothing else."""

from dsrc.review.page.panels.widgets import build_controls
from dsrc.review.page.protocol import Page, Shown


class _Folder:
    title: str
    opened = True

    def __init__(self, page: Page) -> None:
        """Build the folder."""
        self.folder = page.gui.add_folder(self.title, expand_by_default=self.opened)
        with self.folder:
            self.controls = build_controls(self.title, page)

    def show(self, shown: Shown) -> None:
        """Set the controls; a folder whose controls are all hidden is hidden."""
        for control in self.controls:
            control.show(shown)
        visible = any(control.handle.visible for control in self.controls)
        if self.folder.visible != visible:
            self.folder.visible = visible


class DetectionsPanel(_Folder):
    """Threshold, IoU and who detects."""

    title = "Detections"


class LookPanel(_Folder):
    """Points, layers and theme."""

    title = "Look"
    opened = False
