"""When the ego came to know of the conflict actor, and how old what it knew was: percepts and tracks against truth."""

import math

import msgspec
import numpy as np

from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.metrics.driven import Motion
from dsrc.closed_loop.metrics.surrogate import times_to_collision
from dsrc.closed_loop.types import Tick
from sim.boxes import Boxes
from sim.traffic.base import Actors

CONFLICT = "conflict"
"""Name of the conflict actor in the traffic of an encounter."""
MATCH_M = 2.0
"""Largest distance of centres of a box and the actor that it is taken for: as nuScenes matches, and below a lane."""


class Sight(msgspec.Struct, frozen=True, kw_only=True):
    """First sight of the conflict actor; all NaN without one, or if it was never seen.

    Attributes:
        seen_s: time from the first step to the first percept that has a box of it, s; when it arrived, not when it was
            measured.
        seen_ttc_s: time to collision with it then, at constant velocities, s; inf if they were not to meet.
        tracked_s: time from the first step to its first confirmed track, s.
    """

    seen_s: float
    seen_ttc_s: float
    tracked_s: float


def first_sight(log: EpisodeLog) -> Sight:
    """Return when the perception of an episode first had the conflict actor.

    Of the ego for a perception that uses no messages, of the team for one that does: the difference of two episodes of
    one seed is the lead that cooperation gives.
    """
    seen_s = seen_ttc_s = tracked_s = math.nan
    truth = {round(tick.actors.time_s, 6): tick.actors for tick in log.ticks}
    for tick in log.ticks:
        since_s = tick.actors.time_s - log.ticks[0].actors.time_s
        percept = tick.percept
        if math.isnan(seen_s) and percept is not None:
            then = truth.get(round(percept.time_s, 6), tick.actors)
            if _has(percept.boxes, then):
                seen_s, seen_ttc_s = since_s, _time_to_collision(tick, log.settings.ego_id)
        if math.isnan(tracked_s) and _has(tick.tracks.boxes, tick.actors):
            tracked_s = since_s
    return Sight(seen_s=seen_s, seen_ttc_s=seen_ttc_s, tracked_s=tracked_s)


def tracking_loss(log: EpisodeLog) -> float:
    """Return the risk of tracking loss: the integral of the risk over the time in which road users have no track.

    The risk of each is the inverse of its time to collision with the ego at constant velocities, 1/s, or none beyond
    10 s; a step counts up to the inverse of its length. The integral over all is without unit.

    Source: A. Wang, T. Xie, F. Wen and J. Li, An empirical analysis of cooperative perception for occlusion risk
    mitigation, IEEE Internet of Things Journal (2026), arXiv 2602.23051, for the integral; the inverse of the time to
    collision as the risk is our choice.
    """
    motion, step_s, found = Motion.of(log), log.actors.step_s, 0.0
    for t, tick in zip(range(len(motion)), log.ticks, strict=False):
        others, velocity = motion.others(t)
        apart = others.center[:, None, :2] - tick.tracks.boxes.center[None, :, :2]
        lost = np.asarray((np.hypot(apart[..., 0], apart[..., 1]) > MATCH_M).all(axis=1))
        times = times_to_collision(motion.boxes[t : t + 1], motion.velocity[t], others[lost], velocity[lost])
        found += float((step_s / np.maximum(times, step_s)).sum())
    return found


def _has(boxes: Boxes, actors: Actors) -> bool:
    if CONFLICT not in actors.name or not len(boxes):
        return False
    place = actors.boxes.center[actors.name.index(CONFLICT), :2]
    return bool((np.linalg.norm(boxes.center[:, :2] - place, axis=1) <= MATCH_M).any())


def _time_to_collision(tick: Tick, ego_id: int) -> float:
    actors = tick.actors
    if CONFLICT not in actors.name or ego_id not in actors.boxes.object_id:
        return math.nan
    ego, other = actors.row(ego_id), actors.name.index(CONFLICT)
    boxes, velocity = actors.boxes, actors.velocity
    times = times_to_collision(
        boxes[ego : ego + 1], velocity[ego], boxes[other : other + 1], velocity[other : other + 1]
    )
    return float(times[0])


class Information(msgspec.Struct, frozen=True, kw_only=True):
    """Age and volume of what the driver decided on.

    Attributes:
        age_s: time since the measurement of the newest percept, mean over the decisions, s; NaN without a percept.
        message_age_s: that of the newest message used from each helper at its measurement, mean, s; NaN without one.
        received_mb: bytes of the messages that arrived, MB.
        sent_mb: bytes on air, MB.
    """

    age_s: float
    message_age_s: float
    received_mb: float
    sent_mb: float


def information(log: EpisodeLog) -> Information:
    """Return the age of information at the decisions of an episode, and the bytes that it took.

    A message counts once, however long it is used; of one that was cut into packets count those that arrived.

    Source: S. Kaul, R. Yates and M. Gruteser, Real-time status: How often should one update?, INFOCOM 2012, for the
    age: the time since the newest information that has arrived was true.
    """
    ages, message_ages, sent, newest_s = [], [], 0.0, math.nan
    received: dict[tuple[int, int, int], float] = {}
    for tick in log.ticks:
        if tick.percept is not None:
            newest_s = tick.percept.time_s
            for link in tick.percept.links:
                sent += link.bytes_now
                if link.received:
                    message_ages.append(link.age_s)
                    received[link.sender, link.receiver, link.sent] = link.bytes * float(link.arrived.mean())
        if not math.isnan(newest_s):
            ages.append(tick.actors.time_s - newest_s)
    return Information(
        age_s=float(np.mean(ages)) if ages else math.nan,
        message_age_s=float(np.mean(message_ages)) if message_ages else math.nan,
        received_mb=1e-6 * sum(received.values()),
        sent_mb=1e-6 * sent,
    )
