"""Table of the controls: one row per control of a field of the state; panels, keys and links are made from it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, get_args

from dsrc.review.errors.report import BANDS, BROKEN, FIXED, versus_options
from dsrc.review.page.protocol import Shown
from dsrc.review.state import COLOR_BY, EPISODE_LAYERS, IOU_THRESHOLDS, SHOWN_LAYERS, Listed, other_run
from sensors.corruptions import CLEAN, CORRUPTIONS, EVERYONE, FAMILIES
from sensors.presets import LIDARS
from sim.boxes import CLASSES

NOBODY = "none"

SPEEDS = {"0.25×": 0.25, "0.5×": 0.5, "1×": 1.0, "2×": 2.0, "4×": 4.0}


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

    options: Callable[[Shown], dict[str, Any]]
    closed: bool = True


@dataclass(frozen=True, slots=True)
class Switch:
    """A field that is on or off; with `item`, whether a set of what is off lacks the item."""

    item: Any = None


@dataclass(frozen=True, slots=True)
class Control:
    """Row of the table.

    Attributes:
        field: of `ReviewState`.
        widget: what it is drawn as; None for a field that is only part of the link.
        label: displayed name.
        panel: title of the folder it is in; "" above the folders.
        link: name in the link; "" for a field that is not part of it.
        key: key that takes the next choice or turns the switch; "" without one.
        shown: whether it is drawn.
        enabled: whether it does anything.
    """

    field: str
    widget: Slider | Choice | Switch | None
    label: str = ""
    panel: str = ""
    link: str = ""
    key: str = ""
    shown: Callable[[Shown], bool] = lambda _: True
    enabled: Callable[[Shown], bool] = lambda _: True


def _same(*values: object) -> Callable[[Shown], dict[str, Any]]:
    return lambda _: {str(value): value for value in values}


def _named(options: dict[str, Any]) -> Callable[[Shown], dict[str, Any]]:
    return lambda _: options


def _drives(shown: Shown) -> dict[str, Any]:
    return {shown.model.title(row): row for row in range(len(shown.model.names))}


def _methods(shown: Shown) -> dict[str, Any]:
    """Each method alone, and the shown one with those over it."""
    methods = shown.state.methods
    options: dict[str, Any] = {name: (name,) for name in shown.model.methods(shown.state.drive)} or {NOBODY: ()}
    return {**options, ", ".join(methods): methods} if len(methods) > 1 else options


def _several_methods(shown: Shown) -> bool:
    return len(shown.model.methods(shown.state.drive)) > 1


def _agents(shown: Shown) -> dict[str, Any]:
    if shown.view is None:
        return {"–": None}
    return {agent.title: agent.agent_id for agent in shown.view.agents}


def _objects(shown: Shown) -> dict[str, Any]:
    """Objects of the frame, and the selected one even while absent."""
    selected = shown.state.object_id
    objects: dict[str, Any] = {NOBODY: None}
    if shown.view is not None:
        truth = shown.view.truth
        names = [CLASSES[label] for label in truth.label.tolist()]
        objects |= {f"{name} {number}": number for name, number in zip(names, truth.object_id.tolist(), strict=True)}
    if selected not in objects.values():
        objects[f"object {selected}"] = selected
    return objects


def _sensors(_: Shown) -> dict[str, Any]:
    return {NOBODY: "", **{name: name for name in LIDARS}}


def _senses(shown: Shown) -> bool:
    return bool(shown.state.sensor)


def _carriers(shown: Shown) -> dict[str, Any]:
    agents = () if shown.view is None else shown.view.agents
    return {"ego": "ego", "pole": "pole", **{agent.title: str(agent.agent_id) for agent in agents}}


def _corruptions(shown: Shown) -> dict[str, Any]:
    """Corruptions, and what stored detections are of beside them: faults."""
    sets = shown.model.sources[shown.state.drive].sets.values()
    stored = (condition.kind for one in sets for condition in one.conditions() or ())
    return {kind: kind for kind in (CLEAN, *CORRUPTIONS, *stored)}


def _corruptible(shown: Shown) -> dict[str, Any]:
    """Agents that a corruption may be of: all, some by their part, each alone, and those of the link."""
    agents = () if shown.view is None else shown.view.agents
    named = {"all agents": EVERYONE, "the ego": "ego", "the helpers": "helpers"}
    named |= {f"{agent.title} alone": str(agent.agent_id) for agent in agents}
    return (
        named
        if shown.state.corrupted_agents in named.values()
        else {**named, shown.state.corrupted_agents: shown.state.corrupted_agents}
    )


def _corrupted(shown: Shown) -> bool:
    return shown.state.corruption in CORRUPTIONS


def _detects(shown: Shown) -> bool:
    return shown.model.has_detector


def _of_episode(shown: Shown) -> bool:
    return shown.view is not None and shown.view.moment is not None


def _listed(shown: Shown) -> dict[str, Any]:
    """Kinds of errors; what is broken and fixed only against another run."""
    against = other_run(shown.state) is not None
    return {name: name for name in get_args(Listed) if against or name not in (BROKEN, FIXED)}


def _versus(shown: Shown) -> dict[str, Any]:
    return versus_options(shown.model, shown.state)


def _several_runs(shown: Shown) -> bool:
    return shown.model.has_detector and len(_versus(shown)) > 1


def _blamed(shown: Shown) -> dict[str, Any]:
    names = shown.state.methods or shown.model.methods(shown.state.drive)[:1]
    return {"all methods": "", **{name: name for name in names}}


_CLASSES = {"all": "", **{name: name for name in CLASSES}}
_SEEN = {"anybody or none": "", "the ego": "ego", "helpers alone": "helper", "nobody": "nobody"}

CONTROLS: tuple[Control, ...] = (
    Control("drive", Choice(_drives), "Drive", link="drive", shown=lambda s: len(s.model.names) > 1),
    Control("frame", Slider(0, lambda s: s.model.frame_count(s.state.drive) - 1, 1), "Frame", link="frame"),
    Control("object_id", Choice(_objects, closed=False), "Object", "Selection", link="object"),
    Control("detection", None, link="detection"),
    Control("corruption", Choice(_corruptions), "Corruption", "Corruption lab", link="corruption"),
    Control("severity", Slider(1, 5, 1), "Severity", "Corruption lab", link="severity", enabled=_corrupted),
    Control("family", Choice(_same(*FAMILIES)), "Settings", "Corruption lab", link="family", enabled=_corrupted),
    Control(
        "corrupted_agents",
        Choice(_corruptible, closed=False),
        "Agents",
        "Corruption lab",
        link="who",
        enabled=_corrupted,
    ),
    Control("parameters", None, link="parameters"),
    Control("sensor", Choice(_sensors), "Sensor", "Sensor lab", link="sensor"),
    Control("carrier", Choice(_carriers, closed=False), "Carrier", "Sensor lab", link="carrier", enabled=_senses),
    Control("placement", None, link="placement"),
    Control("threshold", Slider(0.0, 1.0, 0.01), "Score ≥", "Detections", link="score", shown=_detects),
    Control("iou", Choice(_same(*IOU_THRESHOLDS)), "IoU ≥", "Detections", link="iou", key="I", shown=_detects),
    Control("ego_id", Choice(_agents, closed=False), "Ego", "Detections", link="ego", shown=_detects),
    Control("cooperative", Switch(), "Cooperative", "Detections", link="cooperative", key="V", shown=_detects),
    Control("methods", Choice(_methods, closed=False), "Method", "Detections", link="methods", shown=_several_methods),
    Control("hidden", None, link="hidden"),
    Control("listed", Choice(_listed), "List", "Errors", link="errors", shown=_detects),
    Control("versus", Choice(_versus), "Against", "Errors", link="against", shown=_several_runs),
    Control("error_method", Choice(_blamed), "Of", "Errors", link="of", shown=lambda s: len(s.state.methods) > 1),
    Control("error_class", Choice(_named(_CLASSES)), "Class", "Errors", link="class", shown=_detects),
    Control("error_range", Choice(_same(*BANDS)), "Distance, m", "Errors", link="distance", shown=_detects),
    Control("error_seen_by", Choice(_named(_SEEN)), "Seen by", "Errors", link="seen", shown=_detects),
    Control("gallery", Switch(), "Draw the worst", "Errors by cause", link="gallery", shown=_detects),
    Control("speed", Choice(_named(SPEEDS)), "Speed", "Look", link="speed"),
    Control(
        "camera",
        Choice(_named({"Free": "free", "Chase": "chase", "Bird's eye": "bev"})),
        "Camera",
        "Look",
        link="camera",
    ),
    Control("follow", Choice(_named({"Ego": "ego", "Selected": "selected"})), "Follow", "Look", link="follow"),
    Control("ruler", None, link="ruler"),
    Control("rings", Switch(), "Range rings", "Look", link="rings"),
    Control("cut", Switch(), "Cut walls", "Look", link="cut"),
    Control("color_by", Choice(_same(*COLOR_BY)), "Colour by", "Look", link="color", key="U"),
    Control(
        "boxes_by",
        Choice(_named({"Who helped": "shares", "Verdict": "verdict"})),
        "Boxes by",
        "Look",
        link="boxes",
        shown=lambda s: s.model.has_shares(s.state.drive),
    ),
    Control("point_size_m", Slider(0.02, 0.5, 0.01), "Point size", "Look", link="size"),
    Control("max_points", Slider(2000, 120_000, 1000), "Points/agent", "Look", link="points"),
    Control("theme", Choice(_named({"Dark": "dark", "Light": "light"})), "Theme", "Look", link="theme", key="T"),
    *(
        Control(
            "layers_off",
            Switch(layer),
            layer.capitalize(),
            "Look",
            link="off",
            shown=_of_episode if layer in EPISODE_LAYERS else lambda _: True,
        )
        for layer in SHOWN_LAYERS
    ),
)
"""The controls, in the order of the page."""


def value_of(control: Control, shown: Shown) -> Any:
    """Value of a control in the state."""
    value = getattr(shown.state, control.field)
    if control.field == "methods" and not value:
        return tuple(shown.model.methods(shown.state.drive)[:1])
    if control.field == "ego_id" and value is None and shown.view is not None:
        return shown.view.ego.agent_id
    if isinstance(control.widget, Switch) and control.widget.item is not None:
        return control.widget.item not in value
    return value


def change_of(control: Control, shown: Shown, value: object) -> dict[str, Any]:
    """Changes of the state that a value of a control means."""
    if isinstance(control.widget, Switch) and control.widget.item is not None:
        off, item = getattr(shown.state, control.field), control.widget.item
        return {control.field: off - {item} if value else off | {item}}
    return {control.field: value}


def next_value(control: Control, shown: Shown) -> Any:
    """Value that the key of a control sets: the next choice, or the switch turned."""
    value = value_of(control, shown)
    if isinstance(control.widget, Choice):
        options = list(control.widget.options(shown).values())
        return options[(options.index(value) + 1) % len(options)] if value in options else options[0]
    return not value
