"""Points that a corruption removed are found whatever it did to the others."""

from dataclasses import replace

import numpy as np
import pytest

from dsrc.review.points import lost_rows
from sensors.sweep import ADDED, MOVED, SCATTERED, Sweep, make_sweep
from sim.rows import stacked


def sweep(rng: np.random.Generator, columns: bool = True) -> Sweep:
    beam = np.arange(600)
    return make_sweep(
        rng.uniform(-40, 40, (600, 3)), ring=beam // 100, column=1 + beam % 100 if columns else np.zeros(600)
    )


@pytest.mark.parametrize("columns", [True, False])
def test_exactly_the_missing_points_are_lost(columns: bool) -> None:
    rng = np.random.default_rng(0)
    before = sweep(rng, columns)
    stays = rng.random(600) < 0.7
    np.testing.assert_array_equal(lost_rows(before, before[stays]), np.flatnonzero(~stays))
    assert len(lost_rows(before, before)) == 0 and len(lost_rows(before[:0], before[:0])) == 0


@pytest.mark.parametrize("columns", [True, False])
def test_a_moved_point_is_not_lost(columns: bool) -> None:
    rng = np.random.default_rng(1)
    before = sweep(rng, columns)
    stays = rng.random(600) < 0.7
    shift = np.where(rng.random((600, 1)) < 0.5, rng.normal(0.0, 0.01, (600, 3)), 0.0)
    moved = replace(before, points=(before.points + shift).astype(np.float32), fate=np.full(600, MOVED, np.uint8))
    np.testing.assert_array_equal(lost_rows(before, moved[stays]), np.flatnonzero(~stays))


def test_a_false_return_does_not_stand_for_the_one_that_it_replaces() -> None:
    before = sweep(np.random.default_rng(2))
    false = replace(
        before[:50], points=before.points[:50] * np.float32(0.5), object_id=np.full(50, ADDED, np.int32),
        fate=np.full(50, SCATTERED, np.uint8),
    )  # fmt: skip
    np.testing.assert_array_equal(lost_rows(before, stacked(before[50:], false)), np.arange(50))


def test_zeros_of_either_sign_are_one_place() -> None:
    before = make_sweep(np.array([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]))
    after = make_sweep(np.array([[-0.0, 1.0, 2.0]]))
    assert lost_rows(before, after).tolist() == [1]
