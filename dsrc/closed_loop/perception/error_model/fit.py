"""Fit of an error model to recorded percepts: counts and moments, cell by cell, and what pools them where they lack."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.special import ndtri

from dsrc.closed_loop.metrics.statistics import rate
from dsrc.closed_loop.perception.error_model.model import (
    PARTS,
    QUANTILES,
    BoxErrors,
    Cell,
    Chain,
    Chance,
    Doubles,
    Errors,
    Ghosts,
    Wider,
)
from dsrc.closed_loop.perception.error_model.percepts import MATCH_M, Observed
from dsrc.closed_loop.perception.error_model.sight import (
    BANDS,
    CLASSES_OF,
    KIND_OF_LABEL,
    KINDS,
    SIGHTS,
    bands_of,
    ego_frame,
    quarters_of,
    within,
)
from sim.geometry import wrap_angle

LEAST = 20
"""Observations from which on a number is that of its own group."""
EXAMPLES = 200
"""Most ghosts, and second boxes, that a model keeps."""
FINDS = 0.05
"""Share of the clear views of a kind from which on a perception is one that finds it."""

_MOST_CORRELATED = 0.999
_STEP_S = 1e-3

Mask = NDArray[np.bool_]
Groups = Sequence[tuple[Wider, Mask]]


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """R objects of percepts, one row each.

    Attributes:
        kind, sight, band: (R,) rows of `KINDS`, `SIGHTS` and of the ranges.
        hit: (R,) whether it was found.
        before: (R,) row of the same object in the percept before, -1 without one.
        error: (R, 8) of `PARTS`, the score itself; NaN where it was not found.
        flipped: (R,) whether the box points backwards.
        crossed: (R,) whether the box lies across its object.
        quarter: (R,) heading of the object, quarter turns from the ego's.
        second: (R, 8) error of `PARTS` of a second box; NaN without one.
    """

    kind: NDArray[np.int64]
    sight: NDArray[np.int64]
    band: NDArray[np.int64]
    hit: Mask
    before: NDArray[np.int64]
    error: NDArray[np.float64]
    flipped: Mask
    crossed: Mask
    quarter: NDArray[np.int64]
    second: NDArray[np.float64]


def fit_errors(sequences: Iterable[Sequence[Observed]], interval_s: float, **condition: Any) -> Errors:
    """Return the errors of a perception under one condition.

    Args:
        sequences: percepts of each episode or drive, in order of time.
        interval_s: time between two percepts that follow each other, s.
        condition: corruption, severity, family, who and channel, see `Errors`.
    """
    known = [list(sequence) for sequence in sequences]
    area = _area(known)
    table, places = _table(known, area, interval_s)
    cells, marks = [], np.zeros_like(table.error)
    any_row, lies_across = np.ones(len(table.hit), bool), table.quarter % 2 == 1
    doubled = ~np.isnan(table.second[:, 7])
    names = product(enumerate(KINDS), enumerate(SIGHTS), (False, True), enumerate(BANDS))
    for (kind, name), (sight, sees), across, (band, ends) in names:
        sees_so = table.sight == sight
        both = sees_so & (table.kind == kind)
        heads_so = both & (lies_across == across)
        own = heads_so & (table.band == band)
        groups: Groups = (
            ("cell", own),
            ("kind, sight and heading", heads_so),
            ("kind and sight", both),
            ("sight", sees_so),
        )
        if sees != "hidden":  # what is in sight says nothing about what is not: it stays unfound
            groups = (*groups, ("all", any_row))
        errors = _box_errors(table, groups)
        marks[own] = _standardised(table.error[own], errors)
        found = _chain(table.hit, table, groups)
        cells.append(Cell(kind=name, sight=sees, across=across, range_m=ends, found=found, errors=errors))
    return Errors(
        **condition,
        episodes=len(known),
        area_m=area,
        cells=tuple(cells),
        flipped=tuple(  # type: ignore[arg-type]
            _chain(table.flipped, table, (("cell", table.quarter == k), ("all", any_row)), table.hit & ~table.crossed)
            for k in range(4)
        ),
        crossed=(
            _chain(table.crossed, table, (("cell", ~lies_across),), table.hit),
            _chain(table.crossed, table, (("cell", lies_across),), table.hit),
        ),
        correlation=_correlation(marks, table),
        doubles=Doubles(
            there=(
                _chain(doubled, table, (("cell", ~lies_across),), table.hit),
                _chain(doubled, table, (("cell", lies_across),), table.hit),
            ),
            examples=_some(np.round(table.second[doubled], 4).tolist()),  # type: ignore[arg-type]
        ),
        ghosts=_ghosts(known, places, interval_s),
    )


def classes_found(errors: Iterable[Errors]) -> tuple[str, ...]:
    """Return the classes of the kinds that are found after a miss in `FINDS` or more of the clear views within 50 m."""
    names: list[str] = []
    for kind, members in CLASSES_OF.items():
        clear = [
            chance
            for one in errors
            for cell in one.cells
            if (cell.kind, cell.sight) == (kind, "clear") and cell.range_m[1] <= 50.0
            for chance in (cell.found.not_yet, cell.found.after_no)
        ]
        own = [chance.p for chance in clear if chance.of not in ("sight", "all")]
        names += members if max(own, default=0.0) >= FINDS else ()
    return tuple(names)


def _area(sequences: Sequence[Sequence[Observed]]) -> tuple[float, float, float, float]:
    """Return the corners of all found boxes in the ego's frame, m."""
    parts = [ego_frame(one.found.center[:, :2], one.ego) for sequence in sequences for one in sequence]
    places = np.concatenate([np.zeros((0, 2)), *parts])
    if not len(places):
        return 0.0, 0.0, 0.0, 0.0
    low, high = (np.round(bound, 3).tolist() for bound in (places.min(axis=0), places.max(axis=0)))
    return low[0], low[1], high[0], high[1]


