"""ReviewModel: drives and detector, state to drawn arrays, with caches."""

import contextlib
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from dsrc.data.drives import Drive, open_drives
from dsrc.data.sample import SampleDetector, make_sample
from dsrc.ops.detections import Detections
from dsrc.review.agents import agent_view, links
from dsrc.review.details import detection_details, object_details, verdict_on
from dsrc.review.matching import Counts, RankedMatches, match
from dsrc.review.state import ReviewState
from dsrc.review.static import StaticPart, static_parts
from dsrc.review.view import (
    DETECTED_TRUTH,
    FALSE_NEGATIVES,
    FALSE_POSITIVES,
    LAYERS,
    OTHER_TRUTH,
    SELECTED,
    TRUE_POSITIVES,
    UNJUDGED,
    AgentView,
    FrameView,
    ObjectDetails,
)
from sensors.corruptions import CLEAN, CORRUPTIONS, corrupt_frame, drive_seed
from sensors.frame import Frame
from sim.boxes import Boxes
from sim.errors import DataError, UserError, complaint

SEED = 0
"""Seed of the corruptions, the default of `dsrc evaluate` and `dsrc corrupt`."""

T = TypeVar("T")

_FRAMES_KEPT = 24
_VIEWS_KEPT = 4
_DETECTIONS_KEPT = 4096


@dataclass(frozen=True, slots=True, eq=False)
class _FrameDetections:
    """Detections and ground truth of one frame, in the ego LiDAR's frame."""

    detections: Detections
    truth: Boxes
    matches: dict[float, RankedMatches] = field(default_factory=dict)

    def at(self, iou: float) -> RankedMatches:
        """Matches at an IoU, cached."""
        if iou not in self.matches:
            self.matches[iou] = match(self.detections, self.truth, iou)
        return self.matches[iou]


