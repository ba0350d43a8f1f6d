"""ReviewModel: sources and their sets of detections, state to drawn arrays, with caches."""

import contextlib
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from dsrc.data.drives import Drive
from dsrc.data.sample import SampleDetector
from dsrc.evaluation.detection_table import DetectionTable
from dsrc.ops.detections import Detections
from dsrc.review.agents import agent_view, help_view, links, with_shares
from dsrc.review.details import detection_details, object_details, verdict_on
from dsrc.review.errors.changes import Changes, changes
from dsrc.review.errors.filters import ErrorFilter
from dsrc.review.errors.index import ErrorIndex
from dsrc.review.errors.judged import JudgedRun
from dsrc.review.errors.notes import NoteBook
from dsrc.review.frames import FrameStore, LatestUsed
from dsrc.review.matching import Counts, RankedMatches, match
from dsrc.review.sources.base import DetectionSet, Setup, Source, condition_of, condition_title
from dsrc.review.sources.detected import ComputedSet, present_agents
from dsrc.review.sources.drives import DriveSource
from dsrc.review.sources.moment import EpisodeMoment, EpisodeTimeline
from dsrc.review.sources.opening import add_detectors, open_sources
from dsrc.review.sources.shares import SharedSource
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
    DetectionDetails,
    FrameView,
    MethodView,
    ObjectDetails,
)
from sensors.corruptions import CLEAN
from sensors.frame import Frame
from sim.boxes import Boxes
from sim.errors import DataError, SettingsError, UserError, complaint, did_you_mean
from sim.geometry import invert, transform_points

DETECTOR = "detector"
"""Name of the set of a detector without one."""

_ROUTE_STEP = 20
"""Points of an ego's route between two places around which the world is drawn."""
_VIEWS_KEPT = 4
_DETECTIONS_KEPT = 4096
_RUNS_KEPT = 12


@dataclass(frozen=True, slots=True, eq=False)
class _FrameDetections:
    """Detections and ground truth of one frame, in the ego LiDAR's frame."""

    detections: Detections
    truth: Boxes
    ego_id: int
    matches: dict[float, RankedMatches] = field(default_factory=dict)

    def at(self, iou: float) -> RankedMatches:
        """Matches at an IoU, cached."""
        if iou not in self.matches:
            self.matches[iou] = match(self.detections, self.truth, iou)
        return self.matches[iou]