def _table(
    sequences: Sequence[Sequence[Observed]], area: Sequence[float], interval_s: float
) -> tuple[_Table, list[list[Mask]]]:
    """Return the objects of all percepts inside the area, and of each percept which boxes belong to nothing."""
    columns: list[tuple[NDArray, ...]] = []
    false: list[list[Mask]] = []
    count = 0
    for sequence in sequences:
        last: dict[int, int] = {}
        last_s = -np.inf
        false.append([])
        for one in sequence:
            found, truth = one.matches()
            again, of = one.doubles()
            false[-1].append(~np.isin(np.arange(len(one.found)), np.concatenate([found, again])))
            local = ego_frame(one.truth.center[:, :2], one.ego)
            rows = np.flatnonzero(within(area, local))
            if one.time_s - last_s > interval_s + _STEP_S:
                last = {}
            box, second = np.full((2, len(one.truth)), -1)
            box[truth], second[of] = found, again
            ids = one.truth.object_id[rows].tolist()
            before = np.array([last.get(number, -1) for number in ids], np.int64)
            last, last_s = {number: count + row for row, number in enumerate(ids)}, one.time_s
            count += len(rows)
            error, flipped, crossed = _errors_of(one, box[rows], rows)
            kind, quarter = KIND_OF_LABEL[one.truth.label[rows]], quarters_of(one.truth.yaw[rows] - one.ego[2])
            seen = kind, one.sight[rows], bands_of(local[rows]), box[rows] >= 0
            columns.append((*seen, before, error, flipped, crossed, quarter, _offsets(one, second[rows], rows)))
    if not columns:
        none = np.zeros(0, np.int64)
        empty = np.zeros(0, bool)
        errors = np.zeros((0, len(PARTS)))
        return _Table(none, none, none, empty, none, errors, empty, empty, none, errors), false
    return _Table(*(np.concatenate(parts) for parts in zip(*columns, strict=True))), false


def _errors_of(
    one: Observed, box: NDArray[np.int64], rows: NDArray[np.int64]
) -> tuple[NDArray[np.float64], Mask, Mask]:
    """Return (K, 8) errors of the boxes of objects, NaN without one, and whether they point backwards or lie across."""
    error = _offsets(one, box, rows)
    quarters = np.rint(np.nan_to_num(error[:, 6]) / (0.5 * np.pi))
    error[:, 6] -= quarters * 0.5 * np.pi
    return error, np.abs(quarters) == 2.0, np.abs(quarters) == 1.0


