"""Timeline: drive and frame, with buttons that step and play, above the folders."""

from dsrc.review.page.controls import Choice, Control, Slider
from dsrc.review.page.page import Shown
from dsrc.review.page.panels.panel import Panel, set_fields

_STEPS = {"−10": -10, "−1": -1, "+1": 1, "+10": 10}


class TimelinePanel(Panel):
    """Controls at the top of the page."""

    table = (
        Control(
            "drive",
            Choice(lambda shown: {shown.model.title(row): row for row in range(len(shown.model.names))}),
            "Drive",
            link="drive",
            shown=lambda shown: len(shown.model.names) > 1,
        ),
        Control("frame", Slider(0, lambda shown: len(shown.source) - 1, 1), "Frame", link="frame"),
    )

    def build(self) -> None:
        """Add the buttons above the controls."""
        gui, page = self._page.gui, self._page
        self.play = gui.add_button("Play", hint="key Space")
        self.play.on_click(lambda _: page.toggle_play())
        self.steps = gui.add_button_group("Step", tuple(_STEPS))
        self.steps.on_click(lambda event: page.step(_STEPS[event.target.value]))
        super().build()

    def show(self, shown: Shown) -> None:
        """Label the button with its next action."""
        super().show(shown)
        set_fields(self.play, label="Pause" if self._page.playing else "Play")