class ReviewModel:
    """Sources, their detections and caches of a page; one thread at a time, beside a `Worker` on its stores.

    Attributes:
        sources: what is reviewed.
        drives: the same; the page's word.
        names: names of the sources.
        stores: frames of each source.
        notes: on the errors, None where they cannot be kept.
    """

    def __init__(
        self,
        sources: Sequence[Source | Drive],
        detector: SampleDetector | None = None,
        notes: NoteBook | None = None,
    ) -> None:
        """Open a page on sources or drives; `open_model` takes paths.

        Args:
            sources: sources, or drives as they are.
            detector: gives all sources a set named `DETECTOR`.
            notes: on the errors; None for none.

        Raises:
            DataError: the list or a drive is empty.
        """
        if not sources:
            raise DataError("review: no drives")
        self.sources = [cast(Source, one) if hasattr(one, "sets") else DriveSource(one) for one in sources]
        self.drives, self.notes = self.sources, notes
        self.names = [source.name for source in self.sources]
        self.stores = [FrameStore(source) for source in self.sources]
        if detector is not None:
            for source in self.sources:
                source.sets[DETECTOR] = ComputedSet(DETECTOR, detector)
        self._agents: LatestUsed[tuple[AgentView, ...]] = LatestUsed(_VIEWS_KEPT)
        self._judged: LatestUsed[_FrameDetections] = LatestUsed(_DETECTIONS_KEPT)
        self._runs: LatestUsed[JudgedRun] = LatestUsed(_RUNS_KEPT)
        self._origin: dict[int, NDArray[np.float64]] = {}

    @property
    def has_detector(self) -> bool:
        """Whether any source has a set of detections."""
        return any(source.sets for source in self.sources)

    def methods(self, drive: int) -> list[str]:
        """Names of the sets of detections of a source."""
        return list(self.sources[drive].sets)

    def method(self, state: ReviewState) -> str:
        """Set of detections that is judged under a state; "" without one."""
        return next(iter(self._asked(state)), "")

    def computes(self, state: ReviewState) -> bool:
        """Whether the judged detections of a state are computed here."""
        method = self.method(state)
        return bool(method) and isinstance(self.sources[state.drive].sets[method], ComputedSet)

    def frame_count(self, drive: int) -> int:
        """Number of frames of a source, which may grow."""
        return len(self.sources[drive])

    def grows(self, drive: int) -> bool:
        """Whether more frames of a source are to come."""
        return getattr(self.sources[drive], "ended", True) is False

    def first_row(self, drive: int) -> int:
        """Row of the oldest frame that a source still has."""
        return getattr(self.sources[drive], "first", 0)

    def readable_frame(self, drive: int) -> Frame:
        """First frame of a drive that can be read.

        Raises:
            DataError: no frame can be read; what is wrong with the first.
        """
        first: UserError | None = None
        for row in range(self.first_row(drive), self.frame_count(drive)):
            try:
                return self.stores[drive].recorded(row)
            except UserError as error:
                first = first or error
        raise first or DataError(complaint(self.names[drive], "frames", "at least one frame", "none"))

    def interval_s(self, drive: int) -> float:
        """Time between frames of a drive, s; 0.1 where unknown."""
        first = self.first_row(drive)
        if self.frame_count(drive) < first + 2:
            return 0.1
        try:
            read = self.stores[drive].recorded
            step = read(first + 1).time_s - read(first).time_s
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
        """Whether a source has ground truth; without it nothing is judged."""
        return self.sources[drive].labelled

    def has_shares(self, drive: int) -> bool:
        """Whether it is known who helped in a source."""
        return isinstance(self.sources[drive], SharedSource)

    def _few_frames(self, drive: int) -> Iterator[Frame]:
        """First, middle and last frame, those that can be read."""
        first, last = self.first_row(drive), self.frame_count(drive) - 1
        for row in sorted({first, (first + last + 1) // 2, last}):
            with contextlib.suppress(UserError):
                yield self.stores[drive].recorded(row)

    def static_parts(self, drive: int) -> list[StaticPart]:
        """Static world around the agents of a drive; empty when none is known, DataError where it cannot be rebuilt."""
        places = [agent.world_from_body[:2, 3] for frame in self._few_frames(drive) for agent in frame.agents]
        moment = getattr(self.sources[drive], "moment", None)
        if moment is not None:
            # A running episode has not come far.
            places += [*moment(self.first_row(drive)).route[::_ROUTE_STEP]]
        return static_parts(dict(self.sources[drive].protocol), self.origin(drive), np.array(places, np.float64))

    def ego_id(self, state: ReviewState) -> int:
        """Id of the agent that detects under a state."""
        ids = [agent.agent_id for agent in self.stores[state.drive].recorded(state.frame).agents]
        return state.ego_id if state.ego_id in ids else ids[0]

    def view(self, state: ReviewState) -> FrameView:
        """Frame as drawn under a state."""
        view = self._view(state, self.method(state))
        return self._with_shares(view, state) if self.has_shares(state.drive) else view

    def sketch(self, state: ReviewState) -> FrameView:
        """First look at a frame, without computing: true boxes, and the ego's points where they are clean."""
        recorded = self.stores[state.drive].recorded(state.frame)
        shown = {self.ego_id(state)} - state.hidden if state.corruption == CLEAN else set()
        hidden = frozenset(agent.agent_id for agent in recorded.agents) - shown
        return self._view(replace(state, corruption=CLEAN, hidden=hidden), "")

    def _view(self, state: ReviewState, method: str) -> FrameView:
        """Frame as drawn under a state with the detections of a set; "" for none."""
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
        view = replace(view, moment=self.moment(state), notice=self._absent(state, frame))
        found = self._detections(state, method) if method else None
        if found is None:
            evaluated = truth.is_vehicle & (frame.points_on.sum(axis=0) > 0) & (truth.object_id != ego_id)
            layers = {**view.layers, DETECTED_TRUTH: truth[evaluated], OTHER_TRUTH: truth[~evaluated]}
            return replace(view, layers=layers, method=method, notice=self._notice(state, method) or view.notice)
        view = self._with_detections(view, state, frame, review_from_world, found)
        compared = [self._compared(state, name, frame, review_from_world) for name in self._asked(state)[1:]]
        return replace(view, method=method, compared=tuple(one for one in compared if one is not None))

    def _with_shares(self, view: FrameView, state: ReviewState) -> FrameView:
        """View with who helped: on the card, and as the colour of the boxes where that is asked for."""
        source = cast(SharedSource, self.sources[state.drive])
        shared = source.shares(state.frame, self.setup(state))
        ids = [agent.agent_id for agent in view.agents]
        if shared is None or shared.ego_id not in ids:
            return replace(view, notice=view.notice or source.shared(self.setup(state)))
        if view.details is not None:
            place, selected = None, view.selected
            if isinstance(view.details, DetectionDetails) and selected is not None:
                (place,) = transform_points(invert(view.ego.review_from_lidar), selected[None])
            titles = {agent.agent_id: agent.title for agent in view.agents}
            view = replace(view, details=with_shares(view.details, shared, titles, place))
        if state.boxes_by != "shares":
            return view
        review_from_lidar = view.agents[ids.index(shared.ego_id)].review_from_lidar
        other = ~np.isin(view.truth.object_id, [one.object_id for one in shared.boxes])
        layers = {**_no_boxes(), OTHER_TRUTH: view.truth[other], SELECTED: view.layers[SELECTED]}
        return replace(view, layers=layers, ranks={}, help=help_view(shared, ids, review_from_lidar))

    def _agent_views(
        self, frame: Frame, state: ReviewState, ego_id: int, review_from_world: NDArray[np.float64]
    ) -> tuple[AgentView, ...]:
        """Agents as drawn; the same objects while their settings stay."""
        key = (state.drive, state.frame, self.setup(state), ego_id, state.hidden, state.color_by, state.max_points)
        rows = range(len(frame.agents))
        recorded = self.stores[state.drive].recorded(state.frame) if state.color_by == "fate" else frame
        return self._agents.get(
            key, lambda: tuple(agent_view(frame, row, state, ego_id, review_from_world, recorded) for row in rows)
        )

    def _with_detections(
        self,
        view: FrameView,
        state: ReviewState,
        frame: Frame,
        review_from_world: NDArray[np.float64],
        found: _FrameDetections,
    ) -> FrameView:
        matches = found.at(state.iou)
        kept = matches.kept(state.threshold)
        ego_id = found.ego_id
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

    def _compared(
        self, state: ReviewState, name: str, frame: Frame, review_from_world: NDArray[np.float64]
    ) -> MethodView | None:
        """Detections of a further method; None where they are unknown."""
        found = self._detections(state, name)
        if found is None:
            return None
        review_from_lidar = review_from_world @ frame.agent(found.ego_id).sweep.world_from_lidar
        matches = found.at(state.iou)
        kept = matches.kept(state.threshold)
        boxes = found.detections.boxes[:kept].transform(review_from_lidar)
        missed = found.truth[~matches.found(state.threshold)].transform(review_from_lidar)
        if not self.labelled(state.drive):
            return MethodView(name, Boxes.zeros(), boxes, Boxes.zeros(), None)
        tp = matches.tp[:kept]
        return MethodView(name, boxes[tp], boxes[~tp], missed, matches.counts(state.threshold))

    def counts(self, state: ReviewState) -> Counts | None:
        """Counts of TP, FP and FN in a frame; None without detections or labels."""
        method = self.method(state)
        found = self._detections(state, method) if method and self.labelled(state.drive) else None
        return None if found is None else found.at(state.iou).counts(state.threshold)

    def moment(self, state: ReviewState) -> EpisodeMoment | None:
        """What the ego of an episode saw, believed and planned, in the review frame; None elsewhere."""
        moment = getattr(self.sources[state.drive], "moment", None)
        return None if moment is None else moment(state.frame).moved(-self.origin(state.drive))

    def timeline(self, drive: int) -> EpisodeTimeline | None:
        """Course of an episode; None elsewhere."""
        timeline = getattr(self.sources[drive], "timeline", None)
        return None if timeline is None else timeline()

    def setup(self, state: ReviewState) -> Setup:
        """Setup of the detections under a state."""
        condition = condition_of(state.corruption, state.severity, state.family, state.parameters, state.who)
        return Setup(condition, state.ego_id, state.cooperative)

    def index(self, state: ReviewState) -> ErrorIndex:
        """Errors of the run under a state, of all its methods, in the frames whose detections are known."""
        return ErrorIndex([self._run(state.drive, name, self.setup(state)) for name in self._asked(state)])

    def changes(self, before: ReviewState, after: ReviewState, only: ErrorFilter | None = None) -> Changes:
        """What changes from one state to another of the same drive: a corruption, a method, cooperation.

        Args:
            before: first state.
            after: second state, whose threshold and IoU count.
            only: objects to look at; None for all.

        Raises:
            SettingsError: a state has no detections.
        """
        return changes(self._judged_run(before), self._judged_run(after), after.threshold, after.iou, only)

    def _judged_run(self, state: ReviewState) -> JudgedRun:
        method = self.method(state)
        if not method:
            raise SettingsError(complaint(self.names[state.drive], "methods", "a set of detections", "none"))
        return self._run(state.drive, method, self.setup(state))

    def _run(self, drive: int, method: str, setup: Setup) -> JudgedRun:
        """Judged run of a method, as far as its detections are known."""
        own = self.sources[drive].sets[method]
        rows = own.rows(setup)
        ends = (int(rows[0]), int(rows[-1])) if len(rows) else (0, 0)
        key = (drive, method, setup, len(rows), *ends)
        return self._runs.get(key, lambda: JudgedRun(method, setup, own.run(setup)))

    def _asked(self, state: ReviewState) -> list[str]:
        """Sets of detections under a state, the judged one first.

        Raises:
            SettingsError: a name is unknown.
        """
        known = self.sources[state.drive].sets
        for name in state.methods:
            if name not in known:
                hint = did_you_mean(name, known)
                raise SettingsError(complaint(self.names[state.drive], "methods", "a set of detections", name, hint))
        return list(dict.fromkeys(state.methods)) or list(known)[:1]

    def _absent(self, state: ReviewState, frame: Frame) -> str:
        """Why a corruption changes nothing: whom it is of is not here."""
        condition = self.setup(state).condition
        if present_agents(frame, condition.who):
            return ""
        return f"{condition_title(condition)}: no such agent in this frame, its sweeps are as recorded."

    def _notice(self, state: ReviewState, method: str) -> str:
        """Explanation of missing detections."""
        if not method:
            return ""
        condition = self.setup(state).condition
        title = condition_title(condition)
        known = self.sources[state.drive].sets[method].conditions()
        if known is not None and condition not in known:
            return f"{method} has no detections in {title}; it has them in {', '.join(map(condition_title, known))}."
        return f"{method} has no detections in this frame of this ego in {title}."

    def _seen(self, state: ReviewState) -> tuple[Counts, int]:
        """Sum the counts of the frames with known detections under these settings."""
        method = self.method(state)
        rows = self.sources[state.drive].sets[method].rows(self.setup(state)).tolist()
        known = [self._detections(replace(state, frame=row), method) for row in rows]
        counts = (found.at(state.iou).counts(state.threshold) for found in known if found is not None)
        return sum(counts, Counts()), len(known)

    def _detections(self, state: ReviewState, method: str) -> _FrameDetections | None:
        """Detections of a set in a frame, computed where they can be; None where they are unknown."""
        own, setup = self.sources[state.drive].sets[method], self.setup(state)
        key: Hashable = (state.drive, state.frame, method, setup)
        if key in self._judged:
            return self._judged.get(key, _unexpected)
        table = self._table(own, state, setup)
        if table is None:
            return None
        (result,) = table.results()
        return self._judged.get(key, lambda: _FrameDetections(result.detections, result.truth, int(table.ego_id[0])))

    def _table(self, own: DetectionSet, state: ReviewState, setup: Setup) -> DetectionTable | None:
        table = own.get(state.frame, setup)
        if table is not None or not isinstance(own, ComputedSet):
            return table
        clean = self.stores[state.drive].recorded(state.frame)
        return own.compute(state.frame, clean, self._frame(state), setup)

    def _frame(self, state: ReviewState) -> Frame:
        setup = self.setup(state)
        return self.stores[state.drive].corrupted(state.frame, setup.condition, setup.ego_id)


def _no_boxes() -> dict[str, Boxes]:
    return {name: Boxes.zeros() for name in LAYERS}


def _unexpected() -> _FrameDetections:
    raise KeyError("dropped by another thread")


def open_model(root: Path, checkpoint: Path | None = None, data: Path | None = None) -> ReviewModel:
    """Open what a path holds, see `open_sources`, and a detector.

    Args:
        root: drives, results of an evaluation or benchmark, a training, or episode logs.
        checkpoint: detector file; None for none.
        data: where the drives of results or of a training are now; None for where they were.

    Raises:
        DataError: the path holds nothing of these, or something in it is damaged or of other data.
        CheckpointError: the checkpoint cannot be loaded.
    """
    root = Path(root)
    sources = open_sources(root, data)
    add_detectors(sources, [] if checkpoint is None else [str(checkpoint)])
    # Notes lie beside what they are about; a split of DAIR-V2X-C is no folder.
    notes = NoteBook(root if root.is_dir() else root.with_name(f"{root.name}.notes.json"))
    return ReviewModel(sources, notes=notes)
