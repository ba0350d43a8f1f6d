"""Pair: two cells that show one moment from one camera; what makes them differ stays each one's own."""

import threading
from collections import deque
from dataclasses import fields, replace
from typing import Any, Protocol

from dsrc.review.model import ReviewModel
from dsrc.review.page.cameras import CameraPose
from dsrc.review.state import ReviewState
from sensors.corruptions import CLEAN, CORRUPTIONS

_OWN = frozenset(
    {
        "corruption",
        "severity",
        "family",
        "parameters",
        "corrupted_agents",
        "methods",
        "cooperative",
        "detection",
        "versus",
    }
    # Whose errors are listed, and whether any can be broken or fixed, follows from these.
    | {"error_method", "listed"}
)
_SHARED = tuple(field.name for field in fields(ReviewState) if field.name not in _OWN)
_REMEMBERED = 30


class Cell(Protocol):
    """Session of a cell.

    Attributes:
        state: newest settings.
    """

    state: ReviewState

    def update(self, **changes: object) -> None:
        """Replace fields of the state and draw it."""

    def look(self, pose: CameraPose) -> None:
        """Set the camera to a pose in the scene."""


class Pair:
    """Cells that follow each other; threads share it.

    Attributes:
        cells: in the order in which they came.
    """

    def __init__(self) -> None:
        self.cells: list[Cell] = []
        # What a cell was given and has not drawn yet, and what the last user set in any cell.
        self._given: dict[int, deque[tuple[Any, ...]]] = {}
        self._newest: tuple[Any, ...] | None = None
        self._lock = threading.Lock()

    def add(self, cell: Cell) -> None:
        """Add a cell, which takes what it shares from one that is there."""
        with self._lock:
            others = list(self.cells)
            self.cells.append(cell)
            self._given[id(cell)] = deque(maxlen=_REMEMBERED)
            if not others:
                self._newest = _shared(cell.state)
        for other in others[:1]:
            self._give(cell, other.state)

    def remove(self, cell: Cell) -> None:
        """Remove a cell."""
        with self._lock:
            self.cells = [one for one in self.cells if one is not cell]
            self._given.pop(id(cell), None)

    def state_changed(self, cell: Cell, state: ReviewState) -> None:
        """Take a state of a cell to the others, unless it has it from them or they have it already."""
        with self._lock:
            shared, given = _shared(state), self._given.get(id(cell))
            if given is None:
                # It takes what the others have when it is added.
                return
            if shared == self._newest:
                given.clear()
                return
            if shared in given:
                # It came from another cell, which is further by now. A later return to it is the user's.
                while given.popleft() != shared:
                    pass
                return
            given.clear()
            self._newest = shared
            others = [one for one in self.cells if one is not cell]
        for other in others:
            self._give(other, state)

    def camera_moved(self, cell: Cell, pose: CameraPose) -> None:
        """Take the camera of a cell, which its user moved, to the others."""
        with self._lock:
            others = [one for one in self.cells if one is not cell]
        for other in others:
            other.look(pose)

    def _give(self, cell: Cell, state: ReviewState) -> None:
        with self._lock:
            if (given := self._given.get(id(cell))) is None:
                return
            given.append(_shared(state))
        wanted = {name: getattr(state, name) for name in _SHARED}
        if state.drive != cell.state.drive:
            # Another drive starts anew; the rest follows.
            cell.update(drive=state.drive)
        cell.update(**{name: value for name, value in wanted.items() if value != getattr(cell.state, name)})


def _shared(state: ReviewState) -> tuple[Any, ...]:
    return tuple(getattr(state, name) for name in _SHARED)


def cells_of(model: ReviewModel, state: ReviewState, last_corruption: str = "") -> tuple[ReviewState, ReviewState]:
    """Two states that are compared side by side.

    Two methods where two are shown; clean and corrupted sweeps; else the drive's first two methods, or clean sweeps and
    the last corruption.

    Args:
        last_corruption: kind of the last corruption, "" for none.
    """
    methods = model.methods(state.drive)
    if len(state.methods) > 1:
        first, second = state.methods[:2]
        return replace(state, methods=(first,)), replace(state, methods=(second,))
    if state.corruption != CLEAN:
        return replace(state, corruption=CLEAN, parameters=()), state
    if len(methods) > 1:
        shown = model.method(state)
        other = next(name for name in methods if name != shown)
        return replace(state, methods=(shown,)), replace(state, methods=(other,))
    return state, replace(state, corruption=last_corruption or next(iter(CORRUPTIONS)))