def _offsets(one: Observed, box: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return (K, 8) differences of boxes (K,) from objects (K,) by `PARTS`, and scores; NaN where the box is -1."""
    offset = np.full((len(rows), len(PARTS)), np.nan)
    hit = np.flatnonzero(box >= 0)
    true, found = one.truth[rows[hit]], one.found[box[hit]]
    apart = found.center - true.center
    cos, sin = np.cos(true.yaw), np.sin(true.yaw)
    offset[hit, 0] = cos * apart[:, 0] + sin * apart[:, 1]
    offset[hit, 1] = cos * apart[:, 1] - sin * apart[:, 0]
    offset[hit, 2] = apart[:, 2]
    offset[hit, 3:6] = np.log(found.size / true.size)
    offset[hit, 6] = wrap_angle(found.yaw - true.yaw)
    offset[hit, 7] = one.score[box[hit]]
    return offset


def _chance(event: Mask, groups: Groups) -> Chance:
    """Return the chance of an event among the rows of the least wide group with enough of them, else the widest."""
    for name, rows in groups:
        trials = int(rows.sum())
        if trials >= LEAST or name == groups[-1][0]:
            value = rate(event[rows].astype(float).tolist())
            bounds = (0.0, 0.0, 1.0) if trials == 0 else value
            p, low, high = (round(float(bound), 6) for bound in bounds)
            return Chance(p=p, low=low, high=high, trials=trials, of=name)
    raise ValueError("no groups")


def _chain(event: Mask, table: _Table, groups: Groups, counts: Mask | None = None) -> Chain:
    """Return the chain of an event over the rows that count, all by default, and whose row before does.

    What is hidden is seldom found: its own rate, whatever came before, says more than a chain of what is in sight.
    """
    counts = np.ones(len(event), bool) if counts is None else counts
    follows = table.before >= 0
    past = np.where(follows, table.before, 0)
    follows, yes = follows & counts[past], event[past]
    ever = np.zeros(len(event), bool)
    for row in np.flatnonzero(follows):
        ever[row] = ever[past[row]] or yes[row]

    def of(rows: Mask) -> Chance:
        listed: list[tuple[Wider, Mask]] = [(name, group & counts & rows) for name, group in groups]
        if len(groups) > 2:
            listed.insert(3, ("kind and sight, whatever came before", groups[2][1] & counts))
        return _chance(event, listed)

    return Chain(
        first=of(~follows),
        not_yet=of(follows & ~ever),
        after_yes=of(follows & yes),
        after_no=of(follows & ever & ~yes),
    )


def _box_errors(table: _Table, groups: Groups) -> BoxErrors:
    for name, rows in groups:
        boxes = table.error[rows & table.hit]
        if len(boxes) >= LEAST or name == groups[-1][0]:
            break
    if not len(boxes):
        boxes = np.zeros((1, len(PARTS)))
    bias, sd = (np.round(moment, 5).tolist() for moment in (boxes[:, :7].mean(axis=0), boxes[:, :7].std(axis=0)))
    score = np.round(np.quantile(boxes[:, 7], QUANTILES), 4).tolist()
    return BoxErrors(bias=tuple(bias), sd=tuple(sd), score=tuple(score), boxes=int((rows & table.hit).sum()), of=name)


def _standardised(error: NDArray[np.float64], errors: BoxErrors) -> NDArray[np.float64]:
    """Return (K, 8) errors as standard normal numbers, NaN where there are none."""
    sd = np.array(errors.sd)
    parts = (error[:, :7] - errors.bias) / np.where(sd > 0.0, sd, np.inf)
    # Equal quantiles share the middle of their shares.
    score = np.array(errors.score)
    low, high = (np.searchsorted(score, error[:, 7], side) for side in ("left", "right"))
    rising = np.concatenate([[True], np.diff(score) > 0.0])
    share = np.interp(error[:, 7], score[rising], np.array(QUANTILES)[rising])
    share = np.where(high - low > 1, 0.5 * (low + high - 1) / (len(score) - 1), share)
    mark = np.where(np.isnan(error[:, 7]), np.nan, ndtri(np.clip(share, 0.02, 0.98)))
    return np.column_stack([parts, mark])


def _correlation(marks: NDArray[np.float64], table: _Table) -> tuple[float, ...]:
    """Return the correlation of each part of the errors of one object in consecutive percepts."""
    later = np.flatnonzero((table.before >= 0) & table.hit)
    later = later[table.hit[table.before[later]]]
    now, past = marks[later], marks[table.before[later]]
    power = 0.5 * ((now**2).sum(axis=0) + (past**2).sum(axis=0))
    found = (now * past).sum(axis=0) / np.where(power > 0.0, power, np.inf)
    return tuple(np.round(np.clip(found, 0.0, _MOST_CORRELATED), 4).tolist())


def _ghosts(sequences: Sequence[Sequence[Observed]], false: Sequence[Sequence[Mask]], interval_s: float) -> Ghosts:
    examples: list[list[float]] = []
    lived: list[float] = []
    born = following = percepts = 0
    for sequence, masks in zip(sequences, false, strict=True):
        past, past_s = np.zeros((0, 2)), -np.inf
        for one, mask in zip(sequence, masks, strict=True):
            boxes, place = one.found[mask], one.found.center[mask, :2]
            new = np.ones(len(boxes), bool)
            percepts += 1
            if one.time_s - past_s <= interval_s + _STEP_S:
                kept = _same(past, place)
                new[kept] = False
                lived += [1.0] * len(kept) + [0.0] * (len(past) - len(kept))
                following += 1
                born += int(new.sum())
            rows = np.column_stack(
                [ego_frame(place, one.ego), wrap_angle(boxes.yaw - one.ego[2]), boxes.size, one.score[mask]]
            )
            examples += np.round(rows[new], 3).tolist()
            past, past_s = place, one.time_s
    return Ghosts(
        born=round(born / max(following, 1), 6),
        lives=_chance(np.array(lived, bool), [("cell", np.ones(len(lived), bool))]),
        percepts=percepts,
        examples=_some(examples),  # type: ignore[arg-type]
    )


def _some(rows: list[list[float]]) -> tuple[tuple[float, ...], ...]:
    """Return `EXAMPLES` of the rows at most, evenly chosen."""
    chosen = np.unique(np.linspace(0, len(rows) - 1, EXAMPLES if rows else 0).astype(int)).tolist()
    return tuple(tuple(rows[row]) for row in chosen)


def _same(past: NDArray[np.float64], now: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the rows of places that were there before, each place once."""
    apart = np.linalg.norm(past[:, None] - now[None], axis=2)
    near = apart <= MATCH_M
    before, after = linear_sum_assignment(np.where(near, apart, 1e6))
    return np.asarray(after[near[before, after]], np.int64)
