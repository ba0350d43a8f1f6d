"""Overview: what a run lost, as a table whose cells are links: methods by condition, or outcomes by fault."""

import math
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from dsrc.evaluation.metrics.ap import curve_of
from dsrc.review.errors.filters import FN, FP, KINDS
from dsrc.review.errors.index import ErrorIndex
from dsrc.review.errors.judgements import Judgements
from dsrc.review.errors.report import selection_of
from dsrc.review.frames import Pieces
from dsrc.review.state import ReviewState
from sensors.corruptions import CLEAN, Condition
from sim.errors import UserError

_PATIENCE_S = 2.0
"""Age up to which a table may lack frames that became known since, s."""


class Cell(NamedTuple):
    """Text of a table, and the state that a click on it opens; None for text alone."""

    text: str
    opens: ReviewState | None = None


@dataclass(frozen=True, slots=True)
class Overview:
    """What a run is, lacks and lost.

    Attributes:
        says: lines above the table.
        head: columns of the table.
        rows: what lost most first; a row's first cell has its name.
        whole: whether nothing more is to be computed.
    """

    says: tuple[str, ...]
    head: tuple[str, ...] = ()
    rows: tuple[tuple[Cell, ...], ...] = ()
    whole: bool = True


@dataclass(frozen=True, slots=True)
class _Judged:
    """A method under a condition in all drives; `worst` has the state of the worst error of each kind."""

    method: str
    condition: Condition
    ap: float
    missed: int
    false: int
    frames: dict[int, int]
    """Frames with detections, by drive."""
    worst: dict[str, Cell]
    opens: ReviewState


class Overviews:
    """Overview of a page's run, computed cell by cell; one thread at a time."""

    def __init__(self, model: Judgements) -> None:
        self._model = model
        self._key: tuple[object, ...] = ()
        self._found, self._judged_at = Overview(()), 0.0
        self._cells = Pieces[_Judged | str]()

    def of(self, state: ReviewState, patience_s: float = 0.2) -> Overview:
        """Return the overview under a state's threshold and IoU, as far as it is computed within some seconds."""
        model = self._model
        if all(source.kind == "episode" for source in model.sources):
            return _of_episodes(model, state)
        frames = sum(len(model.sources[drive]) for drive in range(len(model.sources)))
        run = f"{_count(len(model.sources), 'drive')}, {_count(frames, 'frame')}"
        if not model.has_detector:
            return Overview((f"{run}. No detections: nothing is judged. A detector is given as --checkpoint.",))
        if not any(model.sources[drive].labelled for drive in range(len(model.sources))):
            return Overview((f"{run}. No labels: detections are shown, and nothing is judged.",))
        known = sum(len(own.rows(model.setup(state))) for source in model.sources for own in source.sets.values())
        key = (state.threshold, state.iou, state.ego_id, state.cooperative, model.setup(state), known)
        if key != self._key:
            if key[:-1] == self._key[:-1] and time.monotonic() < self._judged_at + _PATIENCE_S:
                return replace(self._found, whole=False)
            self._key, self._judged_at = key, time.monotonic()
        cells, whole = self._cells.of(key, partial(_judged, model, state), patience_s)
        table = _table([one for one in cells if isinstance(one, _Judged)], state, frames, run, whole)
        self._found = replace(table, says=(*table.says, *(one for one in cells if isinstance(one, str))))
        return self._found


def _count(number: int, name: str) -> str:
    return f"{number} {name}{'' if number == 1 else 's'}"


def _judged(model: Judgements, state: ReviewState) -> Iterator[_Judged | str]:
    """Judge every method under every condition that has detections, or say why one cannot be."""
    conditions: dict[tuple[str, Condition], None] = {}
    for source in model.sources:
        for name, own in source.sets.items():
            for condition in own.conditions() or (Condition(), model.setup(state).condition):
                conditions[name, condition] = None
    for name, condition in conditions:
        try:
            cell = _cell(model, state, name, condition)
        except UserError as error:
            yield str(error)
            continue
        if any(cell.frames.values()):
            yield cell


def _cell(model: Judgements, state: ReviewState, method: str, condition: Condition) -> _Judged:
    here = replace(
        state, corruption=condition.kind, severity=condition.severity or state.severity, family=condition.family,
        corrupted_agents=condition.agents_text, parameters=condition.settings, methods=(method,), object_id=None,
        detection=None, listed="all", versus="", error_method="", camera="free",
    )  # fmt: skip
    hits, scores, truths, counts = [np.zeros(0, bool)], [np.zeros(0, np.float32)], 0, Counter[int]()
    frames: dict[int, int] = {}
    worst: dict[str, Cell] = {}
    loss: dict[str, float] = {}
    for drive, source in enumerate(model.sources):
        if method not in source.sets or not model.sources[drive].labelled:
            continue
        at = replace(here, drive=drive, ego_id=state.ego_id if drive == state.drive else None)
        run = model.run(drive, method, model.setup(at))
        hit, score, truth = run.ranked(state.iou)
        hits, scores, truths, frames[drive] = [*hits, hit], [*scores, score], truths + truth, len(run.table)
        errors = ErrorIndex([run]).errors(state.threshold, state.iou)
        for kind in (FN, FP):
            rows = np.flatnonzero(errors.kind == kind)
            counts[kind] += len(rows)
            name = KINDS[kind]
            if len(rows) and errors.loss[rows[0]] > loss.get(name, 0.0):
                row, loss[name] = int(rows[0]), float(errors.loss[rows[0]])
                shown = selection_of(errors, row) | {"listed": name}
                worst[name] = Cell(name, replace(at, **shown))
    ap = curve_of(np.concatenate(hits), np.concatenate(scores), truths).ap
    worst["any"] = worst[max(loss, key=lambda name: loss[name])] if loss else Cell("none")
    return _Judged(method, condition, ap, counts[FN], counts[FP], frames, worst, here)


