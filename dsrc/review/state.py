"""ReviewState: settings of a review page as one frozen value."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from dsrc.options.review import ColorBy
from sensors.corruptions import CLEAN, EVERYONE, Changes, Family

Camera = Literal["chase", "bev", "free"]
Follow = Literal["ego", "selected"]

COLOR_BY: tuple[ColorBy, ...] = get_args(ColorBy)
BoxesBy = Literal["verdict", "shares"]
"""Meaning of the boxes' colours: the detector's verdict, or the agent to whom most of the score is due."""
IOU_THRESHOLDS = (0.3, 0.5, 0.7)

SHOWN_LAYERS = ("truth", "detections", "bodies", "world", "links", "labels", "plan", "tracks", "claims", "seen")
"""Layers of the page that can be switched off; the last four are of episodes."""
EPISODE_LAYERS = SHOWN_LAYERS[-4:]

Theme = Literal["light", "dark"]

Listed = Literal["all", "missed", "false", "poor", "broken", "fixed"]
"""Errors in the list: all of them, those of a kind, objects that only the other run finds, or only this one."""
METHOD = "method "
"""What the name of a method follows in `ReviewState.versus`."""
Band = Literal["any", "0-30", "30-50", "50-100"]
"""Distances from the ego's LiDAR in the plane, m."""


@dataclass(frozen=True, slots=True)
class ReviewState:
    """State of the page: drive, frame, corruption, detection settings, colours, layers, selection, camera.

    Attributes:
        drive: row of the drive.
        frame: row of the frame in the drive.
        ego_id: the agent that detects; None for the first of the frame.
        cooperative: detect with the collaborators' clouds; else with the ego's alone.
        methods: sets of detections: the first is judged, the others are drawn over it; empty for the drive's first.
        corruption: `clean` or a kind of `sensors.corruptions`.
        severity: 1 to 5.
        family: of the corruption's settings.
        corrupted_agents: agents whose sweeps are corrupted, see `sensors.corruptions.parse_agents`.
        parameters: those of the corruption that differ from the severity's.
        threshold: least score of a shown detection.
        iou: least bird's-eye IoU of a true positive.
        color_by: what colour means; `agent` in place of `verdict` where nothing is judged.
        boxes_by: meaning of the boxes' colours; `verdict` wherever shares are unknown.
        hidden: agents with hidden points.
        layers_off: hidden layers, of `SHOWN_LAYERS`.
        object_id: the selected object, or None.
        detection: the selected detection, its place in the order of the scores, or None.
        max_points: most points drawn per agent.
        point_size_m: side of a drawn point, m.
        camera: what the camera moves with: the ego and its heading, the ego alone, nothing.
        follow: what a camera that moves goes with: the ego, or the selected box where there is one.
        rings: whether circles around the ego are drawn.
        cut: whether walls and plants end a metre above the start of the ego.
        ruler: x and y of its ends in the review frame, m; 0, 2 or 4 numbers.
        speed: of playing, in multiples of real time.
        theme: of the page.
        sensor: preset of a sensor that is cast anew, "" for none.
        carrier: what carries it: `ego`, `pole` or the id of an agent.
        placement: x, y, z on the carrier, m, yaw and pitch, degrees; () for the usual place.
        listed: errors in the list.
        versus: run that tells what is broken and fixed: `clean`, `alone`, the name of a method after `method `; "" for
            `clean` where the sweeps are corrupted, else none.
        error_method: set of detections whose errors are listed, "" for those of all that are shown.
        error_class: class of the listed objects, "" for all.
        error_range: distance of the listed errors.
        error_seen_by: who has points on the listed objects, of `SEERS`; "" for all.
        gallery: whether the listed errors are drawn, grouped by cause.
    """

    drive: int = 0
    frame: int = 0
    ego_id: int | None = None
    cooperative: bool = True
    methods: tuple[str, ...] = ()
    corruption: str = "clean"
    severity: int = 3
    family: Family = "physical"
    corrupted_agents: str = EVERYONE
    parameters: Changes = ()
    threshold: float = 0.3
    iou: float = 0.5
    color_by: ColorBy = "verdict"
    boxes_by: BoxesBy = "shares"
    hidden: frozenset[int] = field(default_factory=frozenset)
    layers_off: frozenset[str] = field(default_factory=frozenset)
    object_id: int | None = None
    detection: int | None = None
    max_points: int = 60_000
    point_size_m: float = 0.07
    camera: Camera = "free"
    follow: Follow = "ego"
    rings: bool = False
    cut: bool = False
    ruler: tuple[float, ...] = ()
    speed: float = 1.0
    theme: Theme = "light"
    sensor: str = ""
    carrier: str = "ego"
    placement: tuple[float, ...] = ()
    listed: Listed = "all"
    versus: str = ""
    error_method: str = ""
    error_class: str = ""
    error_range: Band = "any"
    error_seen_by: str = ""
    gallery: bool = False

    @property
    def selects(self) -> bool:
        """Whether an object or a detection is selected."""
        return self.object_id is not None or self.detection is not None


