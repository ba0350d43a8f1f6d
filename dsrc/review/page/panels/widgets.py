"""Rows of the table of controls as viser's widgets, set from the state and setting it."""

import math
from typing import Any

from dsrc.review.page.controls import CONTROLS, Choice, Control, Slider, change_of, value_of
from dsrc.review.page.protocol import Page, Shown


class BoundControl:
    """Widget of one control: what a user sets changes the state, what the state is sets the widget."""

    def __init__(self, control: Control, page: Page) -> None:
        """Build the widget in the page, in the container that is open."""
        self.control = control
        self._page = page
        shown = Shown(page.model, page.state, page.view)
        self._written: Any = self
        self._options: dict[str, Any] = {}
        self.handle = self._build(shown)
        self.handle.on_update(self._take)
        self.show(shown)

    def _build(self, shown: Shown) -> Any:
        gui, control, widget = self._page.gui, self.control, self.control.widget
        value = value_of(control, shown)
        hint = f"key {control.key}" if control.key else None
        if isinstance(widget, Slider):
            # A slider needs some room, also in a drive of one frame.
            upper = max(widget.upper(shown), widget.low + widget.step)
            start = min(max(value, widget.low), upper)
            return gui.add_slider(control.label, widget.low, upper, widget.step, start, hint=hint)
        if isinstance(widget, Choice):
            self._options = widget.options(shown)
            return gui.add_dropdown(control.label, tuple(self._options), hint=hint)
        return gui.add_checkbox(control.label, bool(value), hint=hint)

    def show(self, shown: Shown) -> None:
        """Set the widget to the state."""
        control, widget, handle = self.control, self.control.widget, self.handle
        value = value_of(control, shown)
        if isinstance(widget, Slider):
            upper = max(widget.upper(shown), widget.low + widget.step)
            if handle.max != upper:
                handle.max = upper
            value = min(max(value, widget.low), upper)
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
        value = event.target.value
        # Setting a widget fires this too: what was written here is not the user's.
        if event.client_id is None and value == self._written:
            return
        self._written = self
        if isinstance(self.control.widget, Choice):
            if value not in self._options:
                return
            value = self._options[value]
        if isinstance(self.control.widget, Slider):
            value = type(getattr(self._page.state, self.control.field))(value)
            if not math.isfinite(value):
                return
            value = min(value, self.control.widget.upper(Shown(self._page.model, self._page.state)))
        shown = Shown(self._page.model, self._page.state, self._page.view)
        self._page.update(**change_of(self.control, shown, value))


def set_fields(handle: object, **values: object) -> None:
    """Set the fields of a widget that differ."""
    for name, value in values.items():
        if getattr(handle, name) != value:
            setattr(handle, name, value)


def build_controls(panel: str, page: Page) -> list[BoundControl]:
    """Build the controls of a panel, in the order of the table."""
    rows = (control for control in CONTROLS if control.panel == panel and control.widget is not None)
    return [BoundControl(control, page) for control in rows]
