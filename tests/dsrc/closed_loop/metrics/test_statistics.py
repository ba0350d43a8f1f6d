"""Intervals against published and hand-computed values."""

import math

import numpy as np
import pytest
from scipy import stats

from dsrc.closed_loop.metrics.statistics import mean, paired_rates, rate


def test_wilson_interval_of_published_examples() -> None:
    """R. G. Newcombe, Statistics in Medicine 17 (1998), 857-872, table I, method 3."""
    for events, n, low, high in ((81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611)):
        found = rate([1.0] * events + [0.0] * (n - events))
        assert found == (pytest.approx(events / n), pytest.approx(low, abs=5e-5), pytest.approx(high, abs=5e-5))


def test_a_rate_of_nothing_is_unknown() -> None:
    assert all(math.isnan(value) for value in rate([]))
    assert not rate([]).excludes_zero


def test_the_bootstrap_of_a_mean_is_that_of_the_normal_distribution_for_many_values() -> None:
    values = np.random.default_rng(0).normal(5.0, 2.0, 400)
    found = mean(values.tolist())
    half = 1.96 * values.std(ddof=1) / 20.0
    assert found.value == pytest.approx(values.mean())
    assert found.high - found.low == pytest.approx(2 * half, rel=0.1)
    assert mean(values.tolist()) == found


def test_unknown_values_are_left_out_and_equal_ones_have_no_width() -> None:
    assert mean([1.0, math.nan, 1.0, math.inf]) == (1.0, 1.0, 1.0)
    assert math.isnan(mean([3.0]).low) and mean([3.0]).value == 3.0


def test_paired_rates_by_hand() -> None:
    """Of 50 pairs 1 only first, 9 only second: p = 2 (1 + 10) / 2^10; p~ = 2/52, q~ = 10/52."""
    first, second = [1.0] * 1 + [0.0] * 49, [0.0] * 1 + [1.0] * 9 + [0.0] * 40
    found = paired_rates(first, second)
    assert (found.only_first, found.only_second) == (1, 9)
    assert found.p_value == pytest.approx(22 / 1024)
    assert found.difference.value == pytest.approx(-0.16)
    half = 1.959964 * math.sqrt((12 / 52 - (8 / 52) ** 2) / 52)
    assert found.difference.low == pytest.approx(-8 / 52 - half)
    assert found.difference.high == pytest.approx(-8 / 52 + half)
    assert found.difference.excludes_zero


def test_episodes_that_never_differ_are_no_evidence() -> None:
    found = paired_rates([1.0, 0.0], [1.0, 0.0])
    assert (found.difference.value, found.p_value) == (0.0, 1.0)
    assert not found.difference.excludes_zero


def test_episodes_of_a_cluster_that_are_alike_are_no_more_evidence_than_one() -> None:
    first, second = [1.0] * 9 + [0.0] * 31, [0.0] * 9 + [1.0] * 2 + [0.0] * 29
    once = paired_rates(first, second)
    sixfold = paired_rates(
        np.repeat(first, 6).tolist(), np.repeat(second, 6).tolist(), clusters=np.repeat(range(40), 6).tolist()
    )
    assert sixfold.p_value == once.p_value == pytest.approx(stats.binomtest(2, 11).pvalue)
    assert sixfold.difference == pytest.approx(once.difference)
    assert sixfold[2:] == (54, 12)


def test_differences_that_cancel_inside_a_cluster_are_none() -> None:
    found = paired_rates([1.0, 0.0, 1.0], [0.0, 1.0, 1.0], clusters=[0, 0, 1])
    assert found.p_value == 1.0 and (found.only_first, found.only_second) == (1, 1)


def test_the_exact_test_of_clusters_is_the_permutation_test_of_their_sums() -> None:
    rng = np.random.default_rng(3)
    first, second = ((rng.uniform(size=40) < share).astype(float) for share in (0.7, 0.4))
    clusters = rng.integers(0, 9, 40)
    sums = [float(np.sum(first[clusters == one] - second[clusters == one])) for one in np.unique(clusters)]
    oracle = stats.permutation_test(
        (sums, np.zeros(len(sums))), lambda a, b: np.sum(a - b), permutation_type="samples", n_resamples=np.inf
    )
    assert paired_rates(first, second, clusters=clusters.tolist()).p_value == pytest.approx(oracle.pvalue)