def _table(done: list[_Judged], state: ReviewState, frames: int, run: str, whole: bool) -> Overview:
    """Table of what is judged, by what was lost against the same method on clean sweeps, else against the first."""
    several = len({one.method for one in done}) > 1
    clean = {one.method: one for one in done if one.condition.kind == CLEAN}
    conditions = {one.condition for one in done}
    most = Counter[int]()
    for one in done:
        most |= Counter(one.frames)
    judged = most.total()

    def lost(one: _Judged) -> float:
        """Average precision lost; NaN for what others are measured by."""
        # Of other drives a number says nothing about this one.
        alike = (other for other in done if other.frames.keys() == one.frames.keys())
        before = clean.get(one.method) if one.condition.kind != CLEAN else next(alike)
        return math.nan if before is None or before is one else before.ap - one.ap

    order = sorted(done, key=lambda one: -math.inf if math.isnan(lost(one)) else lost(one), reverse=True)
    rows: list[tuple[Cell, ...]] = []
    for one in order:
        own, whole_drives = sum(one.frames.values()), sum(most[drive] for drive in one.frames)
        part = "" if own == whole_drives else f", {own} of {whole_drives} frames"
        # Where there is one condition, its name says nothing.
        words = [one.condition.label] if len(conditions) > 1 or not several else []
        name = " · ".join([*words, *([one.method] if several else [])]) + part
        row = [Cell(name, one.worst["any"].opens or one.opens)]
        row.append(Cell("–" if math.isnan(one.ap) else f"{100 * one.ap:.0f}"))
        row.append(Cell("" if math.isnan(lost(one)) else f"{100 * lost(one):.0f}"))
        for kind, count in (("missed", one.missed), ("false", one.false)):
            row.append(one.worst.get(kind, Cell(""))._replace(text=str(count)))
        rows.append((*row, *([] if several else [one.worst["any"]])))
    run = run if judged in (0, frames) else f"{run}, {judged} of them judged"
    says = [
        f"{run}. Score ≥ {state.threshold:g}, IoU ≥ {state.iou:g}. A name or a number opens the worst of its errors."
    ]
    if not whole:
        says.append("judging …")
    elif not done:
        says = [f"{run}. Nothing is detected so far."]
    elif not any(one.missed or one.false for one in done):
        says.append("No errors: all objects are found, and nothing else.")
    head: tuple[str, ...] = ("", f"AP{100 * state.iou:.0f}", "lost", "missed", "false")
    head += () if several else ("worst",)
    return Overview(tuple(says), head, tuple(rows), whole)


def _of_episodes(model: Judgements, state: ReviewState) -> Overview:
    """Outcomes by fault: how many episodes, and the hardest one of each."""
    here = replace(state, methods=(), object_id=None, detection=None, versus="", error_method="", ego_id=None)
    cells: dict[tuple[str, str], list[tuple[float, ReviewState]]] = {}
    for drive, source in enumerate(model.sources):
        line = model.sources[drive].timeline()
        if line is None or not len(line.time_s):
            continue
        hit = line.contact_row
        hard = float(-line.wanted_mps2.min()) if hit is None else line.closing_mps
        hardest = int(np.argmin(line.wanted_mps2)) if hit is None else hit
        at = replace(here, drive=drive, **model.opening(drive) | {"frame": hardest})
        cells.setdefault((source.fault, line.outcome), []).append((hard, at))
    outcomes = sorted({outcome for _, outcome in cells}, key=lambda name: (name != "crashed", name))

    def crashed(fault: str) -> tuple[int, str]:
        return -len(cells.get((fault, "crashed"), ())), fault

    rows = []
    for fault in sorted({fault for fault, _ in cells}, key=crashed):
        row = [Cell(fault)]
        for outcome in outcomes:
            found = cells.get((fault, outcome), [])
            row.append(Cell(str(len(found)), max(found, key=lambda one: one[0])[1] if found else None))
        rows.append(tuple(row))
    says = [f"{_count(len(model.sources), 'episode')}. A number opens the fastest contact, or the hardest braking."]
    if outcomes and "crashed" not in outcomes:
        says.append("No crashes.")
    return Overview(tuple(says), ("", *outcomes), tuple(rows))
