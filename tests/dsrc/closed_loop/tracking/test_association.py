"""The gate is part of the assignment, and what overlaps is one object."""

from itertools import combinations, permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dsrc.closed_loop.tracking.association import assigned, originals, overlaps, pair_distances, squared_distances
from dsrc.ops.iou import bev_iou


def cheapest(cost: np.ndarray, allowed: np.ndarray, limit: float) -> float:
    """Return the saving of the best set of allowed pairs, each against `limit`, by trying all."""
    n, m = cost.shape
    best = 0.0
    for k in range(1, min(n, m) + 1):
        for rows in combinations(range(n), k):
            for columns in permutations(range(m), k):
                if allowed[rows, columns].all():
                    best = max(best, float((limit - cost[rows, columns]).sum()))
    return best


@given(st.integers(0, 4), st.integers(0, 4), st.integers(0, 10_000))
def test_the_assignment_is_the_cheapest_of_all_that_stay_inside_the_gate(n: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    cost, limit = rng.uniform(0.0, 10.0, (n, m)), 6.0
    allowed = (cost < limit) & (rng.random((n, m)) < 0.7)
    rows, columns = assigned(cost, allowed, limit)
    assert allowed[rows, columns].all()
    assert len(set(rows)) == len(set(columns)) == len(rows)
    assert (limit - cost[rows, columns]).sum() == pytest.approx(cheapest(cost, allowed, limit))


def test_a_pair_outside_the_gate_displaces_no_other() -> None:
    cost = np.array([[0.1, 2.8], [2.8, 5.7]])
    rows, columns = assigned(cost, cost <= 3.0, 3.0)
    assert [*zip(rows, columns, strict=True)] == [(0, 0)]


def test_a_mahalanobis_distance_is_that_of_the_inverse_covariance() -> None:
    rng = np.random.default_rng(0)
    offset, root = rng.normal(size=(3, 4, 2)), rng.normal(size=(3, 4, 2, 2))
    variance = root @ np.swapaxes(root, 2, 3) + np.eye(2)
    expected = np.einsum("nmi,nmij,nmj->nm", offset, np.linalg.inv(variance), offset)
    assert squared_distances(offset, variance) == pytest.approx(expected)


def test_distances_of_pairs_are_those_of_their_offsets_and_summed_covariances() -> None:
    rng = np.random.default_rng(1)
    mean, points = rng.normal(size=(5, 6)), rng.normal(size=(7, 3))
    a, b = (root @ np.swapaxes(root, 1, 2) for root in (rng.normal(size=(5, 6, 6)), rng.normal(size=(7, 2, 2))))
    offset = points[None, :, :2] - mean[:, None, :2]
    expected = squared_distances(offset, a[:, None, :2, :2] + b[None])
    assert expected.shape == (5, 7)
    assert np.array_equal(pair_distances(mean, a, points, b), expected)


@given(st.integers(0, 12), st.integers(0, 10_000))
def test_overlaps_are_those_of_all_pairs(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a = np.column_stack(
        [rng.uniform(-8, 8, (n, 2)), np.zeros(n), rng.uniform(0.5, 9, (n, 2)), np.ones(n), rng.uniform(-4, 4, n)]
    )
    b = a[rng.permutation(n)] + rng.normal(0.0, 0.3, (n, 7)) * [1, 1, 0, 0, 0, 0, 1]
    alike = rng.random((n, n)) < 0.8
    assert (overlaps(a, b, alike, 0.2) == (alike & (bev_iou(a, b) >= 0.2))).all()


def test_what_is_the_same_as_a_dropped_row_stays() -> None:
    same = np.zeros((3, 3), bool)
    same[0, 1] = same[1, 0] = same[1, 2] = same[2, 1] = True
    assert originals(same).tolist() == [0, 2]
