"""Driving score of the CARLA leaderboard, versions 2.0 and 2.1: route completion times a penalty of infractions."""

import msgspec

from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.types import Outcome
from sim.boxes import CLASSES


class Infractions(msgspec.Struct, frozen=True, kw_only=True):
    """Infractions of an episode.

    Attributes:
        pedestrian, vehicle, static: collisions with each; a bicycle is a vehicle, as in CARLA.
        red_light: red lights run.
        stop_sign: stop signs run.
        timeout: encounters that were not passed in time.
        emergency: emergency vehicles that were not let by.
        speed_share: share of the required minimum speed that was reached, 0 to 1; 1 where none is required.
        off_lane_share: share of the route driven outside its lanes, 0 to 1.
    """

    pedestrian: int = 0
    vehicle: int = 0
    static: int = 0
    red_light: int = 0
    stop_sign: int = 0
    timeout: int = 0
    emergency: int = 0
    speed_share: float = 1.0
    off_lane_share: float = 0.0


_FACTORS = {
    "pedestrian": 0.50, "vehicle": 0.60, "static": 0.65, "red_light": 0.70, "stop_sign": 0.80, "timeout": 0.70,
    "emergency": 0.70,
}  # fmt: skip
_SLOW_FACTOR = 0.70
_PENALTIES = {
    "pedestrian": 1.0, "vehicle": 0.7, "static": 0.6, "red_light": 0.4, "stop_sign": 0.25, "timeout": 0.4,
    "emergency": 0.4,
}  # fmt: skip
_SLOW_PENALTY = 0.4


def driving_score_2_0(completion: float, infractions: Infractions) -> float:
    """Return the driving score of leaderboard 2.0, 0 to 1: every infraction multiplies it by its factor.

    Source: `statistics_manager.py`, branch `leaderboard-2.0`; what is driven outside the lanes does not count.

    Args:
        completion: share of the route driven, 0 to 1.
    """
    score = completion * (1.0 - infractions.off_lane_share)
    for name, factor in _FACTORS.items():
        score *= factor ** getattr(infractions, name)
    return score * (1.0 - (1.0 - _SLOW_FACTOR) * (1.0 - infractions.speed_share))


def driving_score_2_1(completion: float, infractions: Infractions) -> float:
    """Return the driving score of leaderboard 2.1, 0 to 1: penalties add up in a denominator.

    An infraction more never pays, however many there were: to stop early for fewer of them is no longer rewarded.

    Source: `statistics_manager.py`, branch `leaderboard-2.1` (March 2025).

    Args:
        completion: share of the route driven, 0 to 1.
    """
    penalty = sum(weight * getattr(infractions, name) for name, weight in _PENALTIES.items())
    penalty += _SLOW_PENALTY * (1.0 - infractions.speed_share)
    return completion * (1.0 - infractions.off_lane_share) / (1.0 + penalty)


def infractions_of(log: EpisodeLog) -> Infractions:
    """Return the infractions of an episode.

    A contact counts whoever is at fault. Only an encounter has a time limit to pass it; stop signs, emergency vehicles
    and a minimum speed are not in our worlds.
    """
    kind = "" if log.contact is None else "static"
    if log.contact is not None and log.contact.other_id >= 0:
        actors = next(tick.actors for tick in log.ticks if tick.contact is not None)
        label = CLASSES[int(actors.boxes.label[actors.row(log.contact.other_id)])]
        kind = "pedestrian" if label == "pedestrian" else "vehicle"
    return Infractions(
        pedestrian=int(kind == "pedestrian"),
        vehicle=int(kind == "vehicle"),
        static=int(kind == "static"),
        red_light=red_lights_run(log),
        timeout=int(log.outcome is Outcome.TIMEOUT and log.settings.route_m is not None),
        off_lane_share=off_lane_share(log),
    )


def red_lights_run(log: EpisodeLog) -> int:
    """Return the number of stop lines that the ego's front crossed at red, or at red and yellow."""
    run = 0
    for before, now in zip(log.ticks, log.ticks[1:], strict=False):
        moved = now.ego.progress_m - before.ego.progress_m
        lights = before.ego.lights
        run += sum(one.state in ("red", "red and yellow") and 0.0 <= one.distance_m < moved for one in lights)
    return run


def off_lane_share(log: EpisodeLog) -> float:
    """Return the share of the driven distance that the ego drove off all lanes; 0 where the traffic knows no lanes."""
    ego_id, driven, off = log.settings.ego_id, 0.0, 0.0
    lanes = []
    for before, now in zip(log.ticks, log.ticks[1:], strict=False):
        if ego_id not in now.actors.boxes.object_id:
            break
        moved = now.ego.progress_m - before.ego.progress_m
        lanes.append(now.actors.lane[now.actors.row(ego_id)])
        driven += moved
        off += moved * (lanes[-1] == "")
    return off / driven if driven > 0.0 and any(lanes) else 0.0
