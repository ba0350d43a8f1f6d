"""Table of the commands: what a key does that is no control of its own."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from dsrc.review.page.controls import CONTROLS, Control, change_of, next_value
from dsrc.review.page.protocol import Page, Shown
from sensors.corruptions import CLEAN, CORRUPTIONS

STEP = 10
_AGENT_KEYS = 7


@dataclass(frozen=True, slots=True)
class Command:
    """Keyboard command: label, key and action. W A S D Q E and the arrows move the camera."""

    label: str
    key: str
    run: Callable[[Page], None]
    shift: bool = False

    @property
    def key_text(self) -> str:
        """Displayed key."""
        return f"{'Shift-' if self.shift else ''}{self.key.replace('page', 'page ').capitalize()}"


def next_error(page: Page, direction: int) -> None:
    """Go to the nearest frame with an FP or FN in a direction, and say so when there is none."""
    state = page.state
    if page.counts(state) is None:
        page.tell("No errors: nothing is judged without a detector and labels.")
        return
    count = page.model.frame_count(state.drive)
    for ahead in range(1, count):
        row = (state.frame + direction * ahead) % count
        if ahead % STEP == 0:
            page.tell(f"Looking for an FP or FN: {ahead} of {count} frames.")
        counts = page.counts(replace(state, frame=row))
        if counts is not None and counts.fp + counts.fn > 0:
            page.tell("")
            page.update(frame=row)
            return
    page.tell("No other frame of this drive has an FP or FN.")


def toggle_corruption(page: Page) -> None:
    """Switch between clean and the last corruption."""
    if page.state.corruption != CLEAN:
        page.update(corruption=CLEAN)
        return
    page.update(corruption=page.last_corruption or next(iter(CORRUPTIONS)), parameters=page.last_parameters)


def show_only_agent(page: Page, row: int | None) -> None:
    """Show the points of the agent in a row alone; None shows all."""
    view = page.view
    if view is None or (row is not None and row >= len(view.agents)):
        return
    ids = [agent.agent_id for agent in view.agents]
    page.update(hidden=frozenset() if row is None else frozenset(ids) - {ids[row]})


def fly_to_selection(page: Page) -> None:
    """Move the camera to the selected box, if any."""
    selected = None if page.view is None else page.view.selected
    if selected is None:
        page.tell("Nothing is selected: click a body or a detection.")
        return
    page.fly_to(selected)


def _take_next(control: Control, page: Page) -> None:
    shown = Shown(page.model, page.state, page.view)
    if control.enabled(shown) and control.shown(shown):
        page.update(**change_of(control, shown, next_value(control, shown)))


def _select_nothing(page: Page) -> None:
    page.update(object_id=None, detection=None)


COMMANDS: tuple[Command, ...] = (
    Command("Play or pause", "space", lambda page: page.toggle_play()),
    Command("Next frame", "L", lambda page: page.step(1)),
    Command("Previous frame", "J", lambda page: page.step(-1)),
    Command("Ten frames forward", "pagedown", lambda page: page.step(STEP)),
    Command("Ten frames back", "pageup", lambda page: page.step(-STEP)),
    Command("First frame", "home", lambda page: page.update(frame=0)),
    Command("Last frame", "end", lambda page: page.step(page.model.frame_count(page.state.drive))),
    Command("Next frame with an FP or FN", "N", lambda page: next_error(page, 1)),
    Command("Previous frame with an FP or FN", "N", lambda page: next_error(page, -1), shift=True),
    Command("Clean or corrupted", "X", toggle_corruption),
    Command("Camera: chase the ego", "C", lambda page: page.place_camera("chase")),
    Command("Camera: bird's eye", "B", lambda page: page.place_camera("bev")),
    Command("Camera: free", "F", lambda page: page.update(camera="free")),
    Command("Camera: to the selected box", "G", fly_to_selection),
    Command("Camera: reset", "R", lambda page: page.reset_camera()),
    Command("Select nothing", "escape", _select_nothing),
    Command("Points of all agents", "0", lambda page: show_only_agent(page, None)),
    *(
        Command(f"Points of agent {row + 1} alone", str(row + 1), partial(show_only_agent, row=row))
        for row in range(_AGENT_KEYS)
    ),
    *(
        Command(f"{control.label}: next" if control.label != "Cooperative" else "Cooperative or alone", control.key,
                partial(_take_next, control))
        for control in CONTROLS
        if control.key
    ),
    Command("Help: list of the keys", "H", lambda page: page.toggle_help()),
)  # fmt: skip
"""The commands, in the order of the help. `?` is the H of the help."""


def keys_table() -> str:
    """Markdown table of the keys."""
    rows = "\n".join(f"| `{command.key_text}` | {command.label} |" for command in COMMANDS)
    return f"| key | |\n|:--|:--|\n{rows}"
