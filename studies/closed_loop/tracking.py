"""What the tracker makes of percepts: false tracks, late ones, and those of conflict actors, from logs of episodes.

The percepts of each log are tracked again, with the settings of the tracker and with changed ones. A box or track is
of a road user if its centre lies within it or 1 m beside it. The ego drives as it did. What each detector, named by its
hash, knew of the conflict actor of an encounter is counted as driven; a box within 2 m is of it, as for `seen_s`.

The folder is that of `dsrc drive CAMPAIGN.toml --out runs/real`.

Usage:
    python -m studies.closed_loop.tracking runs/real
    python -m studies.closed_loop.tracking runs/real --set confirm_evidence=1 --set ghosts_per_m2=0.03
    python -m studies.closed_loop.tracking runs/closed-loop --seed 10 11 --docs docs/closed_loop_results.md
    python -m studies.closed_loop.tracking runs/snow --scenario stalled_after_curve
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

import dsrc
from dsrc.closed_loop.metrics.sight import CONFLICT, MATCH_M
from dsrc.closed_loop.tracking.settings import TrackerSettings
from dsrc.closed_loop.tracking.tracker import Tracker
from dsrc.closed_loop.types import Percept, Tick
from sim.boxes import Boxes
from sim.errors import UserError
from sim.traffic.base import Actors
from studies.look import put_table

BESIDE_M, ROUTE_M, MOVING_MPS = 1.0, 30.0, 1.0
"""Distance from a road user at which a box is of it; distance from the route and speed of what matters there."""
LATE_S = 3.0
"""Upper bound of a delay; road users with a first box later than this before the end are left out."""
HEAD = (
    "tracker",
    "instants",
    "false tracks",
    "moving near the route",
    "boxed and tracked, %",
    "delay, s",
    "over 3 s, %",
)
SIGHT_HEAD = (
    "perception",
    "condition",
    "episodes",
    "percepts with a box of it, %",
    "median score",
    "tracked, % of the time",
)
SCORES = (0.0, 0.1, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.7, 1.0)


@dataclass(slots=True)
class Counts:
    """Counts over the instants of some episodes.

    Attributes:
        instants: number of them.
        false: false tracks.
        matter: false tracks that move near the route.
        boxed: road users with a box in the percept of an instant.
        tracked: those of them with a track.
        delays: time from the first box to the first track of each road user, s.
    """

    instants: int = 0
    false: int = 0
    matter: int = 0
    boxed: int = 0
    tracked: int = 0
    delays: list[float] = field(default_factory=list)


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("episodes", type=Path, help="folder of `dsrc drive --out`")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="changed setting, alone")
    parser.add_argument("--seed", type=int, nargs="+", metavar="SEED", help="seeds of the episodes; default: all")
    parser.add_argument("--scenario", nargs="+", metavar="NAME", help="scenarios of the episodes; default: all")
    parser.add_argument("--docs", type=Path, help="Markdown document that gets the tables, between their markers")
    options = parser.parse_args()
    try:
        variants = {"as it is": TrackerSettings()} | {change: changed(change) for change in options.set}
    except ValueError as error:
        parser.error(f"--set: {error}")
    try:
        logs = [dsrc.EpisodeLog.load(path) for path in sorted((options.episodes / "episodes").glob("*.npz"))]
        wanted = set(options.seed or [log.settings.seed for log in logs])
        logs = [log for log in logs if log.settings.detector and log.settings.seed in wanted]
        if not logs:
            parser.error(f"{options.episodes}: expected episodes of a detector, found none with these seeds")
        there = {log.settings.scenario.name for log in logs}
        named = set(options.scenario or there)
        if unknown := sorted(named - there):
            parser.error(f"--scenario: expected some of {', '.join(sorted(there))}, found {', '.join(unknown)}")
        logs = [log for log in logs if log.settings.scenario.name in named]
        clean = [log for log in logs if log.settings.corruption == "clean"]
        parts = {"clean": clean, "corrupted": [log for log in logs if log.settings.corruption != "clean"]}
        put_table(options.docs, "boxes_by_score", ["score", "boxes", "of a road user, %"], by_score(logs))
        rows = [
            row(f"{title}, {name}", count(part, settings))
            for title, part in parts.items()
            if part
            for name, settings in variants.items()
        ]
        put_table(options.docs, "tracks", HEAD, rows)
        if sights := by_perception(logs):
            put_table(options.docs, "conflict_actors", SIGHT_HEAD, sights)
    except UserError as error:
        parser.error(str(error))


def changed(change: str) -> TrackerSettings:
    """Return the settings with one number changed."""
    name, _, value = change.partition("=")
    try:
        number = float(value)
    except ValueError:
        number = float("nan")
    if not (isinstance(getattr(TrackerSettings(), name, None), float) and np.isfinite(number)):
        raise ValueError(f"expected NAME=VALUE, a number of TrackerSettings, found {change}")
    return msgspec.structs.replace(TrackerSettings(), **{name: number})


def by_score(logs: Sequence[dsrc.EpisodeLog]) -> list[list[str]]:
    """Return the boxes between two scores and the share that is of a road user; boxes of the ego do not count."""
    scores, true = [np.zeros(0)], [np.zeros(0, bool)]
    for log in logs:
        for percept, there, own in measured(log).values():
            boxes = percept.boxes
            of_others = np.flatnonzero(~of_road_users(boxes, own).any(axis=0))
            scores.append(percept.score[of_others])
            true.append(of_road_users(boxes, there).any(axis=0)[of_others])
    score, is_true = np.concatenate(scores), np.concatenate(true)
    found = []
    for low, high in pairwise(SCORES):
        inside = (score >= low) & ((score < high) | (high == SCORES[-1]))
        if inside.any():
            found.append([f"{low:g} to {high:g}", str(int(inside.sum())), f"{100.0 * is_true[inside].mean():.0f}"])
    return found


def measured(log: dsrc.EpisodeLog) -> dict[float, tuple[Percept, Boxes, Boxes]]:
    """Return the percepts by arrival, with the other road users and the ego when they were measured."""
    then = {round(tick.actors.time_s, 6): tick.actors.boxes for tick in log.ticks}
    found = {}
    for tick in log.ticks:
        if (percept := tick.percept) is not None:
            boxes = then.get(round(percept.time_s, 6), tick.actors.boxes)
            ego = boxes.object_id == log.settings.ego_id
            found[tick.ego.time_s] = percept, boxes[~ego], boxes[ego]
    return found


def count(logs: Sequence[dsrc.EpisodeLog], settings: TrackerSettings) -> Counts:
    """Return what the tracker makes of the percepts of episodes."""
    counts = Counts()
    for log in logs:
        tracker, ego_id = Tracker(settings), log.settings.ego_id
        boxed = {
            time_s: set(there.object_id[of_road_users(percept.boxes, there).any(axis=1)].tolist())
            for time_s, (percept, there, _) in measured(log).items()
        }
        seen: dict[int, float] = {}
        known: dict[int, float] = {}
        for tick in log.ticks:
            time_s, there = tick.ego.time_s, tick.actors.boxes[tick.actors.boxes.object_id != ego_id]
            tracks = tracker.update(tick.percept, time_s)
            of_whom = of_road_users(tracks.boxes, there)
            false = ~of_whom.any(axis=0) & ~of_road_users(tracks.boxes, tick.ego.box).any(axis=0)
            moves = np.hypot(*tracks.velocity.T) > MOVING_MPS
            counts.instants += 1
            counts.false += int(false.sum())
            counts.matter += int((false & moves & near_route(tracks.boxes, tick)).sum())
            tracked = set(there.object_id[of_whom.any(axis=1)].tolist())
            for one in tracked:
                known.setdefault(one, time_s)
            for one in boxed.get(time_s, ()):
                seen.setdefault(one, time_s)
            counts.boxed += len(boxed.get(time_s, ()))
            counts.tracked += len(boxed.get(time_s, set()) & tracked)
        last_s = log.ticks[-1].ego.time_s - LATE_S
        early = {one: at for one, at in seen.items() if at <= last_s}
        counts.delays += [min(max(known.get(one, np.inf) - at, 0.0), LATE_S) for one, at in early.items()]
    return counts


def by_perception(logs: Sequence[dsrc.EpisodeLog]) -> list[list[str]]:
    """Return how well each detector knows the conflict actor under each condition, from the first box of it on."""
    parts: dict[tuple[str, str], list[dsrc.EpisodeLog]] = {}
    for log in logs:
        if any(CONFLICT in tick.actors.name for tick in log.ticks):
            about = log.settings
            condition = f"{about.corruption} {about.severity}" if about.severity else about.corruption
            parts.setdefault((f"{about.perception} {about.detector[:8]}", condition), []).append(log)
    found = []
    for (perception, condition), part in sorted(parts.items()):
        scores, tracked = [np.zeros(0)], [np.zeros(0, bool)]
        for log in part:
            score, known = sight_of_conflict(log)
            scores.append(score)
            tracked.append(known)
        score, known = np.concatenate(scores), np.concatenate(tracked)
        median = f"{np.median(score[score > 0]):.2f}" if (score > 0).any() else "-"
        shares = [f"{100.0 * one.mean():.0f}" if len(one) else "-" for one in (score > 0, known)]
        found.append([perception, condition, str(len(part)), shares[0], median, shares[1]])
    return found


def sight_of_conflict(log: dsrc.EpisodeLog) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return what a perception knew of the conflict actor, from the first percept with a box of it on.

    Returns:
        score: best score of its boxes in each percept; 0 without one.
        tracked: whether it had a track, at each instant.
    """
    then = {round(tick.actors.time_s, 6): tick.actors for tick in log.ticks}
    scores, tracked = [], []
    for tick in log.ticks:
        if (percept := tick.percept) is not None:
            score = percept.score[of_conflict(percept.boxes, then.get(round(percept.time_s, 6), tick.actors))]
            if len(score) or scores:
                scores.append(score.max(initial=0.0))
        if scores:
            tracked.append(bool(of_conflict(tick.tracks.boxes, tick.actors).any()))
    return np.array(scores, float), np.array(tracked, bool)


