"""Keyboard commands of a review page."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from dsrc.review.page.protocol import Page
from dsrc.review.state import COLOR_BY
from sensors.corruptions import CLEAN, CORRUPTIONS

STEP = 10
_AGENT_KEYS = 7


@dataclass(frozen=True, slots=True)
class Command:
    """Keyboard command: label, key and action. W A S D Q E and the arrows move the camera."""

    label: str
    key: str
    run: Callable[[], None]
    shift: bool = False

    @property
    def key_text(self) -> str:
        """Displayed key."""
        return f"{'Shift-' if self.shift else ''}{self.key.capitalize()}"


def commands(app: Page) -> list[Command]:
    """Keyboard commands of a page."""
    listed = [
        Command("Play or pause", "space", app.toggle_play),
        Command("Next frame", "L", lambda: app.step(1)),
        Command("Previous frame", "J", lambda: app.step(-1)),
        Command("Ten frames forward", "pagedown", lambda: app.step(STEP)),
        Command("Ten frames back", "pageup", lambda: app.step(-STEP)),
        Command("First frame", "home", lambda: app.update(frame=0)),
        Command("Last frame", "end", lambda: app.step(app.model.frame_count(app.state.drive))),
        Command("Next frame with an FP or FN", "N", lambda: next_error(app, 1)),
        Command("Previous frame with an FP or FN", "N", lambda: next_error(app, -1), shift=True),
        Command("Clean or corrupted", "X", lambda: toggle_corruption(app)),
        Command("Next colour of the points", "P", lambda: next_color(app)),
        Command("Camera: chase the ego", "C", lambda: app.set_camera("chase")),
        Command("Camera: bird's eye", "B", lambda: app.set_camera("bev")),
        Command("Camera: free", "F", lambda: app.set_camera("free")),
        Command("Camera: reset", "R", app.reset_camera),
        Command("Points of all agents", "0", lambda: show_only_agent(app, None)),
    ]
    for row in range(min(_AGENT_KEYS, len(app.model.readable_frame(0).agents))):
        listed.append(Command(f"Points of agent {row + 1} alone", str(row + 1), partial(show_only_agent, app, row)))
    if not app.model.has_detector:
        listed = [command for command in listed if " FN" not in command.label]
    return listed


def toggle_corruption(app: Page) -> None:
    """Switch between clean and the last corruption."""
    if app.state.corruption == CLEAN:
        app.update(corruption=app.last_corruption or next(iter(CORRUPTIONS)))
    else:
        app.update(corruption=CLEAN)


def next_color(app: Page) -> None:
    """Colour the points by the next quantity."""
    app.update(color_by=COLOR_BY[(COLOR_BY.index(app.state.color_by) + 1) % len(COLOR_BY)])


def show_only_agent(app: Page, row: int | None) -> None:
    """Show the points of the agent in a row alone; None shows all."""
    view = app.view
    if view is None or (row is not None and row >= len(view.agents)):
        return
    ids = [agent.agent_id for agent in view.agents]
    app.update(hidden=frozenset() if row is None else frozenset(ids) - {ids[row]})


def next_error(app: Page, direction: int) -> None:
    """Go to the nearest frame with an FP or FN in a direction, if any."""
    state = app.state
    count = app.model.frame_count(state.drive)
    for ahead in range(1, count):
        row = (state.frame + direction * ahead) % count
        counts = app.counts(replace(state, frame=row))
        if counts is not None and counts.fp + counts.fn > 0:
            app.update(frame=row)
            return
