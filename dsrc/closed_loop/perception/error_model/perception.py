"""Error model as a perception: the truth with the misses, errors and ghosts of a detector, without casting a LiDAR."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from dsrc.closed_loop.perception.error_model.model import PARTS, QUANTILES, Cell, ErrorModel, Errors
from dsrc.closed_loop.perception.error_model.sight import (
    BANDS,
    KIND_OF_LABEL,
    KINDS,
    SIGHTS,
    Viewpoints,
    bands_of,
    ego_frame,
    quarters_of,
    within,
)
from dsrc.closed_loop.types import Percept
from sim.boxes import Boxes
from sim.scenario import Scenario
from sim.streams import Stream, random_generator
from sim.traffic.base import Actors


@dataclass(slots=True, eq=False)
class _Memory:
    """State of the errors of one object.

    Attributes:
        rng: its own random numbers, so that no object moves another's.
        noise: (8,) standard normal numbers of `PARTS`.
        found: whether it was found the last time; None where it was outside of the area.
        ever: whether it was found since it came into the area.
        side: of a box across it, 1 to its left, -1 to its right.
        flipped: whether its box pointed backwards the last time that it was found along it; None before.
        crossed: whether its box lay across it the last time that it was found; None before.
        doubled: whether it had a second box the last time that it was found; None before.
        second: row of the example of its second box.
        percept: number of the last percept in which it was inside the area.
    """

    rng: np.random.Generator
    noise: NDArray[np.float64]
    side: int
    found: bool | None = None
    ever: bool = False
    flipped: bool | None = None
    crossed: bool | None = None
    doubled: bool | None = None
    second: int = 0
    percept: int = -1


class ModelPerception:
    """Percepts drawn from an error model: what is found, how wrong it is, and what is not there.

    Each object has its own random numbers: two episodes with equal seeds in which others differ draw the same errors
    for it. It hears no lie of a helper, and measures no velocity.
    """

    def __init__(self, model: ErrorModel, errors: Errors) -> None:
        self.cooperative, self.classes = model.cooperative, model.classes
        self.model, self.errors = model, errors
        self._cells = {
            (KINDS.index(cell.kind), SIGHTS.index(cell.sight), cell.across, BANDS.index(cell.range_m)): cell
            for cell in errors.cells
        }
        self._correlation = np.array(errors.correlation)

    def reset(self, scenario: Scenario, ego_id: int, seed: int) -> None:
        """Begin an episode."""
        self._views = Viewpoints(scenario, seed, ego_id, self.cooperative)
        self._ego_id = ego_id
        self._rng_of = partial(random_generator, seed, Stream.PERCEPTION_ERRORS)
        self._ghost_rng = self._rng_of(0)
        self._memories: dict[int, _Memory] = {}
        self._ghosts = np.zeros((0, 8))
        self._percepts, self._last_s = 0, np.nan

    def perceive(self, before: Actors, now: Actors, claims: dict[str, Actors]) -> Percept:
        """Return the boxes that the detector might have found, without velocities and ids."""
        intervals = (now.time_s - self._last_s) / self.model.interval_s if self._percepts else 1.0
        intervals = float(np.round(intervals, 3))
        self._percepts, self._last_s = self._percepts + 1, now.time_s
        row = now.row(self._ego_id)
        ego = np.array([*now.boxes.center[row, :2], now.boxes.yaw[row]])
        local = ego_frame(now.boxes.center[:, :2], ego)
        near = np.flatnonzero(within(self.errors.area_m, local) & (now.boxes.object_id != self._ego_id))
        kinds, bands = KIND_OF_LABEL[now.boxes.label[near]], bands_of(local[near])
        quarters = quarters_of(now.boxes.yaw[near] - ego[2])
        sights = self._views.sight(before, now, near)
        rows, boxes = [], []
        for place, (kind, sight, quarter, band) in enumerate(
            zip(kinds.tolist(), sights.tolist(), quarters.tolist(), bands.tolist(), strict=True)
        ):
            object_id = int(now.boxes.object_id[near[place]])
            cell = self._cells[kind, sight, quarter % 2 == 1, band]
            for drawn in self._draw(object_id, cell, quarter, now.boxes.array[near[place]], intervals):
                rows.append(near[place])
                boxes.append(drawn)
        base = now.boxes.center[row, 2] - 0.5 * now.boxes.size[row, 2]
        self._move_ghosts(ego, base, intervals)
        found = np.concatenate([np.array(boxes).reshape(-1, 8), self._ghosts])
        label = np.concatenate([now.boxes.label[np.array(rows, np.int64)], np.zeros(len(self._ghosts), np.int64)])
        velocity = np.full((len(found), 2), np.nan)
        return Percept(now.time_s, Boxes.from_array(found[:, :7], label), found[:, 7], velocity)

    def _draw(
        self, object_id: int, cell: Cell, quarter: int, box: NDArray[np.float64], intervals: float
    ) -> list[NDArray[np.float64]]:
        """Return (8,) boxes and scores of an object, none for a miss. All draws are taken, whatever comes of them."""
        memory = self._memories.get(object_id)
        if memory is None:
            rng = self._rng_of(object_id)
            memory = self._memories[object_id] = _Memory(
                rng, rng.standard_normal(len(PARTS)), 1 if rng.random() < 0.5 else -1
            )
        else:
            kept = self._correlation**intervals
            fresh = memory.rng.standard_normal(len(PARTS))
            memory.noise = kept * memory.noise + np.sqrt(1.0 - kept**2) * fresh
        chance = memory.rng.random(5)
        if memory.percept != self._percepts - 1:
            memory.found, memory.ever = None, False
        memory.percept = self._percepts
        memory.found = bool(chance[0] < cell.found.at(memory.found, memory.ever, intervals))
        memory.ever |= memory.found
        if not memory.found:
            return []
        memory.crossed = bool(chance[2] < self.errors.crossed[cell.across].at(memory.crossed, True, intervals))
        if memory.crossed:
            turn = 0.5 * np.pi * memory.side
        else:
            memory.flipped = bool(chance[1] < self.errors.flipped[quarter].at(memory.flipped, True, intervals))
            turn = np.pi * memory.flipped
        error = np.array(cell.errors.bias) + np.array(cell.errors.sd) * memory.noise[:7]
        error[6] += turn
        drawn = [_displaced(box, error, float(np.interp(ndtr(memory.noise[7]), QUANTILES, cell.errors.score)))]
        doubles, had = self.errors.doubles, memory.doubled
        memory.doubled = bool(chance[3] < doubles.there[cell.across].at(had, True, intervals))
        if memory.doubled:
            memory.second = memory.second if had else int(chance[4] * len(doubles.examples))
            *offset, score = doubles.examples[memory.second]
            drawn.append(_displaced(box, np.array(offset), score))
        return drawn

    def _move_ghosts(self, ego: NDArray[np.float64], base_m: float, intervals: float) -> None:
        """Let ghosts vanish and appear; they stand in the world."""
        ghosts, rng = self.errors.ghosts, self._ghost_rng
        lives = ghosts.lives.p**intervals
        self._ghosts = self._ghosts[rng.random(len(self._ghosts)) < lives]
        if self._percepts == 1:  # as many as there are on average
            expected = ghosts.born / max(1.0 - ghosts.lives.p, 1e-3)
        else:
            expected = ghosts.born * (intervals if ghosts.lives.p == 1.0 else (1.0 - lives) / (1.0 - ghosts.lives.p))
        count = int(rng.poisson(expected)) if ghosts.examples else 0
        if not count:
            return
        drawn = np.array(ghosts.examples)[rng.integers(len(ghosts.examples), size=count)]
        cos, sin = np.cos(ego[2]), np.sin(ego[2])
        new = np.column_stack(
            [
                ego[:2] + drawn[:, :2] @ np.array([[cos, sin], [-sin, cos]]),
                base_m + 0.5 * drawn[:, 5],
                drawn[:, 3:6],
                drawn[:, 2] + ego[2],
                drawn[:, 6],
            ]
        )
        self._ghosts = np.concatenate([self._ghosts, new])


def _displaced(box: NDArray[np.float64], error: NDArray[np.float64], score: float) -> NDArray[np.float64]:
    """Return the (8,) box of an object's (7,) with the (7,) error of `PARTS`, and its score."""
    cos, sin = np.cos(box[6]), np.sin(box[6])
    offset = cos * error[0] - sin * error[1], sin * error[0] + cos * error[1], error[2]
    return np.concatenate([box[:3] + offset, box[3:6] * np.exp(error[3:6]), [box[6] + error[6], score]])
