"""Cause of every missed object and every false box of a frame, with its evidence and one sentence.

The first of the causes in the order of `MISSED` and `FALSE` that holds is it; the sentence adds what else is known.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.data.points_in_boxes import points_in_boxes
from dsrc.data.sample import Range
from dsrc.evaluation.causes.sight import hidden_by
from dsrc.evaluation.detection_table import DetectionTable, points_left
from dsrc.evaluation.metrics.ap import overlapping_pairs
from sensors.frame import Frame
from sensors.sweep import SCATTERED
from sim.boxes import CLASSES, Boxes
from sim.errors import DataError, complaint
from sim.geometry import invert, transform_points

if TYPE_CHECKING:
    from dsrc.messages.attacks import Lie  # torch comes with it, and the page's first picture does without

MissedKind = Literal[
    "out of range",
    "below threshold",
    "wrong heading",
    "pose error",
    "message late",
    "badly placed",
    "hidden",
    "message missing",
    "left out",
    "few points",
    "amid made points",
    "no box",
]
"""Causes of a missed object, in the order in which they are looked for."""
FalseKind = Literal[
    "own body",
    "told wrongly",
    "doubled box",
    "wrong heading",
    "pose error",
    "message late",
    "badly placed",
    "not evaluated",
    "made by the corruption",
    "of nothing",
]
"""Causes of a false box, in the order in which they are looked for."""
MISSED: tuple[MissedKind, ...] = get_args(MissedKind)
FALSE: tuple[FalseKind, ...] = get_args(FalseKind)

FEW = 20
"""Points up to which an object is hard to find: in clean sweeps of dsrc-sim's test split `small-dsrc.pt` finds 11 of 19
objects with 6 to 20 points, and 127 of 140 with more than 80."""
_NEAR = 0.1
"""Least IoU of a box with an object that it is of."""
_TURNED = math.radians(15.0)
"""Least error of a heading that explains a small IoU."""
_MOVED_M = 0.2
"""Least displacement, by a pose error or a delay, that explains anything, m: two cells of a fine grid."""
_CELL_M = 0.4
"""Side of the cells in which the area of points is counted, m: a pillar of the detectors."""
_COLUMN_M = 4.5
"""Height over a false box's floor of the points that may have made it, m: detectors see whole pillars."""


class ErrorCause(msgspec.Struct, frozen=True, kw_only=True):
    """Cause of an error of a frame.

    Attributes:
        error: a missed object or a false box.
        kind: one of `MISSED` or `FALSE`.
        sentence: it in words, with what else is known.
        object_id: the missed object, or the one that a false box is of; None without one.
        rank: place of the box in the order of the scores: a false one, or the one below the threshold or beside its
            object that a missed object has; None without one.
        score: of that box.
        iou: of that box with the object, seen from above.
        points: on the object, of the agents that take part, in the clean frame; None without an object.
        points_left: after the corruption.
        hidden_from: agents that take part and have no point on it in the clean frame.
        hidden_by: object ids of what hides it from each of these; None for what is no road user.
        helper: the agent whose pose, message or lie is the cause; None without one.
    """

    error: Literal["missed", "false"]
    kind: MissedKind | FalseKind
    sentence: str
    object_id: int | None = None
    rank: int | None = None
    score: float | None = None
    iou: float | None = None
    points: int | None = None
    points_left: int | None = None
    hidden_from: tuple[int, ...] = ()
    hidden_by: tuple[int | None, ...] = ()
    helper: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Circumstances:
    """What is known of a frame's detections beside them.

    Attributes:
        condition: title of the corruption; "" for none.
        corrupted: the frame under it; None where it is not at hand: points that are left are then those of the table.
        team: agents that take part, the ego first; None for all of the frame.
        range_m: range in which the detector looks, in the ego LiDAR's frame, m; None for any.
        ages: age of the message of each helper, s; None for a lost one. Helpers that are not named were heard at once.
        lies: what helpers lie about whose message arrived.
    """

    condition: str = ""
    corrupted: Frame | None = None
    team: tuple[int, ...] | None = None
    range_m: Range | None = None
    ages: Mapping[int, float | None] = field(default_factory=dict)
    lies: "Mapping[int, Lie]" = field(default_factory=dict)


