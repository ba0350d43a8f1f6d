"""ReviewState: settings of a review page as one frozen value."""

from dataclasses import dataclass, field
from typing import Literal, get_args

from dsrc.options.review import ColorBy
from dsrc.review.labs.parameters import Changes
from sensors.corruptions import Family

Camera = Literal["chase", "bev", "free"]

COLOR_BY: tuple[ColorBy, ...] = get_args(ColorBy)
IOU_THRESHOLDS = (0.3, 0.5, 0.7)

SHOWN_LAYERS = ("truth", "detections", "bodies", "world", "links", "labels", "plan", "tracks", "claims")
"""Layers of the page that can be switched off; the last three are of episodes."""
EPISODE_LAYERS = SHOWN_LAYERS[-3:]

Theme = Literal["dark", "light"]

Listed = Literal["all", "missed", "false", "poor", "broken", "fixed"]
"""Errors in the list: all of them, those of a kind, objects that only the other run finds, or only this one."""
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
        parameters: those of the corruption that differ from the severity's.
        threshold: least score of a shown detection.
        iou: least bird's-eye IoU of a true positive.
        color_by: quantity shown by the colour of a point.
        hidden: agents with hidden points.
        layers_off: hidden layers, of `SHOWN_LAYERS`.
        object_id: the selected object, or None.
        detection: the selected detection, its place in the order of the scores, or None.
        max_points: most points drawn per agent.
        point_size_m: side of a drawn point, m.
        camera: what the camera moves with: the ego and its heading, the ego alone, nothing.
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
    """

    drive: int = 0
    frame: int = 0
    ego_id: int | None = None
    cooperative: bool = True
    methods: tuple[str, ...] = ()
    corruption: str = "clean"
    severity: int = 3
    family: Family = "physical"
    parameters: Changes = ()
    threshold: float = 0.3
    iou: float = 0.5
    color_by: ColorBy = "agent"
    hidden: frozenset[int] = field(default_factory=frozenset)
    layers_off: frozenset[str] = field(default_factory=frozenset)
    object_id: int | None = None
    detection: int | None = None
    max_points: int = 60_000
    point_size_m: float = 0.11
    camera: Camera = "free"
    speed: float = 1.0
    theme: Theme = "dark"
    sensor: str = ""
    carrier: str = "ego"
    placement: tuple[float, ...] = ()
    listed: Listed = "all"
    versus: str = ""
    error_method: str = ""
    error_class: str = ""
    error_range: Band = "any"
    error_seen_by: str = ""
