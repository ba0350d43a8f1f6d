"""Predictive driver model score of NAVSIM (PDMS), of the trajectory that the ego drove.

NAVSIM scores four seconds of a plan against recorded traffic; here it is the whole drive in traffic that reacts. Two
terms differ: for want of a map the drivable area are the lanes of the traffic, and every place counts as an
intersection, so the time to collision minds all but those who are behind the ego now.

Of the extended score (EPDMS, NAVSIM v2) two terms are left out: driving direction, since a log does not tell the
directions of lanes, and extended comfort, which compares plans that follow one another, since a log has none. Its
filter of what the human driver did as well has no counterpart.
"""

import math

import msgspec
import numpy as np

from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.metrics.comfort import comfort
from dsrc.closed_loop.metrics.driven import Motion
from dsrc.closed_loop.metrics.driving_score import off_lane_share, red_lights_run
from dsrc.closed_loop.metrics.progress import progress
from dsrc.closed_loop.types import Outcome
from sim.boxes import Boxes
from sim.collisions import collide
from sim.geometry import wrap_angle

AHEAD_S = (0.0, 0.3, 0.6, 0.9)
"""Times ahead at which collisions of the ego's projection are looked for, within 1 s."""
STANDING_MPS = 0.005
BEHIND_RAD = math.radians(150.0)
ASIDE_M, ASIDE_S = 0.5, 2.0
"""Distance from the middle of its lane, and for how long, from which on the ego does not keep it."""
LEAST_REFERENCE_M = 5.0
"""Reference distance up to which progress is complete."""


class Pdms(msgspec.Struct, frozen=True, kw_only=True):
    """Terms of the score.

    Attributes:
        no_collision: 1 without a collision at fault, 0.5 with one with the static world, 0 with a road user (NC).
        drivable: 1 if the ego stayed on the road, else 0 (DAC).
        time_to_collision: 1 if no projection collides within 1 s, else 0 (TTC).
        progress: 0 to 1 (EP).
        comfortable: 1 within all bounds, else 0 (C; HC of the extended score); 1 for an episode too short to tell.
        lights: 1 without a red light run, else 0 (TLC).
        lane_keeping: 0 if the ego was more than 0.5 m beside its route for 2 s, else 1; steps within junctions neither
            count nor end a time beside (LK).
    """

    no_collision: float
    drivable: float
    time_to_collision: float
    progress: float
    comfortable: float
    lights: float = 1.0
    lane_keeping: float = 1.0

    @property
    def score(self) -> float:
        """NC DAC (5 TTC + 5 EP + 2 C) / 12.

        Source: D. Dauner et al., NAVSIM: Data-driven non-reactive autonomous vehicle simulation and benchmarking,
        NeurIPS 2024, equation 1; `docs/metrics.md` of its devkit.
        """
        mean = (5.0 * self.time_to_collision + 5.0 * self.progress + 2.0 * self.comfortable) / 12.0
        return self.no_collision * self.drivable * mean

    @property
    def extended(self) -> float:
        """NC DAC TLC (5 TTC + 5 EP + 2 LK + 2 HC) / 14, without the terms that a log cannot tell, see the module.

        Source: `docs/metrics.md` of NAVSIM's devkit, version 2.
        """
        mean = 5.0 * self.time_to_collision + 5.0 * self.progress + 2.0 * self.lane_keeping + 2.0 * self.comfortable
        return self.no_collision * self.drivable * self.lights * mean / 14.0


def pdms(log: EpisodeLog, reference: EpisodeLog | None = None) -> Pdms:
    """Return the terms of an episode.

    Args:
        reference: for the progress, see `dsrc.closed_loop.metrics.progress`.
    """
    motion, contact = Motion.of(log), log.contact
    made = progress(log, reference)
    fault = contact is not None and contact.at_fault
    smooth = comfort(motion, log.actors.step_s).comfortable
    return Pdms(
        no_collision=(0.5 if contact is not None and contact.other_id < 0 else 0.0) if fault else 1.0,
        drivable=0.0 if log.outcome is Outcome.LEFT or off_lane_share(log) > 0.0 else 1.0,
        time_to_collision=float(_projections_are_free(motion, log.actors.step_s)),
        progress=1.0 if made.reference_m <= LEAST_REFERENCE_M else made.completion,
        comfortable=1.0 if math.isnan(smooth) else smooth,
        lights=float(red_lights_run(log) == 0),
        lane_keeping=float(_longest_aside(log, len(motion)) < math.ceil(ASIDE_S / log.actors.step_s - 1e-9)),
    )


def _longest_aside(log: EpisodeLog, steps: int) -> int:
    """Return the largest number of steps in a row that the ego was beside the line of its route.

    Those within junctions, where SUMO's lanes have names with a colon, are left out, as NAVSIM does: `pdm_scorer.py` of
    its devkit, version 2, skips intersections without setting its count back.
    """
    longest = since = 0
    for tick in log.ticks[:steps]:
        ego, actors = tick.ego, tick.actors
        if actors.lane[actors.row(log.settings.ego_id)].startswith(":"):
            continue
        aside = 0.0
        if len(ego.route) > 2:  # it leads from the ego's centre to its lane
            way, here = ego.route[2] - ego.route[1], ego.box.center[0, :2] - ego.route[1]
            aside = abs(float(way[0] * here[1] - way[1] * here[0])) / max(float(np.hypot(*way)), 1e-6)
        since = since + 1 if aside > ASIDE_M else 0
        longest = max(longest, since)
    return longest


def _projections_are_free(motion: Motion, step_s: float) -> bool:
    """Return whether the ego's box, moved on at its speed, never meets others where they were then.

    Who is behind it now does not count.

    Behind the end of the motion others keep their last velocity.
    """
    end = len(motion) - 1
    for t, speed in enumerate(motion.speed_mps.tolist()):
        if speed < STANDING_MPS:
            continue
        ego = motion.boxes[t : t + 1]
        heading = np.array([math.cos(ego.yaw[0]), math.sin(ego.yaw[0])])
        now, _ = motion.others(t)
        offset = now.center[:, :2] - ego.center[0, :2]
        bearing = np.abs(wrap_angle(np.arctan2(offset[:, 1], offset[:, 0]) - ego.yaw[0]))
        behind = now.object_id[bearing > BEHIND_RAD]
        for ahead_s in AHEAD_S:
            later = t + round(ahead_s / step_s)
            others, velocity = motion.others(min(later, end))
            moved = others.center.copy()
            moved[:, :2] += velocity * (max(later - end, 0) * step_s)
            others = Boxes(moved, others.size, others.yaw, others.label, others.object_id)
            there = ego.center.copy()
            there[0, :2] += speed * ahead_s * heading
            reach = 0.5 * (np.linalg.norm(ego.size) + np.linalg.norm(others.size, axis=1))
            close = np.linalg.norm(others.center - there, axis=1) < reach
            near = others[close & ~np.isin(others.object_id, behind)]
            if len(near) and collide(Boxes(there, ego.size, ego.yaw, ego.label, ego.object_id), near).any():
                return False
    return True
