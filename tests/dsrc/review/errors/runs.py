"""Runs drawn at random: objects in lanes, and detections of them, some off, some twice, some of nothing."""

import numpy as np

from dsrc.evaluation.detection_table import DetectionTable, join_tables, one_frame
from dsrc.ops.detections import Detections
from dsrc.review.errors.judged import JudgedRun
from dsrc.review.sources.base import Setup
from sensors.corruptions import Condition
from sim.boxes import Boxes


def draw_truth(rng: np.random.Generator, count: int) -> tuple[Boxes, np.ndarray]:
    """Objects that do not touch, and their (N, 4) points."""
    spots = rng.permutation(20 * 8)[:count]
    xy = np.stack([(spots % 20 - 10) * 7.0, (spots // 20 - 4) * 3.5], axis=1) + rng.normal(0, 0.2, (count, 2))
    size = np.array([[4.5, 1.8, 1.5], [5.9, 2.0, 2.6], [7.4, 2.4, 3.2]])[rng.choice(3, count, p=[0.8, 0.15, 0.05])]
    array = np.column_stack([xy, -1.0 * np.ones(count), size, rng.choice([0.0, np.pi], count)])
    ego = rng.integers(0, 40, count) * (rng.random(count) < 0.6)
    everyone = ego + rng.integers(0, 60, count) * (rng.random(count) < 0.8)
    left = rng.random(count)
    points = np.stack([ego, everyone, (ego * left).astype(int), (everyone * left).astype(int)], axis=1)
    return Boxes.from_array(array, rng.integers(0, 4, count), 1000 + rng.permutation(count)), points


def draw_table(seed: int, frames: int = 6, objects: int = 14, skill: float = 0.8) -> DetectionTable:
    """Table of a run; the truth depends on the seed alone, the detections on the skill too."""
    tables = []
    for row in range(frames):
        truth, points = draw_truth(np.random.default_rng([seed, row]), objects if row else 0)
        rng = np.random.default_rng([seed, row, round(1000 * skill)])
        n = len(truth)
        right = truth.array[rng.random(n) < skill]
        again = right[rng.random(len(right)) < 0.2]
        near = np.concatenate([right, again, truth.array[rng.random(n) < 0.2]])
        spread = np.concatenate([np.full(len(right), 0.25), np.full(len(near) - len(right), 1.2)])
        found = near.copy()
        found[:, :2] += rng.normal(0, 1, (len(near), 2)) * spread[:, None]
        found[:, 6] += rng.normal(0, 0.05, len(near))
        ghosts = np.column_stack([rng.uniform(-80, 80, (3, 2)), np.full(3, -1.0), np.full((3, 3), 3.0), rng.random(3)])
        boxes = np.concatenate([found, ghosts])
        # Equal scores happen: a network's are of few bits.
        score = np.round(rng.random(len(boxes)), 2).astype(np.float32)
        detections = Detections(Boxes.from_array(boxes), score)
        tables.append(one_frame(2 * row, 10 + 2 * row, 7, detections, truth, points, None))
    return join_tables(tables)


def draw_run(seed: int, method: str = "DSRC", kind: str = "clean", skill: float = 0.8, **sizes: int) -> JudgedRun:
    condition = Condition() if kind == "clean" else Condition(kind, 3)
    return JudgedRun(method, Setup(condition), draw_table(seed, skill=skill, **sizes))
