"""Links: a state and a camera as the query of a page's address, and back."""

import math
from dataclasses import fields, replace
from typing import Any
from urllib.parse import parse_qsl, quote

import numpy as np

from dsrc.review.labs.parameters import changed, parameters_of, parse_change
from dsrc.review.model import ReviewModel
from dsrc.review.page.cameras import UP, CameraPose
from dsrc.review.page.cells import links_of
from dsrc.review.page.controls import Choice, Control, Slider
from dsrc.review.page.page import Shown
from dsrc.review.page.panels import CONTROLS
from dsrc.review.state import SHOWN_LAYERS, ReviewState
from dsrc.review.view import DetectionDetails, FrameView
from sensors.corruptions import CLEAN, Changes, Condition, parse_agents
from sim.errors import SettingsError, UserError, complaint

VIEW = "view"
"""Name of the camera's position and the point looked at: six numbers, m."""
OF_BROWSER = ("fixedDpr", "pair")
"""Names that an address has for the browser: of its pixels, and of the cell that a page is."""

_OF_DRIVE = ("frame", "object", "detection", "ego", "hidden", "carrier", "placement", "ruler", VIEW)
"""Names of what is another thing in another drive."""

_FARTHEST_M = 1000.0
"""Farthest place of a sensor on its carrier, m."""
_FARTHEST_PLACE_M = 1e6
"""Farthest place in the scene, m: beyond this the browser's numbers lose the metre."""
_BETWEEN = "|"
"""Between the names of methods, which may hold commas."""
_DEFAULTS = {field.name: getattr(ReviewState(), field.name) for field in fields(ReviewState)}
_ROWS = {control.link: control for control in CONTROLS if control.link}
"""Controls by their names in links; switches of one set share a name."""


def write_link(model: ReviewModel, state: ReviewState, pose: CameraPose | None = None) -> str:
    """Query of a state and a camera pose; what is as ever, and so at the start of the page, is left out.

    The drive of an episode stays where others have the same scenario and seed: it is the title of its cell beside them.
    """
    parts, start = [], model.start
    named = model.twins(state.drive)
    if state.drive != start.drive:
        start = replace(start, **model.opening(state.drive))
    for name, control in _ROWS.items():
        value = getattr(state, control.field)
        usual = value == _DEFAULTS[control.field] == getattr(start, control.field)
        if not usual or (control.field == "drive" and named):
            parts.append(f"{name}={_text(model, control.field, value)}")
    if pose is not None:
        # Adding zero makes one of the two zeros.
        numbers = np.round([*pose.position, *pose.look_at], 2) + 0.0
        parts.append(f"{VIEW}={','.join(f'{number:.2f}' for number in numbers)}")
    return "&".join(parts)


def read_link(query: str, model: ReviewModel, state: ReviewState) -> tuple[ReviewState, CameraPose | None, list[str]]:
    """Return the state of a link, its camera, and one complaint per part that cannot be taken.

    Without a frame, a source that grows is shown at its newest, and another drive than that of `state` at its first. A
    frame after the last is the last; of a drive that is gone nothing is taken.

    Args:
        state: of a page without a link.
    """
    complaints: list[str] = []
    parts, start = dict(parse_qsl(query, keep_blank_values=True)), state
    # What is broken and fixed can be listed once it is known against which run.
    for name, control in sorted(_ROWS.items(), key=lambda row: row[1].field == "listed"):
        if name not in parts:
            continue
        try:
            state = replace(state, **{control.field: _value(control, parts[name], Shown(model, state))})
        except SettingsError as error:
            complaints.append(str(error))
            if name == "drive":
                parts = {known: text for known, text in parts.items() if known not in _OF_DRIVE}
            elif name == "frame" and parts[name].isdecimal():
                state = replace(state, frame=len(model.sources[state.drive]) - 1)
    source = model.sources[state.drive]
    if "frame" not in parts and not source.ended:
        state = replace(state, frame=len(source) - 1)
    elif "frame" not in parts and state.drive != start.drive:
        state = replace(state, **model.opening(state.drive))
    state = replace(state, frame=max(state.frame, source.first))
    state, gone = _with_agents(state, model, parts)
    complaints += gone
    pose = None
    if VIEW in parts:
        try:
            pose = _pose(parts[VIEW])
        except SettingsError as error:
            complaints.append(str(error))
    return state, pose, complaints


