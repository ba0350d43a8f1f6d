"""Cause of a crash, in one sentence: what came too late between the road user and the brake, from the episode's log.

The last chance is the last step from which full braking avoids the crash, see `dsrc.closed_loop.causes.braking`. What
had to happen before it, in this order: a LiDAR sees the road user, a percept has a box of it, a track is confirmed, the
driver brakes. The first of these that came after the last chance is the cause.
"""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, get_args

import msgspec
import numpy as np

from dsrc.closed_loop.causes.braking import last_chance
from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.metrics.lies import for_nobody
from dsrc.closed_loop.metrics.sight import MATCH_M
from dsrc.closed_loop.types import Outcome, Tick
from sim.boxes import CLASSES, Boxes
from sim.traffic.base import Actors

Kind = Literal[
    "unavoidable",
    "missed",
    "seen late",
    "tracked late",
    "braked late",
    "braked too little",
    "told wrongly",
    "hit from behind",
    "hit the world",
]
KINDS: tuple[Kind, ...] = get_args(Kind)

FULL = 0.9
"""Share of the full brake from which on a driver brakes fully."""
_GAP = 2
"""Steps for which a track may be away from its road user, as it is while the filter turns."""
_TOLD_S = 3.0
"""Time before a crash within which a decision for somebody who does not exist is its cause, s."""

InSight = Callable[[Actors, int], bool]
"""Whether a LiDAR of the perception sees a road user: (actors now, object id)."""


class Cause(msgspec.Struct, frozen=True, kw_only=True):
    """Cause of a crash; times are seconds before the crash, None for what never happened.

    Attributes:
        kind: see `cause_of`.
        sentence: it in words.
        late_s: how long after the last chance came what the kind names, s; None where it never came, or is no delay.
        chance_s: the last step from which full braking avoids the crash; None where there was none.
        sight_s: the first sight of it of a LiDAR of the perception.
        seen_s: the arrival of the first percept with a box of it.
        tracked_s: the first confirmed track of it.
        braked_s: the first full braking after that.
    """

    kind: Kind
    sentence: str
    late_s: float | None = None
    chance_s: float | None = None
    sight_s: float | None = None
    seen_s: float | None = None
    tracked_s: float | None = None
    braked_s: float | None = None


def cause_of(log: EpisodeLog, in_sight: InSight) -> Cause | None:
    """Return the cause of the crash that an episode ended in; None where it did not crash.

    * `hit the world`: the other is no road user.
    * `told wrongly`: in the last seconds the driver's decision was for a road user that only a helper's false report
      has.
    * `hit from behind`: the ego stood, or was touched at its rear; braking is no way out of that.
    * `unavoidable`: the last chance was before any LiDAR saw the road user, or there was none.
    * `missed`: in sight before the last chance, and no percept has a box of it before the crash.
    * `seen late`, `tracked late`, `braked late`: the first percept, the first track of those that held at the last
      chance, or the full braking, came after the last chance.
    * `braked too little`: full braking was asked for in time, and was given up or did not act in full.

    Args:
        in_sight: lines of sight of the perception's LiDARs; those of all agents for one that uses messages.
    """
    contact = log.contact
    if log.outcome is not Outcome.CRASHED or contact is None:
        return None
    if contact.other_id < 0:
        return Cause(kind="hit the world", sentence="hit the world: the ego left its way and touched what stands there")
    who = _described(log, contact.other_id)
    if (told := _told(log)) is not None:
        return Cause(kind="told wrongly", sentence=f"told wrongly by {told}: drove for a road user that is not there")
    if not contact.at_fault:
        how = "stood" if contact.side != "rear" else "was hit at its rear"
        return Cause(kind="hit from behind", sentence=f"hit by {who}: the ego {how} and had no way out by braking")
    return _late(log, in_sight, contact.other_id, who)


class FirstSteps(NamedTuple):
    """First steps of an episode at which something holds of a road user; None for never.

    Attributes:
        sight: a LiDAR of the perception sees it.
        seen: a percept with a box of it has arrived.
        tracked: it has a confirmed track.
        braked: the driver brakes fully, from its track on and before the last step.
    """

    sight: int | None
    seen: int | None
    tracked: int | None
    braked: int | None


def first_steps(log: EpisodeLog, in_sight: InSight, other_id: int) -> FirstSteps:
    """Return the first steps of sight, percept, track and full braking for a road user.

    Args:
        in_sight: as of `cause_of`.
    """
    last, ticks = len(log) - 1, log.ticks
    seen, tracked = _first_seen(log, other_id), _first(log, lambda tick: _tracks(tick, other_id))
    sight = _first_sight(log, in_sight, other_id, last if seen is None else seen)
    braked = None
    if tracked is not None:
        full = [FULL * tick.ego.limits.deceleration_mps2 for tick in ticks]
        braked = next((k for k in range(tracked, last) if -ticks[k].decision.acceleration_mps2 >= full[k]), None)
    return FirstSteps(sight, seen, tracked, braked)


