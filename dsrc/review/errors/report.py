"""RunReport: the errors of a whole run that a page lists, its counts, curves and worst frames under a state."""

import time
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from dsrc.evaluation.metrics.ap import Curve
from dsrc.review.errors.filters import ANY, FP, KINDS, ErrorFilter, Span
from dsrc.review.errors.index import ErrorTable, FrameRanking, worst_frames
from dsrc.review.errors.judged import Counts
from dsrc.review.errors.judgements import Judgements
from dsrc.review.sources.base import Setup
from dsrc.review.sources.detected import ComputedSet
from dsrc.review.state import IOU_THRESHOLDS, METHOD, Band, ReviewState, other_run
from sensors.corruptions import CLEAN
from sim.boxes import Boxes
from sim.errors import SettingsError, complaint

BROKEN, FIXED = "broken", "fixed"
_REPORTS_KEPT = 6
BANDS: tuple[Band, ...] = get_args(Band)


@dataclass(frozen=True, slots=True, eq=False)
class RunReport:
    """Errors and scores of a run under a state.

    Attributes:
        errors: that are listed, the worst first.
        curves: precision over recall of each method at each of `IOU_THRESHOLDS`, among the filtered objects.
        counts: of each method at the threshold and IoU of the state, among the filtered objects.
        frames: the worst frames first, by the errors of the judged method that pass the filter.
        known: frames with known detections of the judged method.
        total: frames of the run.
        versus: title of the run that tells what is broken and fixed, "" without one.
    """

    errors: ErrorTable
    curves: dict[tuple[str, float], Curve]
    counts: dict[str, Counts]
    frames: FrameRanking
    known: int
    total: int
    versus: str


def filter_of(state: ReviewState) -> ErrorFilter:
    """Filter of a state, of all kinds of errors."""
    low, _, high = state.error_range.partition("-")
    return ErrorFilter(
        methods=(state.error_method,) if state.error_method else (),
        distance_m=ANY if state.error_range == "any" else Span(float(low), float(high)),
        classes=(state.error_class,) if state.error_class else (),
        seen_by=(state.error_seen_by,) if state.error_seen_by else (),
    )


def versus_options(model: Judgements, state: ReviewState) -> dict[str, str]:
    """Runs that a state can be compared with: displayed names and values of `ReviewState.versus`."""
    own, sets = model.method(state), model.sources[state.drive].sets
    options = {"clean" if state.corruption != CLEAN else "none": ""}
    if state.cooperative and own and not sets[own].recorded:
        options["ego alone"] = "alone"
    return options | {name: f"{METHOD}{name}" for name in sets if name != own}


def listed_errors(model: Judgements, state: ReviewState) -> ErrorTable:
    """Errors that a state lists, the worst first.

    What is broken is missed by the run of the state and found by the other; what is fixed is missed by the other.

    Raises:
        SettingsError: a method is unknown, or what is broken or fixed is asked without another run.
    """
    only = filter_of(state)
    if state.listed not in (BROKEN, FIXED):
        kinds = KINDS if state.listed == "all" else (state.listed,)
        return model.index(state).errors(state.threshold, state.iou, replace(only, kinds=kinds))
    before = other_run(state)
    if before is None:
        raise SettingsError(complaint("errors", "against", f"another run, for what is {state.listed} by this", "none"))
    state, before = (replace(one, methods=(model.method(one),)) for one in (state, before))
    only = replace(only, methods=())
    broken, fixed = model.changes(before, state, only)
    of, pairs = (state, broken) if state.listed == BROKEN else (before, fixed)
    missed = model.index(of).errors(state.threshold, state.iou, replace(only, kinds=("missed",)))
    keys = zip(missed.row.tolist(), missed.object_id.tolist(), strict=True)
    return missed[np.array([key in pairs for key in keys], bool)]


def run_report(model: Judgements, state: ReviewState) -> RunReport:
    """Report of the run under a state, as far as its detections are known.

    Raises:
        SettingsError: a method is unknown, or what is broken or fixed is asked without another run.
    """
    index, only, method = model.index(state), filter_of(state), model.method(state)
    curves = {(name, iou): curve for iou in IOU_THRESHOLDS for name, curve in index.curves(iou, only).items()}
    rows = np.asarray(index.runs[method].table.position, np.int64)
    before, versus = other_run(state), ""
    if before is not None:
        shown = "the ego alone" if before.cooperative != state.cooperative else model.method(before)
        versus = CLEAN if before.corruption != state.corruption else shown
    return RunReport(
        errors=listed_errors(model, state),
        curves=curves,
        counts=index.counts(state.threshold, state.iou, only),
        frames=worst_frames(index.errors(state.threshold, state.iou, replace(only, methods=(method,))), rows),
        known=len(model.sources[state.drive].sets[method].rows(model.setup(state))),
        total=len(model.sources[state.drive]),
        versus=versus,
    )


