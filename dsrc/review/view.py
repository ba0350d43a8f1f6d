"""FrameView: everything that is drawn of one state, as plain arrays. Nothing here knows the viewer."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dsrc.review.matching import Counts
from dsrc.review.palette import Rgb
from dsrc.review.state import ColorBy
from sensors.frame import AgentKind
from sim.boxes import Boxes

FOUND, MISSED_BOXES, OTHER_BOXES = "truth/found", "truth/missed", "truth/other"
RIGHT_BOXES, WRONG_BOXES = "detections/right", "detections/wrong"
CHOSEN = "chosen/object"
LAYERS = (OTHER_BOXES, FOUND, MISSED_BOXES, RIGHT_BOXES, WRONG_BOXES, CHOSEN)
"""Names of the box layers: other truth (not judged), truth found, truth missed (FN), right (TP) and wrong (FP), and the
object that the page tells about."""


@dataclass(frozen=True, slots=True, eq=False)
class AgentView:
    """One agent's sweep as it is drawn.

    Attributes:
        agent_id: the agent.
        kind: `vehicle` or `roadside`.
        is_ego: whether it is the one that detects.
        visible: whether its points are drawn.
        rgb: its own colour.
        review_from_lidar: (4, 4) float64 pose of the sensor in the review frame.
        review_from_body: (4, 4) float64 pose of the carrier.
        points: (P, 3) float32 in the sensor frame, m.
        colors: (P, 3) uint8.
        total: points of the sweep before thinning.
        lost: points that a corruption took from it.
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
    lost: int = 0

    @property
    def title(self) -> str:
        """Name for people."""
        return f"{'roadside unit' if self.kind == 'roadside' else 'vehicle'} {abs(self.agent_id)}"


@dataclass(frozen=True, slots=True)
class Sighting:
    """What one agent has on an object.

    Attributes:
        agent: its name for people.
        points: its LiDAR points on the object, before any corruption.
        fraction: visible fraction, NaN where there is none, see `sensors.scan.visibility`.
    """

    agent: str
    points: int
    fraction: float


@dataclass(frozen=True, slots=True)
class ObjectFacts:
    """What the ground truth says of one object.

    Attributes:
        object_id: the object.
        class_name: of `sim.boxes.CLASSES`.
        speed: m/s.
        acceleration: along its heading, m/s2; NaN where nobody knows.
        lights: names of what is lit, see `sim.traffic.base.SIGNALS`.
        lane: name of its lane, "" for none.
        seen_by: `BY_EGO`, `BY_HELPER` or `BY_NOBODY`, see `Frame.seen_by`.
        sightings: of the agents in the order of the frame.
    """

    object_id: int
    class_name: str
    speed: float
    acceleration: float
    lights: tuple[str, ...]
    lane: str
    seen_by: int
    sightings: tuple[Sighting, ...]


@dataclass(frozen=True, slots=True, eq=False)
class FrameView:
    """One frame as it is drawn, in the review frame: the world, moved to where the drive's first ego started.

    Attributes:
        drive: name of the drive.
        index: number of the frame.
        time_s: simulation time, s.
        agents: their sweeps, in the order of the frame.
        truth: N objects of the frame, agents' bodies included.
        agent_of: (N,) int64 row of the agent that an object carries, -1 for none.
        layers: the boxes of each of `LAYERS`.
        linked: (K, 2, 3) float64 lines from the ego's sensor to those of the agents that it hears.
        layers_off: groups of layers that are not drawn.
        color_by: what the colour of a point means.
        point_size_m: side of a drawn point, m.
        counts: TP, FP, FN of this frame; None without a detector.
        seen: the same, summed over all frames of the drive that were looked at in this setting.
        seen_frames: how many those are.
        note: a sentence on the state, "" for none.
        facts: of the object that the page tells about, None when there is none in this frame.
    """

    drive: str
    index: int
    time_s: float
    agents: tuple[AgentView, ...]
    truth: Boxes
    agent_of: NDArray[np.int64]
    layers: dict[str, Boxes]
    linked: NDArray[np.float64]
    layers_off: frozenset[str]
    color_by: ColorBy
    point_size_m: float
    counts: Counts | None = None
    seen: Counts = field(default_factory=Counts)
    seen_frames: int = 0
    note: str = ""
    facts: ObjectFacts | None = None

    @property
    def ego(self) -> AgentView:
        """The agent that detects."""
        return next(agent for agent in self.agents if agent.is_ego)
