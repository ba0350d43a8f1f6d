"""Table of the commands: what a key does that is no control of its own."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from dsrc.review.errors.index import next_error
from dsrc.review.errors.report import first_unknown, shown_error
from dsrc.review.page.browser import OPEN_KEY
from dsrc.review.page.cells import cells_of, compare_address
from dsrc.review.page.controls import Control
from dsrc.review.page.page import GoesOn, Page
from dsrc.review.page.panels import CONTROLS
from dsrc.review.state import Listed
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


_NAMES = {"all": "error", "missed": "missed object", "false": "false detection", "poor": "poor box",
          "broken": "broken object", "fixed": "fixed object"}  # fmt: skip
_LOOK_S = 0.3


def go_to_error(page: Page, step: int, listed: Listed | None = None) -> None:
    """Go to the next error of a kind in a direction, detecting in further frames where that is needed.

    Another search of the page takes its place; it ends where the page shows something else, or is closed.

    Args:
        step: 1 for the next, -1 for the one before.
        listed: kind of error; None for those that are listed.
    """
    page.search(partial(_look_for_error, page, step, listed))


def _look_for_error(page: Page, step: int, listed: Listed | None, goes_on: GoesOn) -> None:
    start = page.state
    wanted = replace(start, listed=listed or start.listed)
    name = _NAMES[wanted.listed]
    if not page.model.method(start) or not page.model.sources[start.drive].labelled:
        page.tell(f"No {name}: nothing is judged without a detector and labels.")
        return
    detecting = False
    while page.state == start:
        # Asked before the report: what ends after this is in the next one.
        running = bool(page.detecting())
        with page.using_model:
            gap = first_unknown(page.model, start, step)
        report = page.report(wanted, newest=True)
        errors = report.errors.in_order()
        row = next_error(errors, start.frame, shown_error(errors, start), step)
        if row is not None and (gap is None or (errors.row[row] - gap) * step < 0 or (detecting and not running)):
            page.tell("")
            page.show_error(errors, row)
            return
        if gap is None or (detecting and not running):
            where = "after" if step > 0 else "before"
            elsewhere = f"; {len(errors)} in the whole run" if len(errors) else ""
            known = f" in the {report.known} frames with detections" if report.known < report.total else ""
            page.tell(f"No {name} {where} this one{known}{elsewhere}.")
            return
        if not detecting:
            page.detect_all()
            detecting = True
        page.tell(f"Looking for a {name}: {report.known} of {report.total} frames.")
        if not goes_on(_LOOK_S):
            return


def toggle_corruption(page: Page) -> None:
    """Switch between clean and the last corruption."""
    if page.state.corruption != CLEAN:
        page.update(corruption=CLEAN)
        return
    page.update(corruption=page.last_corruption or next(iter(CORRUPTIONS)), parameters=page.last_parameters)


def lay_over(page: Page) -> None:
    """Draw all methods over the judged one, or that one alone."""
    known, shown = page.model.methods(page.state.drive), page.state.methods
    if len(known) < 2:
        page.tell("There is one method, or none: nothing lies over it.")
        return
    first = page.model.method(page.state)
    page.update(methods=(first,) if len(shown) > 1 else (first, *(name for name in known if name != first)))


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


def go_to_step(page: Page, name: str) -> None:
    """Go to the step of an episode at which something happens: the meeting, or a first step towards it."""
    met = page.source.meeting
    if met is None:
        page.tell("No episode that has ended: nothing is met.")
    elif (row := met.row if name == "contact" else met.steps.get(name)) is not None:
        page.update(frame=row, object_id=met.other_id)
    else:
        page.tell(f"No {name} in this episode." if met.explained else f"The {name} is still looked for.")


def side_by_side(page: Page) -> None:
    """Open cells with linked cameras, or go back to one page from there."""
    pose = page.camera.pose
    if page.cells:
        address = f"/?{page.link(page.state, pose)}"
    else:
        with page.using_model:
            cells = cells_of(page.model, page.state, page.last_corruption)
        address = compare_address(*(page.link(one, pose) for one in cells))
    page.client.local_storage.set_item(OPEN_KEY, address)


def toggle_help(page: Page) -> None:
    """Open or close the list of keys."""
    if page.help is not None:
        page.help.close()
        page.help = None
        return
    page.help = page.gui.add_modal("Keys")
    with page.help:
        page.gui.add_markdown(f"{keys_table()}\n\nW A S D Q E and the arrows move the camera.")
        page.gui.add_button("Close").on_click(lambda _: toggle_help(page))


def _take_next(control: Control, page: Page) -> None:
    shown = page.shown
    if control.enabled(shown) and control.shown(shown):
        page.update(**control.changes(shown, control.next_value(shown)))


COMMANDS: tuple[Command, ...] = (
    Command("Play or pause", "space", lambda page: page.toggle_play()),
    Command("Next frame", "L", lambda page: page.step(1)),
    Command("Previous frame", "J", lambda page: page.step(-1)),
    Command("Ten frames forward", "pagedown", lambda page: page.step(STEP)),
    Command("Ten frames back", "pageup", lambda page: page.step(-STEP)),
    Command("First frame", "home", lambda page: page.step(-len(page.source))),
    Command("Last frame", "end", lambda page: page.step(len(page.source))),
    Command("Next missed object", "N", partial(go_to_error, step=1, listed="missed")),
    Command("Previous missed object", "N", partial(go_to_error, step=-1, listed="missed"), shift=True),
    Command("Next false detection", "P", partial(go_to_error, step=1, listed="false")),
    Command("Previous false detection", "P", partial(go_to_error, step=-1, listed="false"), shift=True),
    Command("Next listed error", "K", partial(go_to_error, step=1)),
    Command("Previous listed error", "K", partial(go_to_error, step=-1), shift=True),
    *(
        Command(f"Episode: {name}", key, partial(go_to_step, name=name))
        for name, key in (("contact", "M"), ("first sight", "9"), ("first track", "8"), ("first full brake", "Z"))
    ),
    Command("Clean or corrupted", "X", toggle_corruption),
    Command("Side by side, or one page", "Y", side_by_side),
    Command("Methods over each other", "O", lay_over),
    Command("Camera: chase the ego", "C", lambda page: page.place_camera("chase")),
    Command("Camera: bird's eye", "B", lambda page: page.place_camera("bev")),
    Command("Camera: free", "F", lambda page: page.update(camera="free")),
    Command("Camera: to the selected box", "G", fly_to_selection),
    Command("Camera: reset", "R", lambda page: page.reset_camera()),
    Command("Select nothing", "escape", lambda page: page.update(object_id=None, detection=None, ruler=())),
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
    Command("Help: list of the keys", "H", toggle_help),
)  # fmt: skip
"""The commands, in the order of the help. `?` is the H of the help."""


def keys_table() -> str:
    """Markdown table of the keys."""
    rows = "\n".join(f"| `{command.key_text}` | {command.label} |" for command in COMMANDS)
    return f"| key | |\n|:--|:--|\n{rows}"
