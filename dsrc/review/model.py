"""ReviewModel: a state to drawn arrays, with caches."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from dsrc.data.drives import Drive
from dsrc.data.sample import SampleDetector
from dsrc.options.review import ColorBy
from dsrc.review.agents import agent_view, help_view, links, with_shares
from dsrc.review.details import detection_details, object_details, verdict_on
from dsrc.review.errors.judged import JudgedRun
from dsrc.review.errors.judgements import Judgements
from dsrc.review.errors.notes import NoteBook
from dsrc.review.frames import LatestUsed
from dsrc.review.sources.base import Source
from dsrc.review.sources.moment import unseen_places
from dsrc.review.sources.opening import add_detectors, open_sources
from dsrc.review.sources.results import SharedSource
from dsrc.review.state import ReviewState
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
from sim.geometry import invert, transform_points

_VIEWS_KEPT = 4


class ReviewModel(Judgements):
    """What a page shows of its sources under a state; one thread at a time, beside a `Worker` on its stores.

    Attributes:
        notes: on the errors, None where they cannot be kept.
        start: what a page shows without a link.
    """

    def __init__(
        self,
        sources: Sequence[Source | Drive],
        detector: SampleDetector | None = None,
        notes: NoteBook | None = None,
    ) -> None:
        """Open a page on sources or drives; `open_model` takes paths.

        Args:
            detector: gives all sources a set named `detector`.

        Raises:
            DataError: the list or a drive is empty.
        """
        super().__init__(sources, detector)
        self.notes, self.start = notes, ReviewState()
        self._agents: LatestUsed[tuple[AgentView, ...]] = LatestUsed(_VIEWS_KEPT)

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
        state = replace(state, color_by=self._meaning(state))
        recorded, frame = self.stores[state.drive].recorded(state.frame), self.frame(state)
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
            state=state,
            labelled=self.sources[state.drive].labelled,
            details=object_details(frame, recorded, state.object_id, ego_id, [agent.title for agent in agents]),
        )
        source = self.sources[state.drive]
        if (moment := source.moment(state.frame)) is not None:
            moment = moment.moved(review_from_world[:3, 3])
            if "seen" not in state.layers_off:
                moment = replace(moment, unseen=unseen_places(frame.agents, ego_id))
        view = replace(view, moment=moment, notice=self._absent(state, frame) or source.note)
        found = self._detections(state, method) if method else None
        if found is None:
            evaluated = truth.is_vehicle & (frame.points_on.sum(axis=0) > 0) & (truth.object_id != ego_id)
            layers = {**view.layers, DETECTED_TRUTH: truth[evaluated], OTHER_TRUTH: truth[~evaluated]}
            return replace(view, layers=layers, method=method, notice=self._notice(state, method) or view.notice)
        view = self._with_detections(view, state, frame, review_from_world, found)
        compared = [self._compared(state, name, frame, review_from_world) for name in self._asked(state)[1:]]
        return replace(view, method=method, compared=tuple(one for one in compared if one is not None))

    def _meaning(self, state: ReviewState) -> ColorBy:
        """What colour means under a state: that of points or that of boxes, never both."""
        judged = bool(self.method(state)) and self.sources[state.drive].labelled
        helps = state.boxes_by == "shares" and self.has_shares(state.drive)
        return "agent" if state.color_by == "verdict" and (helps or not judged) else state.color_by

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
        look = state.hidden, state.color_by, state.theme, state.max_points
        version = self.sources[state.drive].version
        key = state.drive, version, state.frame, self.setup(state), ego_id, *look
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
        found: JudgedRun,
    ) -> FrameView:
        kept = found.kept(state.threshold)
        review_from_lidar = review_from_world @ frame.agent(int(found.table.ego_id[0])).sweep.world_from_lidar
        boxes = found.boxes[:kept].transform(review_from_lidar)
        rank = np.arange(kept)
        if state.detection is not None and state.detection < kept:
            titles = [agent.title for agent in view.agents]
            details = detection_details(frame, state.detection, found, state.iou, titles, view.labelled)
            selected = boxes[state.detection : state.detection + 1]
            view = replace(view, details=details, layers={**view.layers, SELECTED: selected})
        elif isinstance(view.details, ObjectDetails) and view.labelled:
            verdict, score, iou = verdict_on(view.details.object_id, found, state.threshold, state.iou)
            view = replace(view, details=replace(view.details, verdict=verdict, score=score, iou=iou))
        if isinstance(view.details, DetectionDetails) or getattr(view.details, "verdict", "") == "missed":
            why = self.cause(state)
            said = "" if why is None else f"{why.kind}: {why.sentence}"
            view = replace(view, details=replace(view.details, cause=said))  # type: ignore[type-var]
        if not view.labelled:
            return replace(view, detected=kept, layers={**view.layers, UNJUDGED: boxes}, ranks={UNJUDGED: rank})
        tp = found.at(state.iou).matched[:kept] >= 0
        # Boxes are drawn from the frame; the ego's sample only says which of them are detected.
        ids = found.table.object_id
        found_ids = ids[found.found(state.threshold, state.iou)]
        evaluated = np.isin(view.truth.object_id, ids)
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
            counts=found.counts(state.threshold, state.iou),
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
        review_from_lidar = review_from_world @ frame.agent(int(found.table.ego_id[0])).sweep.world_from_lidar
        kept = found.kept(state.threshold)
        boxes = found.boxes[:kept].transform(review_from_lidar)
        missed = found.truth[~found.found(state.threshold, state.iou)].transform(review_from_lidar)
        if not self.sources[state.drive].labelled:
            return MethodView(name, Boxes.zeros(), boxes, Boxes.zeros(), None)
        tp = found.at(state.iou).matched[:kept] >= 0
        return MethodView(name, boxes[tp], boxes[~tp], missed, found.counts(state.threshold, state.iou))


def _no_boxes() -> dict[str, Boxes]:
    return {name: Boxes.zeros() for name in LAYERS}


def open_model(
    root: Path,
    checkpoint: Path | str | None = None,
    data: Path | None = None,
    engine: str = "auto",
    height: str = "recorded",
    late: bool = False,
) -> ReviewModel:
    """Open what a path holds, see `open_sources`, and a detector.

    Args:
        root: drives, results of an evaluation or benchmark, a training, or episode logs.
        data: where the drives of results or of a training are now; None for where they were.
        engine: execution of the network, `auto` or a key of `dsrc.models.storage.deploy.ENGINES`.
        height: ground under the clouds that the detector gets, see `dsrc.detectors.levelled`.
        late: open the detector once it is asked, or by `dsrc.review.sources.opening.open_late`.

    Raises:
        DataError: the path holds nothing of these, or something in it is damaged or of other data.
        CheckpointError: the checkpoint cannot be loaded.
    """
    root = Path(root)
    sources = open_sources(root, data, engine)
    add_detectors(sources, [] if checkpoint is None else [str(checkpoint)], engine, height, late)
    # Notes lie beside what they are about; a split of DAIR-V2X-C is no folder.
    notes = NoteBook(root if root.is_dir() else root.with_name(f"{root.name}.notes.json"))
    return ReviewModel(sources, notes=notes)