def _late(log: EpisodeLog, in_sight: InSight, other_id: int, who: str) -> Cause:
    """Return what came after the last chance."""
    last, ticks = len(log) - 1, log.ticks
    chance = last_chance(log)
    sight, seen, tracked, braked = first_steps(log, in_sight, other_id)

    def before(step: int | None) -> float | None:
        if step is None:
            return None
        return round(ticks[last].actors.time_s - ticks[step].actors.time_s, 6)

    def found(kind: Kind, why: str, step: int | None = None) -> Cause:
        late_s = None if step is None or chance is None else round((step - chance) * log.actors.step_s, 6)
        by = "" if late_s is None else f" by {1000.0 * late_s:.0f} ms"
        times = {"chance_s": chance, "sight_s": sight, "seen_s": seen, "tracked_s": tracked, "braked_s": braked}
        return Cause(
            kind=kind,
            sentence=f"{kind}{by}: {why}",
            late_s=late_s,
            **{name: before(step) for name, step in times.items()},
        )

    def ago(step: int | None) -> str:
        return f"{before(step):.1f} s before the crash"

    needed = "full braking could not avoid it at any time" if chance is None else f"the last chance was {ago(chance)}"
    if sight is None:
        return found("unavoidable", f"{who} was hidden until the crash; {needed}")
    if chance is None or sight > chance:
        return found("unavoidable", f"{who} came into sight {ago(sight)}; {needed}")
    if seen is None:
        return found("missed", f"{who} was in sight from {ago(sight)} on, and no percept had a box of it; {needed}")
    if seen > chance:
        return found("seen late", f"{who} came into sight {ago(sight)}, the first box {ago(seen)}; {needed}", seen)
    if tracked is None:
        return found("tracked late", f"{who} had its first box {ago(seen)}, and never a track; {needed}")
    if tracked > chance:
        why = f"{who} had its first box {ago(seen)}, its track {ago(tracked)}; {needed}"
        return found("tracked late", why, tracked)
    if not any(_tracks(tick, other_id) for tick in ticks[max(chance - _GAP, tracked) : chance + 1]):
        again = next((k for k in range(chance + 1, last + 1) if _tracks(ticks[k], other_id)), None)
        back = "never came back" if again is None else f"came back {ago(again)}"
        return found("tracked late", f"the track of {who} was lost, and {back}; {needed}", again)
    if braked is None:
        return found("braked late", f"{who} had its track {ago(tracked)}, the driver never braked fully; {needed}")
    if braked > chance:
        why = f"{who} had its track {ago(tracked)}, full braking began {ago(braked)}; {needed}"
        return found("braked late", why, braked)
    why = f"full braking for {who} was asked for {ago(braked)}, in time, and was given up or did not act; {needed}"
    return found("braked too little", why)


def _told(log: EpisodeLog) -> str | None:
    """Return who reported the road user that the last decisions were for, if it does not exist; None for nobody."""
    end_s = log.ticks[-1].actors.time_s
    for step in range(len(log) - 1, -1, -1):
        tick = log.ticks[step]
        if end_s - tick.actors.time_s > _TOLD_S:
            return None
        if for_nobody(tick, log.settings.ego_id) and (liars := _liars(log.ticks[: step + 1])) is not None:
            return liars
        rows = np.flatnonzero(tick.tracks.boxes.object_id == tick.decision.track)
        if not len(rows) or not tick.claims:
            continue
        place = tick.tracks.boxes.center[rows[0], :2]
        others = tick.actors.boxes[tick.actors.boxes.object_id != log.settings.ego_id]
        if (np.linalg.norm(others.center[:, :2] - place, axis=1) <= _reach(others)).any():
            continue
        for name, claimed in tick.claims.items():
            if (np.linalg.norm(claimed.boxes.center[:, :2] - place, axis=1) <= _reach(claimed.boxes)).any():
                row = tick.actors.name.index(name) if name in tick.actors.name else None
                return name if row is None else f"helper {tick.actors.boxes.object_id[row]}"
    return None


def _liars(ticks: Sequence[Tick]) -> str | None:
    """Return whose false objects the newest percept believed; None for nobody's."""
    newest = next((tick.percept for tick in reversed(ticks) if tick.percept is not None), None)
    liars = [] if newest is None else [str(one.sender) for one in newest.told if one.false > one.false_refused]
    return f"helper{'s' if len(liars) > 1 else ''} {' and '.join(liars)}" if liars else None


def _reach(boxes: Boxes) -> np.ndarray:
    """Return the (N,) largest distances of centres of a box and the road user that it is of, m."""
    return np.maximum(MATCH_M, 0.5 * boxes.size[:, 0])


def _has(found: Boxes, actors: Actors, object_id: int) -> bool:
    """Return whether some boxes have one of a road user."""
    if object_id not in actors.boxes.object_id or not len(found):
        return False
    row = actors.row(object_id)
    own = actors.boxes[row : row + 1]
    return bool((np.linalg.norm(found.center[:, :2] - own.center[0, :2], axis=1) <= _reach(own)[0]).any())


def _tracks(tick: Tick, object_id: int) -> bool:
    return _has(tick.tracks.boxes, tick.actors, object_id)


def _first(log: EpisodeLog, holds: Callable[[Tick], bool]) -> int | None:
    return next((k for k, tick in enumerate(log.ticks) if holds(tick)), None)


def _first_seen(log: EpisodeLog, object_id: int) -> int | None:
    """Return the step at which the first percept with a box of a road user arrived."""
    truth = {round(tick.actors.time_s, 6): tick.actors for tick in log.ticks}

    def holds(tick: Tick) -> bool:
        if tick.percept is None:
            return False
        then = truth.get(round(tick.percept.time_s, 6), tick.actors)
        return _has(tick.percept.boxes, then, object_id)

    return _first(log, holds)


def _first_sight(log: EpisodeLog, in_sight: InSight, object_id: int, until: int) -> int | None:
    """Return the first step with a road user in sight, at most that of its first box; None for none."""
    for step, tick in enumerate(log.ticks[: until + 1]):
        boxes = tick.percept.boxes if tick.percept is not None else Boxes.zeros()
        if object_id in tick.actors.boxes.object_id and (
            in_sight(tick.actors, object_id) or _has(boxes, tick.actors, object_id)
        ):
            return step
    return None


def _described(log: EpisodeLog, object_id: int) -> str:
    actors = log.ticks[-1].actors
    row = actors.row(object_id)
    kind = CLASSES[int(actors.boxes.label[row])]
    return f"the {kind} {object_id}"
