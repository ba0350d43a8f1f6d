"""Timeline: drive, frame, steps, playing and camera."""

from dsrc.review.page.panels.widgets import build_controls
from dsrc.review.page.protocol import Page, Shown

_STEPS = {"−10": -10, "−1": -1, "+1": 1, "+10": 10}


class TimelinePanel:
    """Controls above the folders, with buttons that step and play."""

    def __init__(self, page: Page) -> None:
        """Build it at the top of the page."""
        self._page = page
        self.play = page.gui.add_button("Play", hint="key Space")
        self.play.on_click(lambda _: page.toggle_play())
        self.steps = page.gui.add_button_group("Step", tuple(_STEPS))
        self.steps.on_click(lambda event: page.step(_STEPS[event.target.value]))
        self.controls = build_controls("", page)

    def show(self, shown: Shown) -> None:
        """Set the controls, and label the button with its next action."""
        for control in self.controls:
            control.show(shown)
        label = "Pause" if self._page.playing else "Play"
        if self.play.label != label:
            self.play.label = label
