"""Judgements: detections of the sources of a page, compared with ground truth under a state, with caches."""

from collections.abc import Hashable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from dsrc.data.drives import Drive
from dsrc.data.sample import SampleDetector
from dsrc.evaluation.causes.cause import Circumstances, ErrorCause, frame_causes
from dsrc.evaluation.detection_table import DetectionTable
from dsrc.faults.condition import faults_of
from dsrc.review.errors.filters import ErrorFilter
from dsrc.review.errors.index import ErrorIndex, changes
from dsrc.review.errors.judged import Counts, JudgedRun
from dsrc.review.frames import LatestUsed, Recordings
from dsrc.review.sources.base import DriveSource, MemorySet, Setup, Source
from dsrc.review.sources.detected import ComputedSet
from dsrc.review.state import ReviewState
from sensors.corruptions import CLEAN, drive_seed
from sensors.frame import Frame
from sim.errors import SettingsError, complaint, did_you_mean

if TYPE_CHECKING:
    from dsrc.messages.attacks import Lie

DETECTOR = "detector"
"""Name of the set of a detector without one."""

_DETECTIONS_KEPT = 4096
_RUNS_KEPT = 64
_PICTURES_KEPT = 200


class Judgements(Recordings):
    """Detections of the sources, judged.

    Attributes:
        drawn: pictures of errors, by all that they show: kind of the cause, sentence, SVG.
    """

    def __init__(self, sources: Sequence[Source | Drive], detector: SampleDetector | None = None) -> None:
        super().__init__(sources)
        if detector is not None:
            for source in self.sources:
                source.sets[DETECTOR] = ComputedSet(DETECTOR, detector)
        self._judged: LatestUsed[JudgedRun] = LatestUsed(_DETECTIONS_KEPT)
        self._runs: LatestUsed[JudgedRun] = LatestUsed(_RUNS_KEPT)
        self.drawn: LatestUsed[tuple[str, str, str]] = LatestUsed(_PICTURES_KEPT)

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

    def causes(self, state: ReviewState) -> list[ErrorCause]:
        """Causes of the judged method's errors in a frame; empty where nothing is judged, or no agent has a point."""
        method, setup = self.method(state), self.setup(state)
        if not method or not self.sources[state.drive].labelled:
            return []
        own, clean = self.sources[state.drive].sets[method], self.stores[state.drive].recorded(state.frame)
        table = self._table(own, state, setup)
        if table is None or not clean.points_on.any():
            return []
        source, ego_id, corrupted = self.sources[state.drive], int(table.ego_id[0]), self.frame(state)
        team, range_m = own.team(clean, ego_id, setup)
        told: dict[int, Lie] = {}
        if (
            isinstance(source, DriveSource)
            and team != (ego_id,)
            and any(one.attack for one in faults_of(setup.condition))
        ):
            from dsrc.evaluation.listener import lies_in, misplaced  # torch comes with it: not before it is needed

            # In an episode a liar knows the ego's route, and its ghost waits: no frame tells where.
            seed, others = drive_seed(source.seed, source.name), team or [one.agent_id for one in clean.agents]
            told = lies_in(clean, setup.condition, seed, [one for one in others if one != ego_id], {})
            corrupted = misplaced(corrupted, setup.condition, seed)
        known = Circumstances(
            condition=setup.condition.label if setup.condition.kind != CLEAN else "",
            corrupted=corrupted,
            team=team,
            range_m=range_m,
            lies=told,
        )
        return frame_causes(table, clean, state.threshold, state.iou, known)

    def cause(self, state: ReviewState) -> ErrorCause | None:
        """Cause of the selected error; None where none is selected."""
        error, chosen = ("missed", state.object_id) if state.detection is None else ("false", state.detection)
        for one in self.causes(state):
            if one.error == error and chosen == (one.object_id if error == "missed" else one.rank):
                return one
        return None

    def index(self, state: ReviewState) -> ErrorIndex:
        """Errors of the run under a state, of all its methods, in the frames whose detections are known."""
        return ErrorIndex([self.run(state.drive, name, self.setup(state)) for name in self._asked(state)])

    def changes(
        self, before: ReviewState, after: ReviewState, only: ErrorFilter | None = None
    ) -> tuple[set[tuple[int, int]], set[tuple[int, int]]]:
        """What only one of two states of a drive finds, another corruption, method or cooperation, see `changes`.

        Args:
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
        return self.run(state.drive, method, self.setup(state))

    def run(self, drive: int, method: str, setup: Setup) -> JudgedRun:
        """Judged run of a method, as far as its detections are known."""
        own = self.sources[drive].sets[method]
        if own.recorded:
            # It has its own cooperation, whatever is asked for.
            setup = replace(setup, cooperative=True)
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
        if condition.among([agent.agent_id for agent in frame.agents]).kind == condition.kind:
            return ""
        return f"{condition.label}: no such agent in this frame, its sweeps are as recorded."

    def _notice(self, state: ReviewState, method: str) -> str:
        if not method:
            return ""
        condition = self.setup(state).condition
        title = condition.label
        known = self.sources[state.drive].sets[method].conditions()
        if known is not None and condition not in known:
            return f"{method} has no detections in {title}; it has them in {', '.join(one.label for one in known)}."
        return f"{method} has no detections in this frame of this ego in {title}."

    def _seen(self, state: ReviewState) -> tuple[Counts, int]:
        """Sum the counts of the frames with known detections under these settings."""
        method = self.method(state)
        rows = self.sources[state.drive].sets[method].rows(self.setup(state)).tolist()
        known = [self._detections(replace(state, frame=row), method) for row in rows]
        counts = (found.counts(state.threshold, state.iou) for found in known if found is not None)
        return sum(counts, Counts()), len(known)

    def _detections(self, state: ReviewState, method: str) -> JudgedRun | None:
        """Detections of a set in a frame, computed where they can be; None where they are unknown."""
        own, setup = self.sources[state.drive].sets[method], self.setup(state)
        key: Hashable = (state.drive, state.frame, method, setup)
        if (known := self._judged.find(key)) is not None:
            return known
        table = self._table(own, state, setup)
        if table is None:
            return None
        return self._judged.get(key, lambda: JudgedRun(method, setup, table))

    def _table(self, own: MemorySet, state: ReviewState, setup: Setup) -> DetectionTable | None:
        table = own.get(state.frame, setup)
        if table is not None or not isinstance(own, ComputedSet):
            return table
        clean = self.stores[state.drive].recorded(state.frame)
        return own.compute(state.frame, clean, self.frame(state), setup)