def _with_agents(state: ReviewState, model: ReviewModel, parts: dict[str, str]) -> tuple[ReviewState, list[str]]:
    """State without ego and carrier that its frame lacks, and one complaint per part of a link with such agents."""
    carrier, hidden = {state.carrier} - {"ego", "pole"}, set(map(str, state.hidden))
    named = {"ego": {str(state.ego_id)} if state.ego_id is not None else set(), "hidden": hidden, "carrier": carrier}
    named = {name: ids for name, ids in named.items() if name in parts and ids}
    try:
        agents = model.stores[state.drive].recorded(state.frame).agents if named else ()
    except UserError:
        return state, []  # the page tells what is wrong with the frame
    known = [str(agent.agent_id) for agent in agents]
    gone = [name for name, ids in named.items() if not ids <= set(known)]
    state = replace(state, ego_id=None) if "ego" in gone else state
    state = replace(state, carrier="ego") if "carrier" in gone else state
    expected = f"agents of frame {state.frame}, {', '.join(known)}"
    return state, [complaint("link", name, expected, parts[name]) for name in gone]


def unknown_names(query: str) -> list[str]:
    """Return the names in a query that no link has."""
    known = {*_ROWS, VIEW, *OF_BROWSER}
    return [name for name, _ in parse_qsl(query, keep_blank_values=True) if name not in known] or (
        [query] if query and "=" not in query else []
    )


def linked_views(
    model: ReviewModel, link: str, start: ReviewState | None = None
) -> list[tuple[ReviewState, CameraPose | None]]:
    """States and cameras of a link: one, or those of up to four cells.

    Args:
        link: a page's address, or its query.
        start: what is shown where the link says nothing; None for the first frame as recorded.

    Raises:
        SettingsError: a part of the link is wrong, or selects what does not exist.
        UserError: the frame of a selection cannot be read.
    """
    links = links_of(link)
    for name in (name for one in links for name in unknown_names(one)):
        raise SettingsError(complaint("link", name, "names as in the address of a page", "one that it does not have"))
    views = [read_link(one, model, start or ReviewState()) for one in links]
    for _, _, complaints in views:
        if complaints:
            raise SettingsError(complaints[0])
    for state, _, _ in views:
        _check_selection(model, state)
    return [(state, pose) for state, pose, _ in views]


def no_object(model: ReviewModel, state: ReviewState) -> str:
    """Complaint on a selected object that is in no frame of its drive."""
    return complaint("link", "object", f"one of the objects of {model.title(state.drive)}", state.object_id)


def no_detection(state: ReviewState, view: FrameView) -> str:
    """Complaint on a selected detection that a frame as drawn lacks."""
    known = f"0 to {view.detected - 1}" if view.detected else "none"
    expected = f"{known}, with a score of {state.threshold:g} or more in frame {view.index}"
    return complaint("link", "detection", expected, state.detection)


def _check_selection(model: ReviewModel, state: ReviewState) -> None:
    if state.detection is not None:
        view = model.view(state)
        if not isinstance(view.details, DetectionDetails):
            raise SettingsError(no_detection(state, view))
    source, number, history = model.sources[state.drive], state.object_id, model.histories[state.drive]
    if number is None or number in model.stores[state.drive].recorded(state.frame).truth.object_id:
        return
    for row in range(source.first, len(source)):
        history.read(row)
    if source.ended and history.lacks(number):
        raise SettingsError(no_object(model, state))


def _text(model: ReviewModel, field: str, value: Any) -> str:
    if field == "drive":
        name = model.names[value]
        return quote(name, safe="") if model.names.count(name) == 1 and not name.isdecimal() else str(value)
    if field == "parameters":
        return ",".join(f"{name}:{number}" for name, number in value)
    if field in ("placement", "ruler"):
        return ",".join(f"{number:g}" for number in value)
    if field == "methods":
        return _BETWEEN.join(quote(name, safe="") for name in value)
    if isinstance(value, frozenset):
        return ",".join(sorted(map(str, value)))
    if isinstance(value, bool):
        return str(int(value))
    return f"{value:g}" if isinstance(value, float) else quote(str(value), safe="")