class ReviewModel:
    """Drives, detector and caches of a page; not thread-safe.

    Attributes:
        drives: opened drives.
        names: names of the drives.
        detector: None for a page without detections.
    """

    def __init__(self, drives: list[Drive], detector: SampleDetector | None = None) -> None:
        """Open a page on drives; `open_model` takes paths.

        Raises:
            DataError: the list or a drive is empty.
        """
        if not drives:
            raise DataError("review: no drives")
        for drive in drives:
            if len(drive.frames) == 0:
                raise DataError(complaint(drive.drive, "frames", "at least one frame", "none"))
        self.drives = drives
        self.names = [drive.drive.name for drive in drives]
        self.detector = detector
        self._frames: OrderedDict[Hashable, Frame] = OrderedDict()
        self._corrupted: OrderedDict[Hashable, Frame] = OrderedDict()
        self._agents: OrderedDict[Hashable, tuple[AgentView, ...]] = OrderedDict()
        self._detected: OrderedDict[Hashable, _FrameDetections] = OrderedDict()
        self._origin: dict[int, NDArray[np.float64]] = {}
        self._labelled: dict[int, bool] = {}

    @property
    def has_detector(self) -> bool:
        """Whether there is a detector."""
        return self.detector is not None

    def frame_count(self, drive: int) -> int:
        """Number of frames of a drive."""
        return len(self.drives[drive].frames)

    def readable_frame(self, drive: int) -> Frame:
        """First frame of a drive that can be read.

        Raises:
            DataError: no frame can be read; what is wrong with the first.
        """
        first: UserError | None = None
        for row in range(self.frame_count(drive)):
            try:
                return self._raw(drive, row)
            except UserError as error:
                first = first or error
        raise first or DataError(complaint(self.names[drive], "frames", "at least one frame", "none"))

    def interval_s(self, drive: int) -> float:
        """Time between frames of a drive, s; 0.1 where unknown."""
        if self.frame_count(drive) < 2:
            return 0.1
        try:
            step = self._raw(drive, 1).time_s - self._raw(drive, 0).time_s
        except UserError:
            return 0.1
        return step if 0.0 < step < 10.0 else 0.1

    def origin(self, drive: int) -> NDArray[np.float64]:
        """(3,) world position of the review frame's origin, m: the first agent's in the first readable frame.

        Coordinates in the browser then fit float32, and the road is near z = 0.
        """
        if drive not in self._origin:
            self._origin[drive] = self.readable_frame(drive).agents[0].world_from_body[:3, 3].copy()
        return self._origin[drive]

    def labelled(self, drive: int) -> bool:
        """Whether a drive has ground truth: whether one of a few of its frames has any object."""
        if drive not in self._labelled:
            self._labelled[drive] = any(len(frame.truth) > 0 for frame in self._few_frames(drive))
        return self._labelled[drive]

    def _few_frames(self, drive: int) -> Iterator[Frame]:
        """First, middle and last frame, those that can be read."""
        for row in sorted({0, self.frame_count(drive) // 2, self.frame_count(drive) - 1}):
            with contextlib.suppress(UserError):
                yield self._raw(drive, row)

    def static_parts(self, drive: int) -> list[StaticPart]:
        """Static world around the agents of a drive; empty when it cannot be rebuilt."""
        places = [agent.world_from_body[:2, 3] for frame in self._few_frames(drive) for agent in frame.agents]
        protocol = getattr(self.drives[drive], "protocol", {})
        return static_parts(protocol, self.origin(drive), np.array(places, np.float64))

    def ego_id(self, state: ReviewState) -> int:
        """Id of the agent that detects under a state."""
        ids = [agent.agent_id for agent in self._raw(state.drive, state.frame).agents]
        return state.ego_id if state.ego_id in ids else ids[0]

    def view(self, state: ReviewState) -> FrameView:
        """Frame as drawn under a state."""
        frame = self._frame(state)
        ego_id = self.ego_id(state)
        review_from_world = np.eye(4)
        review_from_world[:3, 3] = -self.origin(state.drive)
        truth = frame.truth.transform(review_from_world)
        agent_ids = [agent.agent_id for agent in frame.agents]
        agent_of = np.array([agent_ids.index(i) if i in agent_ids else -1 for i in truth.object_id.tolist()], np.int64)
        agents = self._agent_views(frame, state, ego_id, review_from_world)
        view = FrameView(
            drive=self.names[state.drive],
            index=frame.index,
            time_s=frame.time_s,
            agents=agents,
            truth=truth,
            agent_of=agent_of,
            layers={**_no_boxes(), SELECTED: truth[truth.object_id == state.object_id]},
            ranks={},
            linked=links(agents) if state.cooperative else np.zeros((0, 2, 3)),
            layers_off=state.layers_off,
            color_by=state.color_by,
            point_size_m=state.point_size_m,
            labelled=self.labelled(state.drive),
            details=object_details(frame, state.object_id, ego_id, [agent.title for agent in agents]),
        )
        if self.detector is None:
            evaluated = truth.is_vehicle & (frame.points_on.sum(axis=0) > 0) & (truth.object_id != ego_id)
            return replace(
                view, layers={**view.layers, DETECTED_TRUTH: truth[evaluated], OTHER_TRUTH: truth[~evaluated]}
            )
        return self._with_detections(view, state, frame, review_from_world)

    def _agent_views(
        self, frame: Frame, state: ReviewState, ego_id: int, review_from_world: NDArray[np.float64]
    ) -> tuple[AgentView, ...]:
        """Agents as drawn; the same objects while their settings stay."""
        key = (state.drive, state.frame, self._condition(state), ego_id, state.hidden, state.color_by, state.max_points)
        rows = range(len(frame.agents))
        return _remember(
            self._agents,
            key,
            _VIEWS_KEPT,
            lambda: tuple(agent_view(frame, row, state, ego_id, review_from_world) for row in rows),
        )

    def _with_detections(
        self, view: FrameView, state: ReviewState, frame: Frame, review_from_world: NDArray[np.float64]
    ) -> FrameView:
        found = self._detections(state)
        matches = found.at(state.iou)
        kept = matches.kept(state.threshold)
        ego_id = view.ego.agent_id
        review_from_lidar = review_from_world @ frame.agent(ego_id).sweep.world_from_lidar
        boxes = found.detections.boxes[:kept].transform(review_from_lidar)
        rank = np.arange(kept)
        if state.detection is not None and state.detection < kept:
            titles = [agent.title for agent in view.agents]
            details = detection_details(
                frame, state.detection, found.detections, found.truth, matches, ego_id, titles, view.labelled
            )
            selected = boxes[state.detection : state.detection + 1]
            view = replace(view, details=details, layers={**view.layers, SELECTED: selected})
        elif isinstance(view.details, ObjectDetails) and view.labelled:
            verdict, score, iou = verdict_on(view.details.object_id, found.truth, matches, state.threshold)
            view = replace(view, details=replace(view.details, verdict=verdict, score=score, iou=iou))
        if not view.labelled:
            return replace(view, detected=kept, layers={**view.layers, UNJUDGED: boxes}, ranks={UNJUDGED: rank})
        tp = matches.tp[:kept]
        # Boxes are drawn from the frame; the ego's sample only says which of them are detected.
        found_ids = found.truth.object_id[matches.found(state.threshold)]
        evaluated = np.isin(view.truth.object_id, found.truth.object_id)
        hit = np.isin(view.truth.object_id, found_ids)
        layers = {
            **view.layers,
            OTHER_TRUTH: view.truth[~evaluated],
            DETECTED_TRUTH: view.truth[evaluated & hit],
            FALSE_NEGATIVES: view.truth[evaluated & ~hit],
            TRUE_POSITIVES: boxes[tp],
            FALSE_POSITIVES: boxes[~tp],
        }
        seen, seen_frames = self._seen(state)
        return replace(
            view,
            layers=layers,
            ranks={TRUE_POSITIVES: rank[tp], FALSE_POSITIVES: rank[~tp]},
            detected=kept,
            counts=matches.counts(state.threshold),
            seen=seen,
            seen_frames=seen_frames,
        )

    def counts(self, state: ReviewState) -> Counts | None:
        """Counts of TP, FP and FN under a state; None without a detector."""
        if self.detector is None or not self.labelled(state.drive):
            return None
        return self._detections(state).at(state.iou).counts(state.threshold)

    def _seen(self, state: ReviewState) -> tuple[Counts, int]:
        """Sum the counts of the frames with cached detections under these settings."""
        keys = (self._key(replace(state, frame=row)) for row in range(self.frame_count(state.drive)))
        known = [self._detected[key] for key in keys if key in self._detected]
        counts = (found.at(state.iou).counts(state.threshold) for found in known)
        return sum(counts, Counts()), len(known)

    def _key(self, state: ReviewState) -> Hashable:
        return (state.drive, state.frame, self._condition(state), state.ego_id, state.cooperative)

    def _condition(self, state: ReviewState) -> Hashable:
        """Cache key of the corruption."""
        if state.corruption == CLEAN:
            return CLEAN
        known = CORRUPTIONS.get(state.corruption)
        ego = state.ego_id if known is not None and known.spares_ego else None
        return (state.corruption, state.severity, state.family, ego)

    def _detections(self, state: ReviewState) -> _FrameDetections:
        def detect() -> _FrameDetections:
            detector = self.detector
            if detector is None:
                raise ValueError("no detector")
            sample = make_sample(
                self._frame(state),
                self.ego_id(state),
                detector.settings.grid,
                max_agents=getattr(detector.settings, "max_agents", 5),
                cooperative=state.cooperative,
            )
            return _FrameDetections(detector.detect(sample), sample.boxes)

        return _remember(self._detected, self._key(state), _DETECTIONS_KEPT, detect)

    def _raw(self, drive: int, row: int) -> Frame:
        return _remember(self._frames, (drive, row), _FRAMES_KEPT, lambda: self.drives[drive].read(row))

    def _frame(self, state: ReviewState) -> Frame:
        raw = self._raw(state.drive, state.frame)
        if state.corruption == CLEAN:
            return raw
        seed = drive_seed(SEED, self.names[state.drive])
        return _remember(
            self._corrupted,
            (state.drive, state.frame, self._condition(state)),
            _FRAMES_KEPT,
            lambda: corrupt_frame(raw, state.corruption, state.severity, seed, state.family, ego_id=self.ego_id(state)),
        )


def _remember(cache: "OrderedDict[Hashable, T]", key: Hashable, limit: int, make: Callable[[], T]) -> T:
    """Return the cached value of `key`, made when missing; a full cache drops the least recently used."""
    if key not in cache:
        cache[key] = make()
    cache.move_to_end(key)
    while len(cache) > limit:
        cache.popitem(last=False)
    return cache[key]


def _no_boxes() -> dict[str, Boxes]:
    return {name: Boxes.zeros() for name in LAYERS}


def open_model(root: Path, checkpoint: Path | None = None) -> ReviewModel:
    """Open all drives at or below a folder, and a detector.

    Raises:
        DataError: the folder is missing or holds no drive.
        CheckpointError: the checkpoint cannot be loaded.
    """
    drives: list[Drive] = [*open_drives(Path(root))]
    if checkpoint is None:
        return ReviewModel(drives)
    # Torch takes seconds to import; ground truth alone does without.
    from dsrc.models.storage.checkpoint import load_student

    return ReviewModel(drives, load_student(Path(checkpoint)))