_OF_CORRUPTION = ("corruption", "severity", "family")
# A detection is known by its place in one list of scores.
_LIST_OF_DETECTIONS = (*"drive frame parameters corrupted_agents ego_id cooperative methods".split(), *_OF_CORRUPTION)


def with_changes(state: ReviewState, methods: Callable[[int], Collection[str]], /, **changes: Any) -> ReviewState:
    """State with other values of some fields, and without what these make meaningless.

    Another drive starts at its first frame, another corruption with the parameters of its severity, another carrier at
    the sensor's usual place; an object or a detection is selected, not both. No run is compared with itself, and
    nothing is broken or fixed without another run.

    Args:
        methods: function from a drive to the names of its sets of detections.
    """

    def differ(*names: str) -> bool:
        return any(getattr(after, name) != getattr(state, name) for name in names)

    after = replace(state, **changes)
    if differ("drive"):
        kept = tuple(name for name in after.methods if name in methods(after.drive))
        after = replace(after, frame=0, ego_id=None, hidden=frozenset(), object_id=None, camera="free")
        after = replace(after, methods=kept, versus="", error_method="", ruler=())
    if "parameters" not in changes and differ(*_OF_CORRUPTION):
        after = replace(after, parameters=())
    if "placement" not in changes and differ("drive", "carrier"):
        after = replace(after, placement=())
    after = _comparable(after, methods)
    if "object_id" in changes and after.object_id is not None:
        return replace(after, detection=None)
    if "detection" in changes and after.detection is not None:
        return replace(after, object_id=None)
    return replace(after, detection=None) if differ(*_LIST_OF_DETECTIONS) else after


def other_run(state: ReviewState) -> ReviewState | None:
    """State of the run that tells what is broken and fixed; None without one."""
    versus = state.versus or (CLEAN if state.corruption != CLEAN else "")
    state = replace(state, versus="")
    if versus == CLEAN:
        return replace(state, corruption=CLEAN)
    if versus == "alone":
        return replace(state, cooperative=False)
    return replace(state, methods=(versus.removeprefix(METHOD),)) if versus else None


def _comparable(state: ReviewState, methods: Callable[[int], Collection[str]]) -> ReviewState:
    """State that lists errors of methods that are shown, and compares its run with another one."""
    shown = state.methods or tuple(methods(state.drive))[:1]
    if state.error_method not in shown:
        state = replace(state, error_method="")
    other = other_run(state)
    own = replace(state, versus="", methods=shown[:1])
    if other is not None and replace(other, methods=(other.methods or shown)[:1]) == own:
        state = replace(state, versus="")
    if state.listed in ("broken", "fixed") and other_run(state) is None:
        state = replace(state, listed="all")
    return state
