"""Synthetic percepts with known errors: cars around an ego that drives ahead."""

from dataclasses import replace

import numpy as np

from dsrc.closed_loop.perception.error_model.percepts import Observed
from dsrc.closed_loop.perception.error_model.sight import SIGHTS
from sim.boxes import Boxes, concatenate

INTERVAL_S = 0.1
CAR = (4.5, 1.8, 1.5)
FOUND, AFTER_FOUND, AFTER_MISSED = 0.7, 0.9, 0.3
"""Chances of a car in clear view: at first, after it was found, after it was missed."""
BIAS = np.array([0.3, -0.1, 0.05, -0.06, 0.02, 0.0, 0.03])
SD = np.array([0.4, 0.2, 0.1, 0.05, 0.04, 0.03, 0.08])
CORRELATION = 0.8
BORN, LIVES = 0.5, 0.6
SCORES = (0.3, 0.9)
"""Ends of the even distribution of the scores."""


def sequence(seed: int, percepts: int = 60, cars: int = 8, sight: str = "clear", ghosts: bool = True) -> list[Observed]:
    """Percepts of cars 18 m to 25 m ahead that keep their place before the ego."""
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((cars, 7))
    hit = rng.random(cars) < FOUND
    places = np.zeros((0, 2))
    made = []
    for step in range(percepts):
        ego = np.array([step * 1.0, 0.0, 0.0])
        center = np.column_stack([ego[0] + 18.0 + np.arange(cars), 4.0 * np.arange(cars) - 14.0, np.full(cars, 0.75)])
        truth = Boxes(
            center, np.tile(CAR, (cars, 1)), np.full(cars, 0.5), np.zeros(cars, np.int64), 1001 + np.arange(cars)
        )
        if step:
            hit = rng.random(cars) < np.where(hit, AFTER_FOUND, AFTER_MISSED)
            fresh = rng.standard_normal((cars, 7))
            noise = CORRELATION * noise + np.sqrt(1 - CORRELATION**2) * fresh
        places = places[rng.random(len(places)) < LIVES]
        new = rng.poisson(BORN if ghosts else 0.0)
        places = np.concatenate(
            [places, np.column_stack([ego[0] - rng.uniform(10, 60, new), rng.uniform(-60, 60, new)])]
        )
        found = concatenated(shifted(truth, BIAS + SD * noise)[hit], places)
        made.append(
            Observed(
                time_s=step * INTERVAL_S,
                ego=ego,
                truth=truth,
                sight=np.full(cars, SIGHTS.index(sight)),
                found=found,
                score=rng.uniform(*SCORES, len(found)),
            )
        )
    return made


def with_second(one: Observed) -> Observed:
    """Percepts with a second box 1.5 m ahead of each, longer by a tenth, of score 0.2."""
    ahead = np.column_stack([np.cos(one.found.yaw), np.sin(one.found.yaw), np.zeros(len(one.found))])
    again = replace(one.found, center=one.found.center + 1.5 * ahead, size=one.found.size * [1.1, 1.0, 1.0])
    score = np.concatenate([one.score, np.full(len(again), 0.2)])
    return replace(one, found=concatenate([one.found, again]), score=score)


def shifted(truth: Boxes, error: np.ndarray) -> Boxes:
    """Boxes with (N, 7) errors: along, across, up, log ratios of the sizes, yaw."""
    cos, sin = np.cos(truth.yaw), np.sin(truth.yaw)
    offset = np.column_stack(
        [cos * error[:, 0] - sin * error[:, 1], sin * error[:, 0] + cos * error[:, 1], error[:, 2]]
    )
    return replace(
        truth,
        center=truth.center + offset,
        size=truth.size * np.exp(error[:, 3:6]),
        yaw=truth.yaw + error[:, 6],
        object_id=np.full(len(truth), -1),
    )


def concatenated(boxes: Boxes, places: np.ndarray) -> Boxes:
    """Boxes and cars at (N, 2) places."""
    rows = [[x, y, 0.75, *CAR, 0.0] for x, y in places]
    return Boxes.from_array(np.concatenate([boxes.array, np.array(rows, float).reshape(-1, 7)]))
