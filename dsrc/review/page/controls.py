"""Controls: rows of the panels' tables, each of a field of the state; widgets, keys and links are made from them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from dsrc.review.page.page import Shown

Options = Callable[[Shown], dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Slider:
    """Number between two bounds, the upper one fixed or a function of what is shown."""

    low: float
    high: float | Callable[[Shown], float]
    step: float

    def upper(self, shown: Shown) -> float:
        """Upper bound."""
        return self.high(shown) if callable(self.high) else self.high


@dataclass(frozen=True, slots=True)
class Choice:
    """One of named values, which may depend on what is shown.

    Attributes:
        options: names and their values.
        closed: whether a link may hold none but these.
    """

    options: Options
    closed: bool = True


@dataclass(frozen=True, slots=True)
class Switch:
    """A field that is on or off; with `item`, whether a set of what is off lacks the item."""

    item: Any = None


@dataclass(frozen=True, slots=True)
class Control:
    """Row of a table.

    Attributes:
        field: of `ReviewState`.
        widget: what it is drawn as; None for a field that is only part of the link.
        label: displayed name.
        link: name in the link; "" for a field that is not part of it.
        key: key that takes the next choice or turns the switch; "" without one.
        shown: whether it is drawn.
        enabled: whether it does anything.
        read: value in what is shown; None for that of the field.
        write: changes of the state that a value means; None for that of the field.
    """

    field: str
    widget: Slider | Choice | Switch | None
    label: str = ""
    link: str = ""
    key: str = ""
    shown: Callable[[Shown], bool] = lambda _: True
    enabled: Callable[[Shown], bool] = lambda _: True
    read: Callable[[Shown], Any] | None = None
    write: Callable[[Shown, Any], dict[str, Any]] | None = None

    def value(self, shown: Shown) -> Any:
        """Value in what is shown."""
        if self.read is not None:
            return self.read(shown)
        value = getattr(shown.state, self.field)
        if isinstance(self.widget, Switch) and self.widget.item is not None:
            return self.widget.item not in value
        return value

    def changes(self, shown: Shown, value: Any) -> dict[str, Any]:
        """Changes of the state that a value means."""
        if self.write is not None:
            return self.write(shown, value)
        if isinstance(self.widget, Switch) and self.widget.item is not None:
            off, item = getattr(shown.state, self.field), self.widget.item
            return {self.field: off - {item} if value else off | {item}}
        return {self.field: value}

    def next_value(self, shown: Shown) -> Any:
        """Value that the key sets: the next choice, or the switch turned."""
        value = self.value(shown)
        if isinstance(self.widget, Choice):
            options = list(self.widget.options(shown).values())
            return options[(options.index(value) + 1) % len(options)] if value in options else options[0]
        return not value


def same(*values: object) -> Options:
    """Options that are named by their values."""
    return lambda _: {str(value): value for value in values}


def named(options: dict[str, Any]) -> Options:
    """Options that are always the same."""
    return lambda _: options


def detects(shown: Shown) -> bool:
    """Whether there are detections in any drive."""
    return shown.model.has_detector
