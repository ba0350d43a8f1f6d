"""Panel: part of the controls, built once per browser; and widgets that are set from the state and set it."""

import math
from contextlib import nullcontext
from typing import Any, ClassVar

from dsrc.review.page.controls import Choice, Control, Slider
from dsrc.review.page.page import Page, Shown


class Panel:
    """Part of the controls, a folder by default; `build` adds its widgets, `show` sets them from what is shown.

    Attributes:
        title: of the folder; "" for none.
        opened: whether the folder is open at the start.
        table: its controls, in their order.
        folder: viser's.
        controls: widgets of the table.
    """

    title: ClassVar[str] = ""
    opened: ClassVar[bool] = False
    table: ClassVar[tuple[Control, ...]] = ()

    def __init__(self, page: Page) -> None:
        self._page = page
        self.controls: list[BoundControl] = []
        folder = page.gui.add_folder(self.title, expand_by_default=self.is_open()) if self.title else nullcontext()
        self.folder: Any = folder
        with self.folder:
            self.build()

    def is_open(self) -> bool:
        """Whether the folder is open at the start."""
        return self.opened

    def build(self) -> None:
        """Add the widgets: those of the table."""
        self.controls = [BoundControl(control, self._page) for control in self.table if control.widget is not None]

    def show(self, shown: Shown) -> None:
        """Set the widgets; here those of the table."""
        for control in self.controls:
            control.show(shown)


class BoundControl:
    """Widget of one control, in the open container; what a user sets changes the state, the state sets the widget."""

    def __init__(self, control: Control, page: Page) -> None:
        self.control = control
        self._page = page
        self._written: Any = self
        self._options: dict[str, Any] = {}
        self.handle = self._build(page.shown)
        self.handle.on_update(self._take)
        self.show(page.shown)

    def _build(self, shown: Shown) -> Any:
        gui, control, widget = self._page.gui, self.control, self.control.widget
        hint = f"key {control.key}" if control.key else None
        if isinstance(widget, Slider):
            value, upper = self._inside(widget, shown)
            return gui.add_slider(control.label, widget.low, upper, widget.step, value, hint=hint)
        if isinstance(widget, Choice):
            self._options = widget.options(shown)
            return gui.add_dropdown(control.label, tuple(self._options), hint=hint)
        return gui.add_checkbox(control.label, bool(control.value(shown)), hint=hint)

    def _inside(self, widget: Slider, shown: Shown) -> tuple[Any, float]:
        """Value within the bounds of a slider, and the upper one: also in a drive of one frame it needs some room."""
        upper = max(widget.upper(shown), widget.low + widget.step)
        return min(max(self.control.value(shown), widget.low), upper), upper

    def show(self, shown: Shown) -> None:
        """Set the widget to the state."""
        control, widget, handle = self.control, self.control.widget, self.handle
        if isinstance(widget, Slider):
            value, upper = self._inside(widget, shown)
            set_fields(handle, max=upper)
        else:
            value = control.value(shown)
        if isinstance(widget, Choice):
            options = widget.options(shown)
            value = next((name for name, known in options.items() if known == value), next(iter(options)))
            if options != self._options:
                self._options = options
                # New options may set the value by themselves: not the user's.
                self._written = value if handle.value in options else next(iter(options))
                handle.options = tuple(options)
        if handle.value != value:
            self._written = value
            handle.value = value
        set_fields(handle, visible=control.shown(shown), disabled=not control.enabled(shown))

    def _take(self, event: Any) -> None:
        value, shown, widget = event.target.value, self._page.shown, self.control.widget
        # Setting a widget fires this too: what was written here is not the user's.
        if event.client_id is None and value == self._written:
            return
        self._written = self
        if isinstance(widget, Choice):
            if value not in self._options:
                return
            value = self._options[value]
        if isinstance(widget, Slider):
            value = type(self.control.value(shown))(value)
            if not math.isfinite(value):
                return
            value = min(max(value, widget.low), widget.upper(shown))
        self._page.update(**self.control.changes(shown, value))


def set_fields(handle: object, **values: object) -> None:
    """Set the fields of a widget that differ."""
    for name, value in values.items():
        if getattr(handle, name) != value:
            setattr(handle, name, value)


def clickable(svg: str, number: Any, style: str) -> str:
    """HTML of a plot on which a click sets a hidden number to what lies there; the script of the page does it."""
    return f'<div data-goto="{number._impl.uuid}" style="{style}">{svg}</div>'
