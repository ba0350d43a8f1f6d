"""FrameView: drawing of one state as plain arrays, independent of the viewer."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dsrc.review.errors.judged import Counts
from dsrc.review.palette import Rgb
from dsrc.review.sources.moment import EpisodeMoment
from dsrc.review.state import ReviewState
from sensors.frame import AgentKind
from sim.boxes import Boxes

DETECTED_TRUTH, FALSE_NEGATIVES, OTHER_TRUTH = "truth/detected", "truth/fn", "truth/other"
TRUE_POSITIVES, FALSE_POSITIVES = "detections/tp", "detections/fp"
UNJUDGED = "detections/unjudged"
SELECTED = "selected/box"
LAYERS = (OTHER_TRUTH, DETECTED_TRUTH, FALSE_NEGATIVES, TRUE_POSITIVES, FALSE_POSITIVES, UNJUDGED, SELECTED)
"""Names of the box layers: truth left out of the evaluation, detected truth, FN, TP, FP, detections of a drive without
labels, the selected box."""


@dataclass(frozen=True, slots=True, eq=False)
class AgentView:
    """Agent as drawn: pose, points and colours.

    Attributes:
        agent_id: the agent.
        kind: `vehicle` or `roadside`.
        is_ego: True for the agent that detects.
        visible: False hides its points.
        rgb: colour of the agent.
        review_from_lidar: (4, 4) float64 pose of the sensor in the review frame.
        review_from_body: (4, 4) float64 pose of the carrier.
        points: (P, 3) float32 in the sensor frame, m.
        colors: (P, 3) uint8.
        made: number of the last of them, made by a corruption and drawn thin; 0 where colour is of the points.
        total: points of the sweep before thinning.
        speed: of the carrier, m/s.
        lost: points lost to a corruption.
        fates: number of points of each `Sweep.fate` in the whole sweep.
        lost_points: (L, 3) float32 the lost points that are drawn, in the sensor frame, m.
    """

    agent_id: int
    kind: AgentKind
    is_ego: bool
    visible: bool
    rgb: Rgb
    review_from_lidar: NDArray[np.float64]
    review_from_body: NDArray[np.float64]
    points: NDArray[np.float32]
    colors: NDArray[np.uint8]
    total: int
    speed: float = 0.0
    lost: int = 0
    fates: tuple[int, ...] = (0, 0, 0, 0)
    made: int = 0
    lost_points: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))

    @property
    def name(self) -> str:
        """Displayed name where any agent may be chosen, whoever detects."""
        return f"{'roadside unit' if self.kind == 'roadside' else 'vehicle'} {abs(self.agent_id)}"

    @property
    def title(self) -> str:
        """Displayed name by its part in the frame, that of the sentences of causes."""
        return "ego" if self.is_ego else self.name.replace("vehicle", "helper")


@dataclass(frozen=True, slots=True)
class ObjectVisibility:
    """Visibility of one object from one agent.

    Attributes:
        agent: displayed name of the agent.
        points: its LiDAR points on the object, before any corruption.
        points_left: the same after the corruption.
        fraction: visible fraction, NaN where unknown, see `sensors.scan.visibility`.
    """

    agent: str
    points: int
    points_left: int
    fraction: float


@dataclass(frozen=True, slots=True)
class AgentShare:
    """Share of one agent in the score of one box.

    Attributes:
        agent: displayed name of the agent.
        share: part of the whole team's score that is due to it, see `dsrc.evaluation.sharing.shares`.
        without: score of the team without it.
    """

    agent: str
    share: float
    without: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Details:
    """What the card says of a box.

    Attributes:
        class_name: of `sim.boxes.CLASSES`.
        size: length, width, height, m.
        distance_m: from the ego to its centre, in the plane.
        verdict: `found`, `missed` or `not evaluated` of an object, `true` or `false` of a detection; "" without a
            detector or labels.
        score: of the detector; NaN for an object without a detection.
        iou: of the detection with its object, or with the one that it overlaps most; NaN or 0 without.
        cause: why the object is missed or the detection false, "" where it is not.
        shares: of the agents in the detection, the ego's first; empty where unknown.
    """

    class_name: str
    size: tuple[float, float, float]
    distance_m: float
    verdict: str = ""
    score: float = math.nan
    iou: float = math.nan
    cause: str = ""
    shares: tuple[AgentShare, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectDetails(_Details):
    """Ground truth of one object, and what the detector made of it.

    Attributes: those of any box, and
        object_id: the object.
        speed: m/s.
        acceleration: along its heading, m/s2; NaN where unknown.
        lights: names of the lights that are on, see `sim.traffic.base.SIGNALS`.
        lane: name of its lane, "" off the lanes.
        seen_by: `BY_EGO`, `BY_HELPER` or `BY_NOBODY`, see `Frame.seen_by`.
        visibility: from each agent, in the order of the frame.
    """

    object_id: int
    speed: float
    acceleration: float
    lights: tuple[str, ...]
    lane: str
    seen_by: int
    visibility: tuple[ObjectVisibility, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionDetails(_Details):
    """One detection.

    Attributes: those of any box, and
        rank: its place in the order of the scores.
        object_id: the matched object, for a false positive the one that it overlaps most; None without overlap.
        object_name: displayed name of that object, "" without overlap.
        points: points of each agent in the box, as drawn: (displayed name, number).
    """

    rank: int
    object_id: int | None
    object_name: str
    points: tuple[tuple[str, int], ...]


@dataclass(frozen=True, slots=True, eq=False)
class MethodView:
    """Detections of a further method, drawn over those that are judged.

    Attributes:
        name: of the set.
        hits: true positives.
        false: false positives; all detections in a drive without labels.
        missed: objects that it misses.
        counts: its TP, FP and FN; None without labels.
    """

    name: str
    hits: Boxes
    false: Boxes
    missed: Boxes
    counts: Counts | None


@dataclass(frozen=True, slots=True, eq=False)
class HelpView:
    """Boxes by the agent to whom most of their score is due, in the review frame.

    Attributes:
        found: true boxes of each agent, in the order of `FrameView.agents`.
        made: false detections of each agent, in the same order.
        missed: true boxes that the whole team misses.
        harmed: true boxes of which an agent takes `HARM` of the score or more.
    """

    found: tuple[Boxes, ...]
    made: tuple[Boxes, ...]
    missed: Boxes
    harmed: Boxes


@dataclass(frozen=True, slots=True, eq=False)
class FrameView:
    """Frame as drawn, in the review frame: the world frame moved to the start of the drive's first ego.

    Attributes:
        drive: name of the drive.
        index: number of the frame.
        time_s: simulation time, s.
        agents: their sweeps, in the order of the frame.
        truth: N objects of the frame, agents' bodies included.
        agent_of: (N,) int64 row of the agent on an object, -1 without one.
        layers: the boxes of each of `LAYERS`.
        ranks: places in the order of the scores of the boxes of each layer of detections.
        linked: (K, 2, 3) float64 lines from the ego's sensor to its collaborators'.
        state: what is drawn; `color_by` is what colour means here.
        labelled: whether the drive has ground truth; without it nothing is judged.
        detected: number of drawn detections.
        counts: TP, FP, FN of this frame; None without a detector or labels.
        seen: their sum over the frames of the drive viewed so far with these settings.
        seen_frames: number of these frames.
        details: of the selected object or detection; None when the frame lacks it.
        method: set of detections that is judged, "" without one.
        compared: further methods.
        notice: why detections are missing, or "".
        moment: what the ego of an episode saw, believed and planned; None elsewhere.
        help: boxes by who helped, in place of the judged ones; None where they are drawn by their verdict.
    """

    drive: str
    index: int
    time_s: float
    agents: tuple[AgentView, ...]
    truth: Boxes
    agent_of: NDArray[np.int64]
    layers: dict[str, Boxes]
    ranks: dict[str, NDArray[np.int64]]
    linked: NDArray[np.float64]
    state: ReviewState
    labelled: bool = True
    detected: int = 0
    counts: Counts | None = None
    seen: Counts = field(default_factory=Counts)
    seen_frames: int = 0
    details: ObjectDetails | DetectionDetails | None = None
    method: str = ""
    compared: tuple[MethodView, ...] = ()
    notice: str = ""
    moment: EpisodeMoment | None = None
    help: HelpView | None = None

    @property
    def ego(self) -> AgentView:
        """The agent that detects."""
        return next(agent for agent in self.agents if agent.is_ego)

    @property
    def selected(self) -> NDArray[np.float64] | None:
        """(3,) centre of the selected box, None without one."""
        boxes = self.layers[SELECTED]
        return boxes.center[0] if len(boxes) else None