def _value(control: Control, text: str, shown: Shown) -> Any:
    """Value of a part of a link.

    Raises:
        SettingsError: it is no value of the control.
    """
    if control.field == "drive" and text in (names := shown.model.names):
        return names.index(text)
    if control.field == "drive" and not text.isdecimal():
        raise SettingsError(complaint("link", control.link, ", ".join(names), text))
    if control.field == "methods":
        return _methods(control, text, shown)
    if control.field == "placement":
        return _placement(control, text)
    if control.field == "ruler":
        return _ruler(control, text)
    if control.field == "parameters":
        return _parameters(text, shown.state)
    value = _parsed(control, text)
    if control.field == "corrupted_agents":
        parse_agents(value)
    if control.field == "versus" and value == CLEAN != shown.state.corruption:
        return _DEFAULTS["versus"]
    widget = control.widget
    if isinstance(widget, Slider) and not widget.low <= value <= widget.upper(shown):
        expected = f"{widget.low:g} to {widget.upper(shown):g}"
        raise SettingsError(complaint("link", control.link, expected, text))
    if isinstance(widget, Choice) and widget.closed and value not in (options := widget.options(shown)).values():
        named = control.field == "drive"
        known = [name if named or one == "" else str(one) for name, one in options.items()]
        raise SettingsError(complaint("link", control.link, ", ".join(known), text))
    return value


def _methods(control: Control, text: str, shown: Shown) -> tuple[str, ...]:
    known = shown.model.methods(shown.state.drive)
    names = tuple(dict.fromkeys(name for name in text.split(_BETWEEN) if name))
    if not set(names) <= set(known):
        raise SettingsError(complaint("link", control.link, ", ".join(known) or "none", text))
    return names


def _numbers(text: str) -> tuple[float, ...]:
    """Numbers between commas; NaN for what is none."""
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        return (math.nan,)


def _placement(control: Control, text: str) -> tuple[float, ...]:
    numbers, bounds = _numbers(text), (_FARTHEST_M, _FARTHEST_M, _FARTHEST_M, 360.0, 90.0)
    if len(numbers) != len(bounds) or not all(abs(n) <= bound for n, bound in zip(numbers, bounds, strict=True)):
        raise SettingsError(complaint("link", control.link, "five numbers: x, y, z, m, yaw and pitch, degrees", text))
    return numbers


def _ruler(control: Control, text: str) -> tuple[float, ...]:
    ends = _numbers(text) if text else ()
    if len(ends) not in (0, 2, 4) or not all(abs(number) < _FARTHEST_PLACE_M for number in ends):
        raise SettingsError(complaint("link", control.link, "x and y of one end or of both, m", text))
    return ends


def _parameters(text: str, state: ReviewState) -> Changes:
    known = parameters_of(state.corruption, state.severity, state.family)
    changes: Changes = ()
    for part in text.split(","):
        changes = changed(changes, *parse_change(part, known, "link"), known)
    if changes:
        Condition(state.corruption, state.severity, state.family, settings=changes).resolved()
    return changes


def _parsed(control: Control, text: str) -> Any:
    kind = type(_DEFAULTS[control.field])
    try:
        if kind is frozenset:
            items = frozenset(item for item in text.split(",") if item)
            if control.field == "layers_off":
                if not items <= set(SHOWN_LAYERS):
                    raise SettingsError(complaint("link", control.link, ", ".join(SHOWN_LAYERS), text))
                return items
            return frozenset(map(int, items))
        if kind is bool:
            return {"0": False, "1": True}[text]
        if control.field == "detection" and int(text) < 0:  # ids may be negative, places in the order of scores not
            raise ValueError
        if kind is type(None):
            return int(text)
        return kind(text)
    except (ValueError, KeyError):
        expected = {bool: "0 or 1", float: "a number", frozenset: "whole numbers"}.get(kind, "a whole number")
        expected += ", at least 0" if control.field == "detection" else ""
        raise SettingsError(complaint("link", control.link, expected, text)) from None


def _pose(text: str) -> CameraPose:
    numbers = np.array(_numbers(text))
    far = not (np.abs(numbers) < _FARTHEST_PLACE_M).all()
    if numbers.shape != (6,) or far or np.allclose(numbers[:3], numbers[3:]):
        raise SettingsError(complaint("link", VIEW, "six numbers: position and point looked at", text))
    return CameraPose(numbers[:3], numbers[3:], UP)
