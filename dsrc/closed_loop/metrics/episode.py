"""Metrics of one episode: a row of a campaign's table, computed from its log alone."""

import itertools
import math

import msgspec

from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.metrics.comfort import comfort
from dsrc.closed_loop.metrics.driven import Motion
from dsrc.closed_loop.metrics.driving_score import driving_score_2_0, driving_score_2_1, infractions_of
from dsrc.closed_loop.metrics.pdms import pdms
from dsrc.closed_loop.metrics.progress import progress
from dsrc.closed_loop.metrics.sight import first_sight, information, tracking_loss
from dsrc.closed_loop.metrics.surrogate import (
    drac,
    exposure,
    headways,
    nearest_distance,
    post_encroachment_time,
    ttc_series,
)
from dsrc.closed_loop.types import Outcome


class EpisodeMetrics(msgspec.Struct, frozen=True, kw_only=True):
    """Metrics of an episode; NaN where undefined, inf for times and distances that nobody came near.

    Attributes:
        duration_s: time driven, s.
        collision: 1 with a contact, else 0.
        at_fault: 1 with a contact at fault, else 0.
        stuck: 1 if it stood until it was ended, else 0.
        impact_mps: closing speed at the contact, m/s; NaN without one.
        ego_impact_mps: the ego's speed just before, m/s; NaN without one.
        delta_v_mps: change of the ego's velocity by the contact, m/s; NaN without one.
        progress_m: distance driven, m.
        completion: share of the reference distance, 0 to 1, see `progress`.
        mean_speed_mps: distance over duration, m/s.
        driving_score_2_0, driving_score_2_1: CARLA's driving scores, 0 to 1.
        pdms, epdms: NAVSIM's scores, 0 to 1; of the extended one what a log tells, see `dsrc.closed_loop.metrics.pdms`.
        comfort: share of steps within all of nuPlan's bounds, 0 to 1.
        worst_discomfort: largest ratio of a signal to its bound.
        hardest_brake_mps2: largest decrease of the ego's speed before a contact, m/s2.
        red_lights: red lights run.
        min_ttc_s: smallest time to collision, s.
        tet_s: time with a TTC below 1.5 s, s.
        tit_s2: integral of what lacked to 1.5 s, s2.
        pet_s: shortest post-encroachment time, s.
        drac_mps2: largest deceleration rate to avoid a crash, m/s2.
        min_headway_s: smallest net time headway, s.
        min_distance_m: smallest distance to a road user before a contact, m.
        seen_s, seen_ttc_s, tracked_s: first sight of the conflict actor, see `Sight`.
        tracking_loss: risk of road users without a track, see `tracking_loss`.
        information_age_s, message_age_s, received_mb, sent_mb: see `Information`.
    """

    duration_s: float
    collision: float
    at_fault: float
    stuck: float
    impact_mps: float
    ego_impact_mps: float
    delta_v_mps: float
    progress_m: float
    completion: float
    mean_speed_mps: float
    driving_score_2_0: float
    driving_score_2_1: float
    pdms: float
    epdms: float
    comfort: float
    worst_discomfort: float
    hardest_brake_mps2: float
    red_lights: float
    min_ttc_s: float
    tet_s: float
    tit_s2: float
    pet_s: float
    drac_mps2: float
    min_headway_s: float
    min_distance_m: float
    seen_s: float
    seen_ttc_s: float
    tracked_s: float
    tracking_loss: float
    information_age_s: float
    message_age_s: float
    received_mb: float
    sent_mb: float


def episode_metrics(log: EpisodeLog, reference: EpisodeLog | None = None) -> EpisodeMetrics:
    """Return the metrics of an episode.

    Args:
        log: of the episode, at least one step.
        reference: episode of the same seed with the truth and without corruption, for the progress.

    Raises:
        ValueError: the log has no step.
    """
    if not log.ticks:
        raise ValueError("expected an episode of at least one step, found none")
    motion, step_s, contact = Motion.of(log), log.actors.step_s, log.contact
    made, infractions = progress(log, reference), infractions_of(log)
    ttc, smooth = ttc_series(motion), comfort(motion, step_s)
    tet_s, tit_s2 = exposure(ttc, step_s)
    duration_s = step_s * (len(log) - 1)
    sight, known, navsim = first_sight(log), information(log), pdms(log, reference)
    return EpisodeMetrics(
        duration_s=duration_s,
        collision=float(contact is not None),
        at_fault=float(contact is not None and contact.at_fault),
        stuck=float(log.outcome is Outcome.STUCK),
        impact_mps=math.nan if contact is None else contact.closing_mps,
        ego_impact_mps=math.nan if contact is None else contact.ego_speed_mps,
        delta_v_mps=math.nan if contact is None else contact.delta_v_mps,
        progress_m=made.driven_m,
        completion=made.completion,
        mean_speed_mps=made.driven_m / duration_s if duration_s > 0.0 else math.nan,
        driving_score_2_0=driving_score_2_0(made.completion, infractions),
        driving_score_2_1=driving_score_2_1(made.completion, infractions),
        pdms=navsim.score,
        epdms=navsim.extended,
        comfort=smooth.share,
        worst_discomfort=smooth.worst,
        hardest_brake_mps2=_hardest_brake(log, len(motion)),
        red_lights=float(infractions.red_light),
        min_ttc_s=float(ttc.min(initial=math.inf)),
        tet_s=tet_s,
        tit_s2=tit_s2,
        pet_s=post_encroachment_time(motion),
        drac_mps2=drac(motion),
        min_headway_s=float(headways(motion, [tick.ego.route for tick in log.ticks]).min(initial=math.inf)),
        min_distance_m=nearest_distance(motion),
        seen_s=sight.seen_s,
        seen_ttc_s=sight.seen_ttc_s,
        tracked_s=sight.tracked_s,
        tracking_loss=tracking_loss(log),
        information_age_s=known.age_s,
        message_age_s=known.message_age_s,
        received_mb=known.received_mb,
        sent_mb=known.sent_mb,
    )


def _hardest_brake(log: EpisodeLog, steps: int) -> float:
    speeds = [tick.ego.speed_mps for tick in log.ticks[:steps]]
    return max((a - b for a, b in itertools.pairwise(speeds)), default=0.0) / log.actors.step_s
