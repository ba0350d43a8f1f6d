"""Progress of an episode against what it could have been."""

import msgspec

from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.types import Outcome


class Progress(msgspec.Struct, frozen=True, kw_only=True):
    """Progress of an episode.

    Attributes:
        driven_m: distance driven, m.
        reference_m: distance that a full episode drives, m.
        completion: driven over reference, 0 to 1; 1 for an episode that arrived.
    """

    driven_m: float
    reference_m: float
    completion: float


def progress(log: EpisodeLog, reference: EpisodeLog | None = None) -> Progress:
    """Return the progress of an episode.

    The reference is the first of these that there is: the way to the goal; what the same driver drove on the same seed
    with the truth and without corruption; what a car drives alone, see `free_flow_m`.

    Args:
        reference: episode of the same seed with the truth.
    """
    driven = log.ticks[-1].ego.progress_m if log.ticks else 0.0
    if log.settings.route_m is not None:
        whole = log.settings.route_m
    elif reference is not None and reference.ticks:
        whole = reference.ticks[-1].ego.progress_m
    else:
        whole = free_flow_m(log)
    if log.outcome is Outcome.ARRIVED or whole <= driven:
        completion = 1.0
    else:
        completion = driven / whole
    return Progress(driven_m=driven, reference_m=whole, completion=completion)


def free_flow_m(log: EpisodeLog) -> float:
    """Return the distance that the ego would have driven alone and without signals over the planned duration, m.

    It accelerates as its limits allow from its first speed to the speed limit that the log has for the same time, after
    its end the last one. The planned duration is `duration_s` of the loop's settings, else that of the log.
    """
    if not log.ticks:
        return 0.0
    step_s = log.actors.step_s
    steps = round(log.settings.loop.get("duration_s", step_s * (len(log) - 1)) / step_s)
    speed, driven = log.ticks[0].ego.speed_mps, 0.0
    for step in range(steps):
        limits = log.ticks[min(step, len(log) - 1)].ego.limits
        speed = min(speed + limits.acceleration_mps2 * step_s, limits.speed_mps)
        driven += speed * step_s
    return driven
