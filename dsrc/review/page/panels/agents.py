"""Agents: legend of the colours and whose points are drawn."""

from dsrc.review.page.controls import Control, Switch
from dsrc.review.page.panels.widgets import BoundControl
from dsrc.review.page.protocol import Page, Shown
from dsrc.review.texts import legend


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