NOTHING_ELSE = Circumstances()


def frame_causes(
    table: DetectionTable, frame: Frame, score: float, iou: float, known: Circumstances = NOTHING_ELSE
) -> list[ErrorCause]:
    """Return the causes of the missed objects of a frame, in their order, and of its false boxes, the best score first.

    Args:
        table: detections and true boxes of this frame alone.
        frame: as recorded, with the sweeps of all agents.
        score: least score of a box that counts.
        iou: least bird's-eye IoU of a box with its object.
        known: what is known beside these.

    Raises:
        DataError: the frame lacks the ego or an object of the table.
    """
    judged = _Judged(table, frame, score, iou, known)
    missed = [judged.missed(int(row)) for row in np.flatnonzero(~judged.found)]
    return [*missed, *(judged.false(int(row)) for row in np.flatnonzero(judged.kept & (judged.matched < 0)))]


class _Judged:
    """Detections of a frame, matched, and what the agents have of its objects."""

    def __init__(self, table: DetectionTable, frame: Frame, score: float, iou: float, known: Circumstances) -> None:
        self.table, self.frame, self.score, self.iou, self.known = table, frame, score, iou, known
        ids, ego = [agent.agent_id for agent in frame.agents], int(table.ego_id[0])
        objects = np.searchsorted(frame.truth.object_id, table.object_id)
        if ego not in ids:
            raise DataError(complaint(f"frame {frame.index}", "agents", f"the ego {ego}", ", ".join(map(str, ids))))
        there = np.append(frame.truth.object_id, -1)[objects] == table.object_id
        if not there.all():
            lacks = int(table.object_id[~there][0])
            raise DataError(complaint(f"frame {frame.index}", "truth", f"the object {lacks}", "none of that id"))
        self.ego, self.objects = ego, objects
        self.lidar = frame.agent(ego).sweep.world_from_lidar
        self.team = known.team or (ego, *(one for one in ids if one != ego))
        self.rows = [ids.index(one) for one in self.team if one in ids]
        self.boxes = Boxes.from_array(table.boxes.astype(np.float64))
        self.truth = Boxes.from_array(table.truth.astype(np.float64), table.label, table.object_id)
        self.all = frame.truth.transform(invert(self.lidar))
        pairs = overlapping_pairs([self.boxes.array], [self.truth.array]).ranked()
        self.matched, self.pairs = pairs.matched(iou, len(self.boxes)), pairs
        self.kept = table.score >= score
        self.found_by = np.full(len(self.truth), -1, np.int64)
        self.found_by[self.matched[self.matched >= 0]] = np.flatnonzero(self.matched >= 0)
        self.found = (self.found_by >= 0) & np.append(self.kept, False)[self.found_by]
        self.clean = frame.points_on[self.rows][:, objects]
        self.left = self._left()

    def _left(self) -> NDArray[np.int64]:
        """(N,) points that are left on the objects, of the agents whose message arrived."""
        heard = np.array([self.known.ages.get(self.team[k], 0.0) is not None for k in range(len(self.rows))])
        if self.known.corrupted is not None:
            left = points_left(self.frame, self.known.corrupted)[self.rows][:, self.objects]
            return np.asarray(left[heard].sum(axis=0), np.int64)
        clean, stored = self.clean.sum(axis=0), self.table.points[:, 2 if len(self.rows) == 1 else 3]
        return np.maximum(np.where(stored < 0, clean, stored) - self.clean[~heard].sum(axis=0), 0)

    def missed(self, row: int) -> ErrorCause:
        """Cause of a missed object."""
        kind, why, box, helper = self._why_missed(row)
        unseen = [k for k in range(len(self.rows)) if self.clean[k, row] == 0]
        hidden = {self.team[k]: self._hidden_by(k, row) for k in unseen if self.team[k] != self.truth.object_id[row]}
        parts = [why]
        if kind not in ("few points", "hidden") and self.left[row] < self.clean[:, row].sum():
            parts.append(self._points(row))
        if hidden and kind != "out of range":
            parts.append(self._hidden(hidden, row))
        parts += self._told(row)
        return ErrorCause(
            error="missed",
            kind=kind,
            sentence="; ".join(parts),
            object_id=int(self.truth.object_id[row]),
            rank=box,
            score=None if box is None else round(float(self.table.score[box]), 4),
            iou=None if box is None else round(self._iou(box, row), 4),
            points=int(self.clean[:, row].sum()),
            points_left=int(self.left[row]),
            hidden_from=tuple(hidden),
            hidden_by=tuple(hidden.values()),
            helper=helper,
        )

    def _told(self, row: int) -> list[str]:
        """Which helpers have points on an object, and how old their messages are, where that is known."""
        seen = [self.team[k] for k in range(len(self.rows)) if self.clean[k, row]]
        ages = {one: self.known.ages[one] for one in seen if one in self.known.ages}
        return [
            f"{self._who(one)} saw it, its message was {'lost' if age is None else f'{1000.0 * age:.0f} ms old'}"
            for one, age in ages.items()
        ]

    def _why_missed(self, row: int) -> tuple[MissedKind, str, int | None, int | None]:
        """Kind, sentence, box and helper of a missed object."""
        if (low := self.known.range_m) is not None:
            x, y = self.truth.center[row, :2]
            if not (low[0] <= x <= low[3] and low[1] <= y <= low[4]):
                return "out of range", f"at {x:.0f}, {y:.0f} m it is outside the range of the detector", None, None
        if (box := int(self.found_by[row])) >= 0:
            score, digits = float(self.table.score[box]), _digits(float(self.table.score[box]), self.score)
            short = f"score {score:.{digits}f} is below {self.score:g} by {self.score - score:.{digits}f}"
            return "below threshold", short, box, None
        beside = self.pairs.detection[(self.pairs.truth == row) & (self.pairs.iou >= _NEAR)]
        # One of too low a score says more than its absence, but where points are few.
        beside = beside[(self.kept[beside] | (self.left[row] > FEW)) & (self.matched[beside] < 0)]
        if len(beside):
            box = int(max(beside, key=lambda one: (bool(self.kept[one]), self._iou(int(one), row))))
            kind, why = self._placed(box, row)
            if not self.kept[box]:
                score = float(self.table.score[box])
                why += f", and its score {score:.{_digits(score, self.score)}f} below {self.score:g}"
            return kind, why, box, self._mover(box, row)[1]
        before, main = self.clean.sum(axis=0)[row], self._main(row)
        if before == 0:
            return "hidden", "no agent that takes part has a point on it", None, None
        lost = [self.team[k] for k in range(len(self.rows)) if self._lost(self.team[k]) and self.clean[k, row]]
        if lost and self.clean[[not self._lost(self.team[k]) for k in range(len(self.rows))], row].sum() == 0:
            whose = ", ".join(self._who(one) for one in lost)
            return (
                "message missing",
                f"only {whose} has points on it, {before}, and its message was lost",
                None,
                lost[0],
            )
        if (liar := self._left_out_by(row)) is not None:
            seen = int(self.clean[self.team.index(liar), row])
            return "left out", f"left out by {self._who(liar)}, who has {seen} points on it", None, liar
        if self.left[row] <= FEW:
            return "few points", self._points(row), None, None
        if main is not None:
            for kind, name, shift in self._shifts(main, row):
                if np.hypot(*shift) >= 0.5 * self.truth.size[row, 1]:
                    return kind, f"no box; {name} moves its points by {np.hypot(*shift):.1f} m", None, main
        objects, made, cells = self._points_over(self.truth.array[row])
        own, amid = np.unique(cells[objects == self.truth.object_id[row]]), np.unique(cells[made])
        if len(amid) and (share := float(np.isin(own, amid).mean())) >= 0.5:
            count, by = int(np.count_nonzero(made)), self.known.condition or "the corruption"
            why = f"no box; {count} points made by {by} lie over it, in {100 * share:.0f} % of the cells with its own"
            return "amid made points", why, None, None
        whole = self.left[row] >= before
        return "no box", "no box overlaps it" + (f", with {before} points on it" if whole else ""), None, None

    def false(self, box: int) -> ErrorCause:
        """Cause of a false box."""
        kind, why, row, other, helper = self._why_false(box)
        return ErrorCause(
            error="false",
            kind=kind,
            sentence=f"score {self.table.score[box]:.2f}: {why}",
            object_id=int(self.truth.object_id[row]) if row is not None else other,
            rank=box,
            score=round(float(self.table.score[box]), 4),
            iou=round(self._iou(box, row), 4) if row is not None else None,
            points=int(self.clean[:, row].sum()) if row is not None else None,
            points_left=int(self.left[row]) if row is not None else None,
            helper=helper,
        )

    def _why_false(self, box: int) -> tuple[FalseKind, str, int | None, int | None, int | None]:
        """Kind, sentence, judged object, another object and helper of a false box."""
        own = overlapping_pairs([self.boxes.array[box : box + 1]], [self.all.array])
        over = {int(row): float(iou) for row, iou in zip(own.truth, own.iou, strict=True) if iou >= _NEAR}
        body = int(np.searchsorted(self.all.object_id, self.ego))
        away = float(np.hypot(*self.boxes.center[box, :2]))
        around = bool(self.boxes[box : box + 1].contains(self.boxes.center[box : box + 1] * [0.0, 0.0, 1.0]).any())
        if around or (body in over and self.all.object_id[body] == self.ego):
            return "own body", f"it lies on the ego itself, {away:.1f} m from its LiDAR", None, self.ego, None
        near = self.pairs.truth[(self.pairs.detection == box) & (self.pairs.iou >= _NEAR)]
        if liars := self._invented_by(box, max(over.values(), default=0.0)):
            whom = " and ".join(map(self._who, liars))
            return "told wrongly", f"told wrongly by {whom}, {away:.0f} m away", None, None, liars[0]
        if len(near):
            return self._of(box, int(self.objects[near[0]]))
        if over:
            return self._of(box, max(over, key=lambda one: over[one]))
        objects, made, cells = self._points_over(self.boxes.array[box])
        inside, count = len(made), int(np.count_nonzero(made))
        alone, area = len(np.unique(cells)) - len(np.unique(cells[~made])), len(np.unique(cells))
        if count and max(count / inside, alone / area) >= 0.5:
            why = f"{count} of the {inside} points over it were made by {self.known.condition or 'the corruption'}"
            if 2 * count < inside:
                why += f", which alone fill {100 * alone / area:.0f} % of their area"
            return "made by the corruption", why, None, None, None
        users, points = np.unique(objects[np.isin(objects, self.all.object_id)], return_counts=True)
        if 2 * points.max(initial=0) >= max(inside, 1):
            return self._of(box, int(np.searchsorted(self.all.object_id, users[points.argmax()])))
        return "of nothing", f"no road user is there; {inside} points are over it, {away:.0f} m away", None, None, None

    def _left_out_by(self, row: int) -> int | None:
        """Helper that left an object out of what it told, and sees the most of it; None where others see enough."""
        gone = [one for one, lie in self.known.lies.items() if int(self.truth.object_id[row]) in lie.removed]
        liars = [k for k in range(len(self.rows)) if self.team[k] in gone and self.clean[k, row]]
        honest = sum(int(self.clean[k, row]) for k in range(len(self.rows)) if k not in liars)
        return self.team[max(liars, key=lambda k: int(self.clean[k, row]))] if liars and honest <= FEW else None

    def _invented_by(self, box: int, iou: float) -> list[int]:
        """Helpers whose ghost a box is, which overlaps every road user by at most `iou`."""
        own = self.boxes.array[box : box + 1]
        least, back = max(iou, _NEAR), invert(self.lidar)
        return [
            one
            for one, lie in self.known.lies.items()
            if overlapping_pairs([own], [lie.ghosts.transform(back).array]).iou.max(initial=0.0) >= least
        ]

    def _of(self, box: int, place: int) -> tuple[FalseKind, str, int | None, int | None, int | None]:
        """Cause of a false box that is of a road user of the frame, as `_why_false`."""
        if place not in self.objects:
            label, points = CLASSES[int(self.all.label[place])], int(self.frame.points_on[self.rows, place].sum())
            name = f"the {label} {self.all.object_id[place]}"
            why = f"it is on {name}, which is not evaluated: {points} points of the agents that take part"
            return "not evaluated", why, None, int(self.all.object_id[place]), None
        row = int(np.flatnonzero(self.objects == place)[0])
        name, by = self._name(row), int(self.found_by[row])
        if by >= 0 and by != box and self.kept[by]:
            why = f"the {name} has a box of score {self.table.score[by]:.2f} already"
            return "doubled box", f"{why}; IoU {self._iou(box, row):.2f} with it", row, None, None
        kind, why = self._placed(box, row)
        return kind, f"meant for the {name}: {why}", row, None, self._mover(box, row)[1]  # type: ignore[return-value]

    def _placed(self, box: int, row: int) -> tuple[MissedKind, str]:
        """Kind and sentence of a box that is beside its object."""
        overlap = self._iou(box, row)
        iou = f"IoU {overlap:.{_digits(overlap, self.iou)}f} is below {self.iou:g}"
        kind, helper, shift = self._mover(box, row)
        turn = abs((self.boxes.yaw[box] - self.truth.yaw[row] + 0.5 * np.pi) % np.pi - 0.5 * np.pi)
        turned = self.boxes.array[box : box + 1].copy()
        turned[:, 6] = self.truth.yaw[row]
        right = overlapping_pairs([turned], [self.truth.array[row : row + 1]]).iou
        if turn >= _TURNED and right.max(initial=0.0) >= self.iou:
            return "wrong heading", f"its box is turned by {math.degrees(turn):.0f}°: {iou}"
        if kind is not None and helper is not None:
            return kind, f"{self._names(kind, helper)} moves its points by {np.hypot(*shift):.1f} m: {iou}"
        off = f"{np.hypot(*(self.boxes.center[box, :2] - self.truth.center[row, :2])):.1f}"
        longer = self.boxes.size[box, 0] - self.truth.size[row, 0]
        wrong = [f"{off} m off", f"{abs(longer):.1f} m too {_long(longer)}"]
        told = [text for text in wrong if not text.startswith("0.0 ")] or wrong[:1]
        return "badly placed", f"its box is {' and '.join(told)}: {iou}"

    def _mover(self, box: int, row: int) -> tuple[MissedKind | None, int | None, NDArray[np.float64]]:
        """Kind, helper and displacement, m, that explain at least half of how far a box is off; None without."""
        main = self._main(row)
        off = self.boxes.center[box, :2] - self.truth.center[row, :2]
        if main is not None:
            for kind, _, shift in self._shifts(main, row):
                if np.hypot(*(off - shift)) <= 0.5 * np.hypot(*off):
                    return kind, main, shift
        return None, None, np.zeros(2)

    def _shifts(self, helper: int, row: int) -> list[tuple[MissedKind, str, NDArray[np.float64]]]:
        """Displacements of a helper's points on an object, by its pose error and by the age of its message."""
        shifts: list[tuple[MissedKind, str, NDArray[np.float64]]] = []
        centre = self.frame.truth.center[self.objects[row]]
        if self.known.corrupted is not None:
            true, told = (one.agent(helper).sweep.world_from_lidar for one in (self.frame, self.known.corrupted))
            ego_true, ego_told = self.lidar, self.known.corrupted.agent(self.ego).sweep.world_from_lidar
            seen = transform_points(told @ invert(true), centre[None])[0]
            here = (
                transform_points(invert(ego_told), seen[None])[0] - transform_points(invert(ego_true), centre[None])[0]
            )
            shifts.append(("pose error", self._names("pose error", helper), here[:2]))
        age = self.known.ages.get(helper, 0.0) or 0.0
        if age > 0.0:
            back = invert(self.lidar)[:2, :2] @ self.frame.velocity[self.objects[row]]
            shifts.append(("message late", self._names("message late", helper), -age * back))
        return [one for one in shifts if np.hypot(*one[2]) >= _MOVED_M]

    def _names(self, kind: MissedKind, helper: int) -> str:
        if kind == "pose error":
            if (lie := self.known.lies.get(helper)) is not None and lie.misplaced:
                return f"the false pose of {self._who(helper)}"
            return f"the pose error of {self._who(helper)}"
        return f"the message of {self._who(helper)}, {1e3 * (self.known.ages.get(helper) or 0.0):.0f} ms old,"

    def _main(self, row: int) -> int | None:
        """Return the helper with the most points on an object, where the ego has fewer; None without one."""
        k = int(np.argmax(self.clean[:, row])) if len(self.rows) else 0
        return self.team[k] if k and self.clean[k, row] > self.clean[0, row] and not self._lost(self.team[k]) else None

    def _lost(self, agent: int) -> bool:
        return self.known.ages.get(agent, 0.0) is None

    def _hidden_by(self, k: int, row: int) -> int | None:
        place = self.frame.agents[self.rows[k]].sweep.world_from_lidar[:3, 3]
        by = hidden_by(place, self.frame.truth, int(self.objects[row]), self.team[k])
        return None if by < 0 else int(self.frame.truth.object_id[by])

    def _hidden(self, hidden: Mapping[int, int | None], row: int) -> str:
        """What hides an object from which agents."""
        groups: dict[int | None, list[int]] = {}
        for agent, by in hidden.items():
            groups.setdefault(by, []).append(agent)
        every = len(hidden) == len(self.rows) - (int(self.truth.object_id[row]) in self.team)
        texts = []
        for by, agents in groups.items():
            what = "out of reach, or behind what is no road user,"
            if by is not None:
                what = f"behind the {CLASSES[int(self.all.label[np.searchsorted(self.all.object_id, by)])]} {by}"
            whom = "every agent" if every and len(groups) == 1 < len(agents) else ", ".join(map(self._who, agents))
            texts.append(f"{what} for {whom}")
        return "; ".join(texts)

    def _points(self, row: int) -> str:
        before, left = int(self.clean[:, row].sum()), int(self.left[row])
        if left >= before:
            return f"{left} points on it"
        return f"{left} of {before} points left" + (f" in {self.known.condition}" if self.known.condition else "")

    def _points_over(self, box: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.int64]]:
        """(P,) points of the team over the floor of a (7,) box: object, whether a corruption made it, its cell."""
        column = box[None].copy()
        column[:, 2] += 0.5 * (_COLUMN_M - column[:, 5])
        column[:, 5] = _COLUMN_M
        one = Boxes.from_array(column).transform(self.lidar)
        parts = []
        for k in self.rows:
            sweep = (self.known.corrupted or self.frame).agents[k].sweep
            rows, _ = points_in_boxes(one, sweep.points, sweep.world_from_lidar)
            off = (transform_points(sweep.world_from_lidar, sweep.points[rows]) - one.center)[:, :2]
            x, y = np.floor(off / _CELL_M).astype(np.int64).T
            parts.append((sweep.object_id[rows].astype(np.int64), sweep.fate[rows] == SCATTERED, 10_000 * x + y))
        objects, made, cells = (np.concatenate(part) for part in zip(*parts, strict=True))
        return objects, made, cells

    def _iou(self, box: int, row: int) -> float:
        return float(self.pairs.iou[(self.pairs.detection == box) & (self.pairs.truth == row)].max(initial=0.0))

    def _name(self, row: int) -> str:
        return f"{CLASSES[int(self.truth.label[row])]} {self.truth.object_id[row]}"

    def _who(self, agent: int) -> str:
        if agent == self.ego:
            return "the ego"
        return f"roadside unit {-agent}" if agent < 0 else f"helper {agent}"


def _digits(value: float, limit: float) -> int:
    """Least number of digits, two or more, with which a value below a limit reads as below it."""
    return next((digits for digits in range(2, 9) if float(f"{value:.{digits}f}") < limit), 2)


def _long(more: float) -> str:
    return "long" if more > 0.0 else "short"
