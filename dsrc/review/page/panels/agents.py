"""Agents: which of them have their points drawn."""

from dsrc.review.page.controls import Control, Switch
from dsrc.review.page.page import Shown
from dsrc.review.page.panels.panel import BoundControl, Panel


class AgentsPanel(Panel):
    """Folder with one switch per agent of the frame; they come with the first frame."""

    title = "Agents"
    table = (Control("hidden", None, link="hidden"),)

    def build(self) -> None:
        """Add nothing yet."""
        self.switches: dict[int, BoundControl] = {}

    def show(self, shown: Shown) -> None:
        """List the agents again when others are there, and set their switches."""
        agents = {} if shown.view is None else {agent.agent_id: agent.name.capitalize() for agent in shown.view.agents}
        if agents and list(agents) != list(self.switches):
            for switch in self.switches.values():
                switch.handle.remove()
            with self.folder:
                self.switches = {
                    number: BoundControl(Control("hidden", Switch(number), title), self._page)
                    for number, title in agents.items()
                }
        for switch in self.switches.values():
            switch.show(shown)
