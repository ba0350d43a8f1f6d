"""Detections in the loop: which are right, and whether their scores say so."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dsrc.closed_loop.metrics.detections import calibrations, detection_hits
from dsrc.closed_loop.types import Percept
from sim.boxes import Boxes
from sim.traffic.base import Actors
from tests.dsrc.closed_loop.logged import STEP_S, Mover, ahead, episode, percept_of

EGO = Mover("ego", ahead(10.0))
CAR = Mover("car", ahead(20.0, x=20.0))
STEPS = 5


def shifted(percept: Percept, by_m: float) -> Percept:
    boxes = percept.boxes
    moved = Boxes(boxes.center + np.array([by_m, 0.0, 0.0]), boxes.size, boxes.yaw, boxes.label, boxes.object_id)
    return replace(percept, boxes=moved, score=np.full(len(moved), 0.6))


def test_a_box_on_a_car_is_right_and_one_beside_every_car_is_wrong() -> None:
    for by_m, right in ((0.0, True), (0.5, True), (3.0, False)):
        log = episode([EGO, CAR], STEPS, sees=lambda actors, by_m=by_m: shifted(percept_of(actors, [1]), by_m))
        score, hit = detection_hits(log)
        assert score == pytest.approx(np.full(STEPS, 0.6)) and (hit == right).all()


def test_a_late_box_is_judged_at_the_instant_that_it_is_of() -> None:
    seen: list[Actors] = []

    def late(actors: Actors) -> Percept | None:
        seen.append(actors)
        return shifted(percept_of(seen[-3], [1]), 0.0) if len(seen) > 2 else None

    log = episode([EGO, CAR], STEPS, sees=late)
    assert 20.0 * 2 * STEP_S > 0.5 * CAR.size[0]  # where the car is now, the box overlaps too little of it
    assert detection_hits(log)[1].tolist() == [True] * (STEPS - 2)


def test_a_box_on_the_ego_is_wrong_and_of_two_on_a_car_one_is() -> None:
    own = episode([EGO, CAR], STEPS, sees=lambda actors: percept_of(actors, [0]))
    assert not detection_hits(own)[1].any()
    twice = episode([EGO, CAR], STEPS, sees=lambda actors: percept_of(actors, [1, 1]))
    assert detection_hits(twice)[1].sum() == STEPS


def test_logs_that_are_there_are_read_by_their_key(tmp_path: Path) -> None:
    episode([EGO, CAR], STEPS, sees=lambda actors: shifted(percept_of(actors, [1]), 0.0)).save(tmp_path / "a.npz")
    episode([EGO, CAR], STEPS).save(tmp_path / "b.npz")
    told: list[tuple[int, int]] = []
    found = calibrations(["a", "b", "missing", "a"], tmp_path, lambda done, every: told.append((done, every)))
    assert {key: int(own.count.sum()) for key, own in found.items()} == {"a": STEPS, "b": 0}
    assert found["a"].right == 1.0 and found["a"].error == pytest.approx(0.4)
    assert told == [(1, 3), (2, 3), (3, 3)]
