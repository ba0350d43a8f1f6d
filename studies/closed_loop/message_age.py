"""What the age of messages costs, and what moving their boxes to the present gives back: crashes, time and AP.

Episodes of encounters through an ideal radio with a delay. `stale`: boxes of late fusion where they were measured.
Rows are kept in `episodes.csv` of the folder, and what is there is not driven again.

Usage:
    python -m studies.closed_loop.message_age --out runs/message-age --docs docs/channel.md
    python -m studies.closed_loop.message_age --out runs/message-age --seed 30 31 32
"""

import argparse
import csv
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import dsrc
from dsrc.closed_loop.metrics.statistics import Estimate, mean, rate
from dsrc.closed_loop.perception.detector import DetectorPerception
from dsrc.closed_loop.perception.open import open_perception
from dsrc.closed_loop.types import Tick
from dsrc.evaluation.metrics.ap import FrameResult, evaluate
from dsrc.models.device import one_thread
from dsrc.ops.detections import Detections
from sim.boxes import Boxes
from sim.geometry import invert, pose_matrix
from sim.radio import get_channel
from studies.look import put_table

SCENARIOS = ("lta_truck", "ima_building", "ima_queue")
DELAYS_S = (0.0, 0.4)
KINDS = ("late", "stale", "team", "cpm")
NAMES = {
    "late": "boxes, moved to the present",
    "stale": "boxes as they were measured",
    "team": "features",
    "cpm": "ETSI messages",
}
DETECT_EVERY_S = 0.2
REACH_M = (50.0, 25.0)
"""Ahead and aside of the ego: within the detector's range."""
COLUMNS = ("scenario", "seed", "kind", "delay_s", "outcome", "time_s", "age_s", "ap_50", "ap_30")
HEAD = (
    *("helpers send", "delay, s", "age, s", "episodes", "crashes, %", "time, s", "AP@0.3, %", "AP@0.5, %"),
    "less not moved",
)


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of episodes.csv")
    parser.add_argument("--seed", type=int, nargs="*", default=(10, 11, 12, 13), help="episodes of each scenario")
    parser.add_argument("--docs", type=Path, help="document with a place for the table")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "episodes.csv"
    known = {tuple(row[name] for name in COLUMNS[:4]) for row in read(path)}
    for seed, scenario, delay_s, kind in product(options.seed, SCENARIOS, DELAYS_S, KINDS):
        if (scenario, str(seed), kind, str(delay_s)) in known or (kind == "stale" and delay_s == 0.0):
            continue
        row = drive(scenario, seed, kind, delay_s)
        with path.open("a", newline="", encoding="utf-8") as file:
            csv.DictWriter(file, COLUMNS).writerow(row)
        print(*row.values(), flush=True)
    rows = list(table(list(read(path))))
    print(*HEAD, *rows, sep="\n")
    if options.docs is not None:
        put_table(options.docs, "message age", HEAD, rows)


def read(path: Path) -> Iterator[dict[str, str]]:
    """Yield the kept rows."""
    if path.is_file():
        with path.open(newline="", encoding="utf-8") as file:
            yield from csv.DictReader(file, COLUMNS)


def drive(scenario: str, seed: int, kind: str, delay_s: float) -> dict[str, Any]:
    """Drive one episode and return its row."""
    channel = "ideal" if delay_s == 0.0 else f"ideal,delay_s={delay_s:g}"
    perception: Any = open_perception(
        "late" if kind == "stale" else kind, channel=channel, interval_s=DETECT_EVERY_S, engine="auto"
    )
    if kind == "stale":
        perception = DetectorPerception(
            perception.detector, channel=get_channel(channel), interval_s=DETECT_EVERY_S, moved=False
        )
    settings = dsrc.LoopSettings(detect_every_s=DETECT_EVERY_S)
    loop = dsrc.ClosedLoop(scenario, perception, settings=settings)
    outcome = loop.run(seed)
    frames = [frame_of(tick, loop.ego_id) for tick in loop.ticks if tick.percept is not None]
    ages = [link.age_s for tick in loop.ticks if tick.percept for link in tick.percept.links if link.received]
    curves = evaluate(frames).curves
    driven_s = loop.ticks[-1].actors.time_s - loop.start_s
    numbers = (f"{driven_s:.1f}", f"{np.mean(ages or [np.nan]):.3f}")
    aps = (f"{curves['bev', iou].ap:.4f}" for iou in (0.5, 0.3))
    return dict(zip(COLUMNS, (scenario, seed, kind, delay_s, outcome.value, *numbers, *aps), strict=True))


def frame_of(tick: Tick, ego_id: int) -> FrameResult:
    """Return what was found and what is there around the ego, in its frame."""
    percept, actors = tick.percept, tick.actors
    row = actors.row(ego_id)
    ego_from_world = invert(pose_matrix(actors.boxes.center[row], actors.boxes.yaw[row]))
    others = (actors.boxes.object_id != ego_id) & actors.boxes.is_vehicle
    found = percept.boxes.transform(ego_from_world)
    kept = near(found)
    truth = actors.boxes[others].transform(ego_from_world)
    return FrameResult(Detections(found[kept], percept.score[kept].astype(np.float32)), truth[near(truth)])


def near(boxes: Boxes) -> np.ndarray:
    """Return (N,) whether centres are within reach of the ego."""
    return np.all(np.abs(boxes.center[:, :2]) <= REACH_M, axis=1)


def table(rows: list[dict[str, str]]) -> Iterator[tuple[str, ...]]:
    """Yield the lines of the table, over the episodes that all of them have: each with its 95 % intervals.

    Less not moved: AP@0.5 less that of boxes as they were measured, episode by episode, as old.
    """
    driven = [(row["scenario"], row["seed"]) for row in rows]
    whole = {one for one in driven if driven.count(one) == len(KINDS) * len(DELAYS_S) - 1}  # nothing is stale at once
    rows = [row for row in rows if (row["scenario"], row["seed"]) in whole]
    still = {(row["scenario"], row["seed"]): float(row["ap_50"]) for row in rows if row["kind"] == "stale"}
    for kind, delay_s in product(KINDS, DELAYS_S):
        own = [row for row in rows if (row["kind"], row["delay_s"]) == (kind, str(delay_s))]
        if not own:
            continue
        crashed = rate([float(row["outcome"] == "crashed") for row in own])
        times = mean([float(row["time_s"]) for row in own if row["outcome"] == "arrived"])
        aps = (mean([float(row[name]) for row in own]) for name in ("ap_30", "ap_50"))
        age_s = mean([float(row["age_s"]) for row in own]).value
        numbers = (shown(crashed, 100.0, 0), shown(times, 1.0, 1), *(shown(ap, 100.0, 1) for ap in aps))
        more = mean([float(row["ap_50"]) - still[row["scenario"], row["seed"]] for row in own])
        gain = shown(more, 100.0, 1) if delay_s > 0.0 and kind != "stale" else ""
        yield NAMES[kind], f"{delay_s:g}", f"{age_s:.2f}", str(len(own)), *numbers, gain


def shown(value: Estimate, scale: float, digits: int) -> str:
    """Return a value with its interval."""
    return "{:.{d}f} [{:.{d}f}, {:.{d}f}]".format(*(scale * one for one in value[:3]), d=digits)


if __name__ == "__main__":
    with one_thread():
        main()