def selection_of(errors: ErrorTable, row: int) -> dict[str, Any]:
    """Fields of the state that show an error: its frame, and the object or the false detection."""
    false = errors.kind[row] == FP
    return {
        "frame": int(errors.row[row]),
        "object_id": None if false else int(errors.object_id[row]),
        "detection": int(errors.rank[row]) if false else None,
    }


def shown_error(errors: ErrorTable, state: ReviewState) -> int:
    """Row of the error that a state shows, -1 for none."""
    here = errors.row == state.frame
    if state.detection is not None:
        here &= (errors.kind == FP) & (errors.rank == state.detection)
    elif state.object_id is not None:
        here &= (errors.kind != FP) & (errors.object_id == state.object_id)
    else:
        return -1
    found = np.flatnonzero(here)
    return int(found[0]) if len(found) else -1


def place_of(model: Judgements, drive: int, errors: ErrorTable, row: int) -> NDArray[np.float64]:
    """(3,) centre of an error in the review frame; raises DataError where its frame is damaged."""
    frame = model.stores[drive].recorded(int(errors.row[row]))
    ego = int(errors.ego_id[row])
    lidar = (frame.agent(ego) if ego in [a.agent_id for a in frame.agents] else frame.agents[0]).sweep.world_from_lidar
    box = Boxes.from_array(errors.box[row : row + 1].astype(np.float64))
    return box.transform(lidar).center[0] - model.origin(drive)


def curve_on_grid(curve: Curve, recall: NDArray[np.float64]) -> NDArray[np.float64]:
    """(R,) precision at recalls: the best at this recall or a higher one, NaN beyond the last."""
    if not len(curve.recall):
        return np.full(len(recall), np.nan)
    best = np.maximum.accumulate(curve.precision[::-1])[::-1]
    at = np.searchsorted(curve.recall, recall)
    return np.where(at < len(best), np.append(best, np.nan)[np.minimum(at, len(best))], np.nan)


def _asked(model: Judgements, state: ReviewState) -> list[tuple[str, Setup]]:
    """Sets and setups that the report of a state is of: all that are shown, and the first of the other run."""
    before = other_run(state)
    asked = [(name, model.setup(state)) for name in state.methods or (model.method(state),)]
    asked += [(model.method(before), model.setup(before))] if before is not None else []
    return list(dict.fromkeys(asked))


def to_detect(model: Judgements, state: ReviewState) -> list[tuple[str, Setup]]:
    """Computed sets and setups that the report of a state needs and that lack frames."""
    sets, total = model.sources[state.drive].sets, len(model.sources[state.drive])
    return [
        (name, setup)
        for name, setup in _asked(model, state)
        if isinstance(sets.get(name), ComputedSet) and len(sets[name].rows(setup)) < total
    ]


def first_unknown(model: Judgements, state: ReviewState, step: int) -> int | None:
    """First frame from a state's on in a direction whose detections can be computed and are not; None without one."""
    count = len(model.sources[state.drive])
    ahead = range(state.frame, count) if step > 0 else range(state.frame, -1, -1)
    unknown = set(ahead)
    missing = to_detect(model, state)
    known = [set(model.sources[state.drive].sets[name].rows(setup).tolist()) for name, setup in missing]
    gaps = unknown - set.intersection(*known) if known else set()
    return next((row for row in ahead if row in gaps), None)


_FIELDS = (
    *"drive ego_id cooperative methods corruption severity family parameters corrupted_agents".split(),
    *"threshold iou listed versus error_method error_class error_range error_seen_by".split(),
)


class Reports:
    """Reports of a page, the latest kept; one thread at a time."""

    def __init__(self, model: Judgements) -> None:
        self._model = model
        self._known: dict[tuple[Any, ...], tuple[tuple[int, ...], float, RunReport]] = {}

    def of(self, state: ReviewState, patience_s: float = 0.0) -> RunReport:
        """Return the report of a state; raises as `report`.

        Args:
            patience_s: age up to which a report may lack frames that became known since.
        """
        key = tuple(getattr(state, name) for name in _FIELDS)
        sets = self._model.sources[state.drive].sets
        counts = tuple(len(sets[name].rows(setup)) for name, setup in _asked(self._model, state))
        kept = self._known.get(key)
        if kept is not None and (kept[0] == counts or time.monotonic() < kept[1] + patience_s):
            return kept[2]
        made = run_report(self._model, state)
        self._known[key] = counts, time.monotonic(), made
        while len(self._known) > _REPORTS_KEPT:
            del self._known[next(iter(self._known))]
        return made
