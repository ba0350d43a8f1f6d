"""What lies of helpers did and what was refused of them: metrics of episodes of campaigns with attacks or defences."""

import math

import msgspec
import numpy as np

from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.types import Tick
from dsrc.messages.message import LIES, lie_counts, near_any

_STILL_MPS, _DRIVES_MPS = 0.1, 0.5
"""Speed below which the ego stands, and from which on it drives again, m/s."""


class LieMetrics(msgspec.Struct, frozen=True, kw_only=True):
    """Metrics of lies; all but the first are NaN where no helper's message was read.

    Attributes:
        needless_stops: times that the ego came to stand for a track where no road user is.
        false_told: objects in messages that an attack put where none is, each as often as it was told.
        false_refused: of these, those that the ego refused.
        true_refused: other objects that it refused.
        helpers_honest: helpers whose messages no attack changed.
        helpers_wronged: of these, those of whom it refused something.
    """

    needless_stops: float
    false_told: float
    false_refused: float
    true_refused: float
    helpers_honest: float
    helpers_wronged: float


def lie_metrics(log: EpisodeLog) -> LieMetrics:
    """Return the metrics of an episode, from its log alone."""
    told = [one for tick in log.ticks if tick.percept is not None for one in tick.percept.told]
    counts = zip(LIES, lie_counts(told), strict=True)
    return LieMetrics(
        needless_stops=float(_needless_stops(log)),
        **{name: float(count) if told else math.nan for name, count in counts},
    )


def _needless_stops(log: EpisodeLog) -> int:
    count, drives = 0, False
    for tick in log.ticks:
        if drives and tick.ego.speed_mps < _STILL_MPS:
            count, drives = count + for_nobody(tick, log.settings.ego_id), False
        drives |= tick.ego.speed_mps >= _DRIVES_MPS
    return count


def for_nobody(tick: Tick, ego_id: int) -> bool:
    """Return whether a step's decision was for a track where no road user is."""
    others = tick.actors.boxes[tick.actors.boxes.object_id != ego_id]
    decisive = tick.tracks.boxes[tick.tracks.boxes.object_id == tick.decision.track]
    return bool(len(decisive)) and not np.any(near_any(decisive, others))