def of_conflict(boxes: Boxes, actors: Actors) -> NDArray[np.bool_]:
    """Return the mask of boxes of the conflict actor, as `seen_s` of the results counts them: within `MATCH_M`."""
    if CONFLICT not in actors.name:
        return np.zeros(len(boxes), bool)
    at = actors.name.index(CONFLICT)
    return np.asarray(np.linalg.norm(boxes.center[:, :2] - actors.boxes.center[at, :2], axis=1) <= MATCH_M)


def row(title: str, counts: Counts) -> list[str]:
    """Return the line of a table."""
    delays = np.array(counts.delays)
    numbers = (
        f"{counts.false / counts.instants:.2f}",
        f"{counts.matter / counts.instants:.2f}",
        f"{100.0 * counts.tracked / max(counts.boxed, 1):.0f}",
        f"{delays.mean():.2f}" if len(delays) else "-",
        f"{100.0 * (delays >= LATE_S).mean():.0f}" if len(delays) else "-",
    )
    return [title, str(counts.instants), *numbers]


def of_road_users(boxes: Boxes, bodies: Boxes) -> NDArray[np.bool_]:
    """Return the (N, M) mask of boxes (M) whose centres lie in bodies (N) or beside them, seen from above."""
    flat = np.array([1.0, 1.0, 0.0])
    return replace(bodies, center=bodies.center * flat).contains(boxes.center * flat, BESIDE_M)


def near_route(boxes: Boxes, tick: Tick) -> NDArray[np.bool_]:
    """Return the mask of boxes near the ego's route."""
    offset = boxes.center[:, None, :2] - tick.ego.route[None]
    return np.asarray((np.hypot(offset[..., 0], offset[..., 1]) < ROUTE_M).any(axis=1))


if __name__ == "__main__":
    main()
