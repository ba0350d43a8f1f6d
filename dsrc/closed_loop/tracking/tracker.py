"""Tracker of boxes in the world frame: percepts of single instants to moving road users.

A percept is filtered at the instant of its measurement; what comes out is predicted to the present, which makes up for
the age of a message. Everything is sorted before it is used, so the order of the boxes changes no bit.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.tracking.association import (
    assigned,
    centred,
    originals,
    overlaps,
    pair_distances,
    squared_distances,
)
from dsrc.closed_loop.tracking.bank import GROUP, KIND, Bank, Measured
from dsrc.closed_loop.tracking.filter import (
    RATE,
    VX,
    VY,
    YAW,
    Parameters,
    State,
    facing_forward,
    lying_across,
    motion_decides,
    predicted,
    rotated,
    turned,
    with_pose,
    with_velocity,
    without_slip,
)
from dsrc.closed_loop.tracking.settings import Motion, TrackerSettings
from dsrc.closed_loop.types import Percept, Tracks
from sim.boxes import CLASSES, Boxes
from sim.geometry import wrap_angle
from sim.rows import stacked

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_SLOTS = 1 << 20
"""More than twice the boxes of any percept: number of a percept and row of a box make one number."""


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """Percept that was filtered, and the tracks before it."""

    serial: int
    measured: Measured
    before: Bank
    may_start: bool


class _Place(NamedTuple):
    """Labels (N,) and boxes (N, 7) of detections or tracks."""

    label: Integers
    box: Array


class Tracker:
    """Tracker of boxes: Kalman filter, gated assignment, confirmed tracks.

    A track is confirmed, and so part of `Tracks`, when its score, here `evidence`, says that it is a road user and no
    series of ghosts (R. Sittler, *An Optimal Data Association Problem in Surveillance Theory*, IEEE Transactions on
    Military Electronics, 1964; S. Blackman and R. Popoli, *Design and Analysis of Modern Tracking Systems*, 1999,
    section 6.2). Each box adds two terms: one by its detection score, one by its distance from the predicted place,
    against ghosts that lie anywhere. Prior odds and the probability of detection are in the fitted settings. Unseen
    tracks coast and end by their detection scores or for lack of evidence.

    A percept older than the last one is filtered in its place: the tracks go back to the instant before it and the
    later percepts are filtered again. It starts no track, since the later percepts saw more; one older than `history_s`
    is ignored.

    Args:
        settings: motion, association and life cycle.
    """

    def __init__(self, settings: TrackerSettings | None = None) -> None:
        self.settings = settings or TrackerSettings()
        kinds = (self.settings.vehicle, self.settings.two_wheeler, self.settings.pedestrian)
        self._table = np.array([_columns(motion) for motion in kinds])[KIND]
        nothing = self._measured(Percept(0.0, Boxes.zeros(), np.zeros(0), np.zeros((0, 2))))
        self._bank = self._start(nothing, 0, -np.inf)
        self._steps: list[_Step] = []
        self._numbers: dict[int, int] = {}
        self._serial = 0
        self._now_s = -np.inf

    def update(self, percept: Percept | None, time_s: float) -> Tracks:
        """Return the tracks at the present after a percept.

        Args:
            percept: newest percept; None: the tracks are predicted.
            time_s: the present, s.

        Raises:
            ValueError: the present is earlier than the last one or than the percept; a value of the percept is not
                finite; a score is outside 0 to 1.
        """
        if not time_s >= self._now_s:
            raise ValueError(f"time_s must not decrease: got {time_s} s after {self._now_s} s")
        if percept is not None:
            if percept.time_s > time_s + 1e-6:
                raise ValueError(f"Percept.time_s must not be later than time_s = {time_s} s, got {percept.time_s} s")
            self._filter(self._measured(percept))
        self._now_s = time_s
        return self._tracks(time_s)

    def perceived(self) -> tuple[Tracks, NDArray[np.bool_]]:
        """Return the N tracks that the newest percept has boxes of, tentative ones too, and (N,) which are confirmed.

        Here `object_id` is the number of a track's first box, which it keeps.
        """
        bank = self._bank[self._bank.seen_s == self._bank.time_s]
        return _as_tracks(bank, bank.time_s, bank.birth), bank.number >= 0

    def _measured(self, percept: Percept) -> Measured:
        return Measured.of(percept, self._table, self.settings.reported_position_m)

    def _filter(self, measured: Measured) -> None:
        """Filter a percept in its place in time."""
        self._serial += 1
        step = _Step(self._serial, measured, self._bank, may_start=measured.time_s >= self._bank.time_s)
        later = [step]
        if not step.may_start:
            place = next(i for i, other in enumerate(self._steps) if other.measured.time_s > measured.time_s)
            before = self._steps[place].before
            if before.time_s > measured.time_s or not np.isfinite(before.time_s):
                return
            self._bank = before
            later = [step, *self._steps[place:]]
            del self._steps[place:]
        for each in later:
            self._steps.append(replace(each, before=self._bank))
            self._bank = self._advanced(self._steps[-1])
        oldest_s = self._bank.time_s - self.settings.history_s
        self._steps = [kept for kept in self._steps if kept.measured.time_s >= oldest_s]

    def _advanced(self, step: _Step) -> Bank:
        """Return the tracks after a percept."""
        settings, measured = self.settings, step.measured
        bank, since_s = self._predicted(step.before, measured.time_s)
        measured = self._without_duplicates(measured)
        tracks, found, bank = self._associated(bank, measured)
        if step.may_start:
            tracks, found, bank = self._with_crossing(bank, measured, tracks, found, step.serial)
        bank = self._matched(bank, tracks, measured[found])

        unseen = np.ones(len(bank.z), bool)
        unseen[tracks] = False
        half_life_s = np.where(bank.number >= 0, settings.half_life_s, settings.tentative_half_life_s)
        score = np.where(unseen, bank.score * 2.0 ** (-since_s / half_life_s), bank.score)
        evidence = bank.evidence - settings.missed_evidence * unseen
        bank = replace(bank, score=score, evidence=evidence)
        refuted = (bank.number >= 0) & (evidence < settings.refute_evidence)
        ended = unseen & (score < settings.drop_score) | refuted
        # The box that refutes a track may be another road user's first.
        fresh = (measured.score >= settings.start_score) & step.may_start
        fresh[found[~ended[tracks]]] = False
        bank = bank[~ended] if ended.any() else bank

        if fresh.any():
            bank = stacked(bank, self._start(measured[np.flatnonzero(fresh)], step.serial, measured.time_s))
        return self._merged(self._numbered(bank))

    def _predicted(self, bank: Bank, time_s: float) -> tuple[Bank, float]:
        """Return the remembered tracks at a later time, and the time since."""
        settings = self.settings
        since_s = time_s - bank.time_s if np.isfinite(bank.time_s) else 0.0
        bank = replace(bank, time_s=time_s)
        if (forgotten := time_s - bank.seen_s > settings.forget_s).any():
            bank = bank[~forgotten]
        if since_s == 0.0:
            return bank, since_s
        # White residuals have a running mean near 0, of a known deviation: one that pushes on brakes or accelerates.
        white = (settings.push_gain / (2.0 - settings.push_gain)) ** 0.5
        p = Parameters.of(self._table[bank.label])
        manoeuvre = 1.0 + settings.manoeuvre * np.maximum(np.abs(bank.push) - white, 0.0)
        p = p._replace(acceleration=p.acceleration * np.sqrt(manoeuvre))
        return replace(bank, state=predicted(bank.state, since_s, p, settings.turn_time_s)), since_s

    def _without_duplicates(self, measured: Measured) -> Measured:
        """Return the boxes without those that overlap a better one of their group; owners' reports always differ."""
        both = measured.reported[:, None] & measured.reported[None, :]
        place = _Place(measured.label, measured.box)
        same = self._in_one_place(place, place, ~both & ~np.eye(len(both), dtype=bool))
        return measured[originals(same)] if same.any() else measured

    def _associated(self, bank: Bank, measured: Measured) -> tuple[Integers, Integers, Bank]:
        """Return rows of tracks, rows of their boxes, and tracks whose estimate was too certain for theirs, widened."""
        settings = self.settings
        mean, covariance = bank.state.mean, bank.state.covariance
        distance = pair_distances(mean, covariance, measured.box, measured.variance)
        label = bank.label
        alike = GROUP[label][:, None] == GROUP[measured.label][None, :]
        gate = settings.gate**2
        # A tentative track, which may move anyhow, would fit nearly every box: confirmed ones choose first.
        most = gate + settings.score_cost
        cost = distance + settings.score_cost * (1.0 - measured.score)[None, :] + most * (bank.number < 0)[:, None]
        tracks, found = assigned(cost, alike & (distance <= gate), 2.0 * most)

        # Two road users cannot be in one place: a box that overlaps a track beyond its gate is the same object, which
        # moved as the filter did not expect.
        alike[tracks, :] = False
        alike[:, found] = False
        places = _Place(label, bank.box), _Place(measured.label, measured.box)
        if len(tracks) < min(alike.shape) and (same := self._in_one_place(*places, alike)).any():
            more, theirs = assigned(distance, same, float(distance[same].max()) + 1.0)
            widened = covariance[more] * (distance[more, theirs] / gate)[:, None, None].clip(1.0)
            bank = replace(bank, state=bank.state.replaced(more, State(mean[more], widened)))
            tracks, found = np.concatenate([tracks, more]), np.concatenate([found, theirs])
            order = np.argsort(tracks)
            tracks, found = tracks[order], found[order]
        return tracks, found, bank

    def _with_crossing(
        self, bank: Bank, measured: Measured, tracks: Integers, found: Integers, serial: int
    ) -> tuple[Integers, Integers, Bank]:
        """Return the pairs of `_associated` and those of new tracks: of road users that their first box lay across.

        A detector may know a place and not the heading, so that a road user moves sideways from its first box to its
        second. Two such boxes may also be of two road users: both stay what they are beside, and it takes a third box.
        """
        alone = np.ones(len(bank.z), bool)
        alone[tracks] = False
        rolling = np.isfinite(Parameters.of(self._table[bank.label]).slip_mps)
        once = np.flatnonzero(alone & (bank.hits == 1) & rolling)
        free = np.ones(len(measured.score), bool)
        free[found] = False
        rest = np.flatnonzero(free)
        if not (len(once) and len(rest)):
            return tracks, found, bank
        first, second, gate = bank[once], measured[rest], self.settings.gate**2
        state = lying_across(first.state)
        distance = pair_distances(state.mean, state.covariance, second.box, second.variance)
        alike = GROUP[first.label][:, None] == GROUP[second.label][None, :]
        rows, theirs = assigned(distance, alike & (distance <= gate), gate)
        place = np.arange(len(rows))
        crossing = replace(
            replace(first, state=state)[rows],
            birth=serial * _SLOTS + _SLOTS // 2 + place,
            needed=np.full(len(rows), 3),
            number=np.full(len(rows), -1),
        )
        return np.append(tracks, len(bank.z) + place), np.append(found, rest[theirs]), stacked(bank, crossing)

    def _matched(self, bank: Bank, tracks: Integers, measured: Measured) -> Bank:
        """Return the tracks after the boxes (K) of some of them (K)."""
        settings, reported = self.settings, measured.reported
        table = self._table[bank.label[tracks]]
        p, state = Parameters.of(table), bank.state.taken(tracks)

        offset, variance = measured.box[:, :2] - state.mean[:, :2], measured.variance
        ahead = np.column_stack([np.cos(state.mean[:, YAW]), np.sin(state.mean[:, YAW])])
        deviation = np.sqrt(np.einsum("ni,nij,nj->n", ahead, state.covariance[:, :2, :2] + variance, ahead))
        push = bank.push.copy()
        push[tracks] += settings.push_gain * ((ahead * offset).sum(axis=1) / deviation - push[tracks])

        # A detected heading may point backwards: it counts modulo half a turn, and the majority turns the track. One
        # across a motion that decides the heading counts modulo a quarter turn, and for neither end.
        residual = wrap_angle(measured.box[:, 6] - state.mean[:, YAW])
        opposite = np.abs(residual) > 0.5 * np.pi
        across = (np.abs(np.sin(residual)) > np.sqrt(0.5)) & ~reported & motion_decides(state, settings.direction_mps)
        facing = np.where(across, bank.facing[tracks], 0.8 * bank.facing[tracks] - 0.2 * np.where(opposite, 1.0, -1.0))
        speed = np.hypot(state.mean[:, VX], state.mean[:, VY])
        turn = np.where(reported, opposite, (facing < -0.3) & (speed < settings.direction_mps))
        facing = np.where(turn, np.abs(facing), facing)
        push[tracks] *= np.where(turn, -1.0, 1.0)
        state = turned(state, np.where(turn, np.pi, 0.0))
        residual = np.where(opposite, wrap_angle(residual - np.pi), residual)
        residual = np.where(across, residual - np.copysign(0.5 * np.pi, residual), residual)
        yaw_rad = np.where(reported, settings.reported_yaw_rad, p.yaw_rad)
        state = with_pose(state, measured.box[:, :2], variance, residual, yaw_rad)

        if (known := np.flatnonzero(reported)).size:
            told = with_velocity(state.taken(known), measured.velocity[known], settings.reported_velocity_mps)
            state = state.replaced(known, told)
        if (rolling := np.flatnonzero(np.isfinite(p.slip_mps) & ~reported)).size:
            state = state.replaced(rolling, without_slip(state.taken(rolling), Parameters.of(table[rolling])))
        if (free := np.flatnonzero(~reported)).size:
            state = state.replaced(free, facing_forward(state.taken(free), settings.direction_mps))

        # A box that overlaps the track beyond the gate is of it as well, and counts as one at the gate.
        expected = bank.state.covariance[tracks, :2, :2] + variance
        distance = np.minimum(squared_distances(offset, expected), settings.gate**2)
        area = 2.0 * np.pi * np.sqrt(np.linalg.det(expected))
        change = self._score_evidence(measured.score) - 0.5 * distance - np.log(area * settings.ghosts_per_m2)
        evidence = bank.evidence.copy()
        evidence[tracks] = self._bounded(evidence[tracks] + change)

        label, counts, votes = measured.label, bank.counts.copy(), bank.votes.copy()
        z, sizes, faces = bank.z.copy(), bank.sizes.copy(), bank.facing.copy()
        score, seen_s = bank.score.copy(), bank.seen_s.copy()
        counts[tracks, label] += 1
        votes[tracks, label] += measured.score
        weight = np.where(reported, 1.0, np.maximum(1.0 / counts[tracks].sum(axis=1), settings.smoothing))
        z[tracks] += weight * (measured.box[:, 2] - z[tracks])
        weight = np.where(reported, 1.0, np.maximum(1.0 / counts[tracks, label], settings.smoothing))
        sizes[tracks, label] += weight[:, None] * (measured.box[:, 3:6] - sizes[tracks, label])
        faces[tracks] = facing
        score[tracks] += settings.score_gain * (measured.score - score[tracks])
        seen_s[tracks] = measured.time_s
        return replace(
            bank,
            state=bank.state.replaced(tracks, state),
            z=z,
            sizes=sizes,
            counts=counts,
            votes=votes,
            push=push,
            facing=faces,
            score=score,
            evidence=evidence,
            seen_s=seen_s,
        )

    def _score_evidence(self, score: Array) -> Array:
        """Return the evidence of scores (N,)."""
        return self.settings.score_evidence * (score - self.settings.even_score)

    def _bounded(self, evidence: Array) -> Array:
        return np.clip(evidence, self.settings.least_evidence, self.settings.most_evidence)

    def _start(self, measured: Measured, serial: int, time_s: float) -> Bank:
        """Return new tracks of boxes."""
        settings, p, n = self.settings, Parameters.of(self._table[measured.label]), len(measured.score)
        yaw, reported = measured.box[:, 6], measured.reported
        covariance = np.zeros((n, 6, 6))
        covariance[:, :2, :2] = measured.variance
        told = settings.reported_velocity_mps**2
        covariance[:, 2:4, 2:4] = rotated(
            yaw, np.where(reported, told, p.speed_mps**2), np.where(reported, told, p.sideways_mps**2)
        )
        covariance[:, YAW, YAW] = np.where(reported, settings.reported_yaw_rad, p.yaw_rad) ** 2
        # The largest variance at any speed: that where curvature and grip bound the turn rate equally.
        covariance[:, RATE, RATE] = p.curvature_per_m * p.lateral_mps2
        votes, sizes = np.zeros((n, len(CLASSES))), np.zeros((n, len(CLASSES), 3))
        votes[np.arange(n), measured.label] = measured.score
        sizes[np.arange(n), measured.label] = measured.box[:, 3:6]
        return Bank(
            time_s=time_s,
            state=State(np.column_stack([measured.box[:, :2], measured.velocity, yaw, np.zeros(n)]), covariance),
            z=measured.box[:, 2],
            sizes=sizes,
            counts=np.eye(len(CLASSES), dtype=np.int64)[measured.label],
            votes=votes,
            push=np.zeros(n),
            facing=np.full(n, 0.3),
            score=measured.score,
            evidence=self._bounded(self._score_evidence(measured.score)),
            needed=np.where(measured.score >= settings.sure_score, 1, 2),
            seen_s=np.full(n, time_s),
            birth=serial * _SLOTS + np.arange(n),
            number=np.full(n, -1, np.int64),
        )

    def _in_one_place(self, a: _Place, b: _Place, among: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return which pairs (N, M) of `among` are of one group and in one place, where two road users cannot be.

        A pedestrian covers too little of the box of a bicycle for `overlap`.
        """
        group = GROUP[a.label][:, None]
        alike = among & (group == GROUP[b.label][None, :])
        if not alike.any():
            return alike
        same = overlaps(a.box, b.box, alike, self.settings.overlap)
        walkers = alike & (group == 1)
        return same | (centred(a.box, b.box) & walkers) if walkers.any() else same

    def _numbered(self, bank: Bank) -> Bank:
        """Return the tracks with numbers for those that are confirmed now.

        A number belongs to the detection that started the track, so it survives filtering again.
        """
        enough = (bank.evidence >= self.settings.confirm_evidence) & (bank.hits >= bank.needed)
        new = np.flatnonzero((bank.number < 0) & enough)
        if not len(new):
            return bank
        number = bank.number.copy()
        for row in new:
            number[row] = self._numbers.setdefault(int(bank.birth[row]), len(self._numbers))
        return replace(bank, number=number)

    def _merged(self, bank: Bank) -> Bank:
        """Return the tracks without those that overlap another one of their group and of which only one is seen now.

        The motion of the one that is seen stays; a tentative one inherits number and history.
        """
        seen = bank.seen_s == bank.time_s
        if seen.all():
            return bank
        lost, found = np.flatnonzero(~seen), np.flatnonzero(seen)
        label, box = bank.label, bank.box
        gone, present = (_Place(label[rows], box[rows]) for rows in (lost, found))
        same = self._in_one_place(gone, present, np.ones((len(lost), len(found)), bool))
        if not same.any():
            return bank
        source, keep = np.arange(len(seen)), np.ones(len(seen), bool)
        for row in np.flatnonzero(same.any(axis=1)):
            old = lost[row]
            new = next((track for track in found[same[row]] if keep[track]), None)
            if new is not None and bank.number[old] >= 0 and bank.number[new] < 0:
                source[old], keep[new] = new, False
            else:
                keep[old] = False
        taken = bank[source]
        known = taken.counts > 0
        merged = replace(
            taken,
            sizes=np.where(known[:, :, None], taken.sizes, bank.sizes),
            counts=np.where(known, taken.counts, bank.counts),
            votes=bank.votes,
            evidence=np.maximum(bank.evidence, taken.evidence),
            score=np.maximum(bank.score, taken.score),
            birth=bank.birth,
            number=bank.number,
        )
        return merged[keep]

    def _tracks(self, time_s: float) -> Tracks:
        """Return the confirmed tracks at the present."""
        order = np.argsort(self._bank.number, kind="stable")
        rows = order[self._bank.number[order] >= 0]
        confirmed = self._bank if np.array_equal(rows, np.arange(len(self._bank))) else self._bank[rows]
        bank, _ = self._predicted(confirmed, max(time_s, confirmed.time_s))
        return _as_tracks(bank, time_s, bank.number)


def _as_tracks(bank: Bank, time_s: float, number: Integers) -> Tracks:
    """Return tracks at an instant under their numbers (N,)."""
    box, mean, covariance = bank.box, bank.state.mean, bank.state.covariance
    xx, yy, xy = covariance[:, 0, 0], covariance[:, 1, 1], covariance[:, 0, 1]
    largest = 0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)
    return Tracks(
        time_s=time_s,
        boxes=Boxes(box[:, :3], box[:, 3:6], box[:, 6], bank.label, number),
        velocity=mean[:, VX : VY + 1].copy(),
        yaw_rate=mean[:, RATE].copy(),
        position_sd=np.sqrt(largest),
        score=bank.score,
        unseen_s=np.maximum(time_s - bank.seen_s, 0.0),
    )


def _columns(motion: Motion) -> list[float]:
    """Return the values of a kind of road user in the order of `Parameters`."""
    values = msgspec.structs.asdict(motion)
    return [np.inf if values[name] is None else values[name] for name in Parameters._fields]
