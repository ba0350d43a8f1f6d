"""What the tracker makes of percepts: false tracks, and how late the true ones come, from logs of episodes.

The percepts of each log are tracked again, with the settings of the tracker and with changed ones. A box or track is
of a road user if its centre lies within it or 1 m beside it. Nobody drives differently here: for that, drive again.

The folder is that of `dsrc drive CAMPAIGN.toml --out runs/real`.

Usage:
    python examples/tracking.py runs/real
    python examples/tracking.py runs/real --set confirm_evidence=-1 --set ghosts_per_m2=0.03 --docs docs/closed_loop.md
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
from look import put_table
from numpy.typing import NDArray

import dsrc
from dsrc.closed_loop.tracking.settings import TrackerSettings
from dsrc.closed_loop.tracking.tracker import Tracker
from dsrc.closed_loop.types import Tick
from sim.boxes import Boxes
from sim.errors import UserError

BESIDE_M, ROUTE_M, MOVING_MPS = 1.0, 30.0, 1.0
"""Distance from a road user at which a box is of it; distance from the route and speed of what matters there."""
NEVER_S = 3.0
"""Delay of a road user that is never tracked."""
HEAD = ("tracker", "instants", "false tracks", "moving near the route", "boxed and tracked, %", "delay, s", "never, %")
SCORES = (0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.7, 1.0)


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
    parser.add_argument("--docs", type=Path, help="Markdown document that gets the tables, between their markers")
    options = parser.parse_args()
    try:
        variants = {"as it is": TrackerSettings()} | {change: changed(change) for change in options.set}
    except ValueError as error:
        parser.error(f"--set: expected NAME=VALUE, a number of {TrackerSettings.__name__}, found {error}")
    try:
        logs = [dsrc.EpisodeLog.load(path) for path in sorted((options.episodes / "episodes").glob("*.npz"))]
    except UserError as error:
        parser.error(str(error))
    logs = [log for log in logs if log.settings.detector]
    if not logs:
        parser.error(f"{options.episodes}: expected episodes of a detector, found none")
    clean = [log for log in logs if log.settings.corruption == "clean"]
    parts = {"clean": clean, "corrupted": [log for log in logs if log.settings.corruption != "clean"]}
    put_table(options.docs, "boxes_by_score", ["score", "boxes", "of a road user, %"], by_score(logs))
    rows = [
        row(f"{title}, {name}", count(part, settings))
        for title, part in parts.items()
        if part
        for name, settings in variants.items()
    ]
    head = [
        "tracker",
        "instants",
        "false tracks",
        "moving near the route",
        "boxed and tracked, %",
        "delay, s",
        "never, %",
    ]
    put_table(options.docs, "tracks", head, rows)


def changed(change: str) -> TrackerSettings:
    """Return the settings with one number changed."""
    name, _, value = change.partition("=")
    if not isinstance(getattr(TrackerSettings(), name, None), float):
        raise ValueError(change)
    return msgspec.structs.replace(TrackerSettings(), **{name: float(value)})


def by_score(logs: Sequence[dsrc.EpisodeLog]) -> list[list[str]]:
    """Return the boxes between two scores and the share that is of a road user."""
    scores, true = [np.zeros(0)], [np.zeros(0, bool)]
    for log in logs:
        for tick in log.ticks:
            if tick.percept is not None:
                scores.append(tick.percept.score)
                true.append(of_road_users(tick.percept.boxes, others(tick, log.settings.ego_id)).any(axis=0))
    score, is_true = np.concatenate(scores), np.concatenate(true)
    found = []
    for low, high in pairwise(SCORES):
        inside = (score >= low) & (score < high)
        share = f"{100.0 * is_true[inside].mean():.0f}" if inside.any() else "-"
        found.append([f"{low:g} to {high:g}", str(int(inside.sum())), share])
    return found


def count(logs: Sequence[dsrc.EpisodeLog], settings: TrackerSettings) -> Counts:
    """Return what the tracker makes of the percepts of episodes."""
    counts = Counts()
    for log in logs:
        tracker, ego_id = Tracker(settings), log.settings.ego_id
        seen: dict[int, float] = {}
        known: dict[int, float] = {}
        for tick in log.ticks:
            time_s = tick.ego.time_s
            tracks = tracker.update(tick.percept, time_s)
            there = others(tick, ego_id)
            of_whom = of_road_users(tracks.boxes, there)
            false = ~of_whom.any(axis=0) & ~of_road_users(tracks.boxes, tick.ego.box).any(axis=0)
            moves = np.hypot(*tracks.velocity.T) > MOVING_MPS
            counts.instants += 1
            counts.false += int(false.sum())
            counts.matter += int((false & moves & near_route(tracks.boxes, tick)).sum())
            ids = set(there.object_id[of_whom.any(axis=1)].tolist())
            for one in ids:
                known.setdefault(one, time_s)
            if tick.percept is not None:
                boxed = set(there.object_id[of_road_users(tick.percept.boxes, there).any(axis=1)].tolist())
                for one in boxed:
                    seen.setdefault(one, time_s)
                counts.boxed += len(boxed)
                counts.tracked += len(boxed & ids)
        counts.delays += [min(max(known.get(one, np.inf) - at, 0.0), NEVER_S) for one, at in seen.items()]
    return counts


def row(title: str, counts: Counts) -> list[str]:
    """Return the line of a table."""
    delays = np.array(counts.delays)
    numbers = (
        f"{counts.false / counts.instants:.2f}",
        f"{counts.matter / counts.instants:.2f}",
        f"{100.0 * counts.tracked / max(counts.boxed, 1):.0f}",
        f"{delays.mean():.2f}" if len(delays) else "-",
        f"{100.0 * (delays >= NEVER_S).mean():.0f}" if len(delays) else "-",
    )
    return [title, str(counts.instants), *numbers]


def others(tick: Tick, ego_id: int) -> Boxes:
    """Return the road users without the ego."""
    boxes = tick.actors.boxes
    return boxes[boxes.object_id != ego_id]


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
