"""Timeline, legend, selection, agents and folders: panels that show the drawn frame or rows of the controls alone."""

from dsrc.review.page.controls import Control, Switch
from dsrc.review.page.panels.widgets import BoundControl, build_controls, set_fields
from dsrc.review.page.protocol import Page, Shown
from dsrc.review.texts import frame_report, legend, notice_text, selection_report

_LEGEND_PX = 290
"""Width of the legend, px: half of a window of 700 px."""
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


class LegendPanel:
    """Window over the scene, which stays where the panel is folded: what the frame counts, and what colours mean."""

    def __init__(self, page: Page) -> None:
        """Build it at the lower left, empty."""
        self.window = page.gui.add_panel()
        self.window.float(x=12, y=-12, width=_LEGEND_PX)
        with self.window.add_tab("Legend"):
            self.text = page.gui.add_markdown("")
            self.notice = page.gui.add_markdown("", visible=False)
            self.legend = page.gui.add_html("")

    def show(self, shown: Shown) -> None:
        """Write the report of the drawn frame, why it is missing, and the legend."""
        if shown.view is not None:
            set_fields(self.text, content=frame_report(shown.view))
            notice = notice_text(shown.view)
            set_fields(self.notice, content=notice, visible=bool(notice))
            set_fields(self.legend, content=legend(shown.view))


class SelectionPanel:
    """Open folder with the card and a list of the objects."""

    def __init__(self, page: Page) -> None:
        """Build it with nothing selected."""
        with page.gui.add_folder("Selection"):
            self.card = page.gui.add_markdown("")
            self.controls = build_controls("Selection", page)

    def show(self, shown: Shown) -> None:
        """Write the card."""
        for control in self.controls:
            control.show(shown)
        if shown.view is not None:
            gone = shown.state.object_id is not None and shown.view.details is None
            self.card.content = "Not in this frame." if gone else selection_report(shown.view.details)


class AgentsPanel:
    """Folder with one switch per agent of the frame."""

    def __init__(self, page: Page) -> None:
        """Build the folder; the switches come with the first frame."""
        self._page = page
        self._folder = page.gui.add_folder("Agents", expand_by_default=False)
        self._agents: tuple[int, ...] = ()
        self.switches: dict[int, BoundControl] = {}

    def show(self, shown: Shown) -> None:
        """List the agents again when others are there, and set their switches."""
        if shown.view is None:
            return
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
