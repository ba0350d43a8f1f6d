"""Timeline, report, selection, agents and folders: panels that show the drawn frame or rows of the controls alone."""

from dsrc.review.page.controls import Control, Switch
from dsrc.review.page.panels.widgets import BoundControl, build_controls, set_fields
from dsrc.review.page.protocol import Page, Shown
from dsrc.review.texts import frame_report, legend, notice_text, selection_report

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
        set_fields(self.play, label="Pause" if self._page.playing else "Play")


class ReportPanel:
    """Table of TP, FP, FN, precision and recall, and why it is missing."""

    def __init__(self, page: Page) -> None:
        """Build it, empty."""
        self.text = page.gui.add_markdown("")
        self.notice = page.gui.add_markdown("", visible=False)

    def show(self, shown: Shown) -> None:
        """Write the report of the drawn frame."""
        if shown.view is not None:
            self.text.content = frame_report(shown.view)
            self.notice.content = notice_text(shown.view)
            self.notice.visible = bool(self.notice.content)


class SelectionPanel:
    """Open folder with a list of the objects and the card."""

    def __init__(self, page: Page) -> None:
        """Build it with nothing selected."""
        with page.gui.add_folder("Selection"):
            self.controls = build_controls("Selection", page)
            self.card = page.gui.add_markdown("")

    def show(self, shown: Shown) -> None:
        """Write the card."""
        for control in self.controls:
            control.show(shown)
        if shown.view is not None:
            gone = shown.state.object_id is not None and shown.view.details is None
            self.card.content = "Not in this frame." if gone else selection_report(shown.view.details)


class AgentsPanel:
    """Folder with the legend and one switch per agent of the frame."""

    def __init__(self, page: Page) -> None:
        """Build the folder; the switches come with the first frame."""
        self._page = page
        self._folder = page.gui.add_folder("Agents and colours")
        self._agents: tuple[int, ...] = ()
        self.switches: dict[int, BoundControl] = {}
        with self._folder:
            self.legend = page.gui.add_html("")

    def show(self, shown: Shown) -> None:
        """Write the legend, and list the agents again when others are there."""
        if shown.view is None:
            return
        self.legend.content = legend(shown.view)
        agents = tuple(agent.agent_id for agent in shown.view.agents)
        if agents != self._agents:
            for switch in self.switches.values():
                switch.handle.remove()
            with self._folder:
                self.switches = {
                    agent.agent_id: BoundControl(
                        Control("hidden", Switch(agent.agent_id), agent.title.capitalize()), self._page
                    )
                    for agent in shown.view.agents
                }
            self._agents = agents
        for switch in self.switches.values():
            switch.show(shown)


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
        set_fields(self.folder, visible=any(control.handle.visible for control in self.controls))


class DetectionsPanel(_Folder):
    """Threshold, IoU and who detects."""

    title = "Detections"


class LookPanel(_Folder):
    """Points, layers and theme."""

    title = "Look"
    opened = False
