"""ReviewState: what a reviewer looks at, as one frozen value."""

from dataclasses import dataclass, field
from typing import Literal, get_args

from sensors.corruptions import Family

ColorBy = Literal["agent", "intensity", "height", "ring", "fate"]
Camera = Literal["chase", "bev", "free"]

COLOR_BY: tuple[ColorBy, ...] = get_args(ColorBy)
IOU_THRESHOLDS = (0.3, 0.5, 0.7)

SHOWN_LAYERS = ("truth", "detections", "bodies", "world", "links", "labels")
"""Groups of things on the page that can be switched off."""


@dataclass(frozen=True, slots=True)
class ReviewState:
    """One state of the page; everything that is drawn follows from it.

    Attributes:
        drive: row of the drive.
        frame: row of the frame in the drive.
        ego_id: the agent that detects; None = the first of the frame.
        cooperative: whether the ego hears its collaborators.
        corruption: `clean` or a kind of `sensors.corruptions`.
        severity: 1 to 5.
        family: of the corruption's settings.
        threshold: detections below this score are not shown.
        iou: bird's-eye IoU from which a detection counts as right.
        color_by: what the colour of a point means.
        hidden: agents whose points are not drawn.
        layers_off: layers that are not drawn, of `SHOWN_LAYERS`.
        object_id: the object that the page tells about, None for none.
        max_points: at most this many points per agent are drawn.
        point_size_m: side of a drawn point, m.
    """

    drive: int = 0
    frame: int = 0
    ego_id: int | None = None
    cooperative: bool = True
    corruption: str = "clean"
    severity: int = 3
    family: Family = "physical"
    threshold: float = 0.3
    iou: float = 0.5
    color_by: ColorBy = "agent"
    hidden: frozenset[int] = field(default_factory=frozenset)
    layers_off: frozenset[str] = field(default_factory=frozenset)
    object_id: int | None = None
    max_points: int = 60_000
    point_size_m: float = 0.11
