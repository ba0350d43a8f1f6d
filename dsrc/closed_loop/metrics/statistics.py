"""Statistics of a campaign: intervals of rates and means, and of paired differences."""

import math
from collections.abc import Hashable, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

LEVEL = 0.95
RESAMPLES = 2000


class Estimate(NamedTuple):
    """Value with the bounds of its interval; NaN where unknown."""

    value: float
    low: float
    high: float

    @property
    def excludes_zero(self) -> bool:
        """Whether 0 lies outside; an unknown interval excludes nothing."""
        return self.low > 0.0 or self.high < 0.0


UNKNOWN = Estimate(math.nan, math.nan, math.nan)


class PairedRates(NamedTuple):
    """Difference of two rates over the same episodes.

    Attributes:
        difference: of the rates, with its interval.
        p_value: of the exact test that both are equal.
        only_first: episodes in which only the first had the event.
        only_second: episodes in which only the second had it.
    """

    difference: Estimate
    p_value: float
    only_first: int
    only_second: int


def rate(events: Sequence[float], level: float = LEVEL) -> Estimate:
    """Return a rate with its Wilson interval; unknown without episodes.

    Source: E. B. Wilson, Probable inference, the law of succession, and statistical inference, Journal of the American
    Statistical Association 22 (1927), 209-212.

    Args:
        events: 1 or 0 for each episode.
        level: share of samples whose interval holds the true value.
    """
    return _wilson(round(sum(events)), len(events), level)


@cache
def _wilson(events: int, n: int, level: float) -> Estimate:
    from scipy import stats  # two seconds, and most processes need no interval

    if not n:
        return UNKNOWN
    test = stats.binomtest(events, n)
    bounds = test.proportion_ci(level, method="wilson")
    return Estimate(test.statistic, float(bounds.low), float(bounds.high))


def mean(values: Sequence[float], level: float = LEVEL, seed: int = 0) -> Estimate:
    """Return a mean with its bootstrap interval (BCa), NaN left out; without an interval for fewer than two values.

    Source: B. Efron, Better bootstrap confidence intervals, Journal of the American Statistical Association 82 (1987),
    171-185.

    Args:
        level: share of samples whose interval holds the true value.
    """
    return _bca(np.array(values, np.float64).tobytes(), level, seed)


@cache  # a report asks for the same mean in several tables
def _bca(values: bytes, level: float, seed: int) -> Estimate:
    from scipy import stats

    known = np.frombuffer(values)
    known = known[np.isfinite(known)]
    if not len(known):
        return UNKNOWN
    middle = float(known.mean())
    if len(known) < 2:
        return Estimate(middle, math.nan, math.nan)
    if np.ptp(known) == 0.0:
        return Estimate(middle, middle, middle)
    interval = stats.bootstrap(
        (known,), np.mean, n_resamples=RESAMPLES, confidence_level=level, rng=np.random.default_rng(seed)
    ).confidence_interval
    return Estimate(middle, float(interval.low), float(interval.high))


def paired_rates(
    first: Sequence[float],
    second: Sequence[float],
    level: float = LEVEL,
    clusters: Sequence[Hashable] | None = None,
) -> PairedRates:
    """Return the difference of two rates over the same episodes, by those in which they differ.

    Episodes of a cluster may be alike; clusters are independent. The p-value is that of the exact test of all ways to
    swap both sides in whole clusters, 1 where the episodes never differ; with clusters of one episode it is McNemar's.
    The interval is Wald's with the variance between clusters, after one cluster of mean size is added in which only the
    first has the event, and one in which only the second has it; with clusters of one episode it is Bonett and Price's.

    Sources: Q. McNemar, Note on the sampling error of the difference between correlated proportions or percentages,
    Psychometrika 12 (1947), 153-157; D. G. Bonett and R. M. Price, Adjusted Wald confidence interval for a difference
    of binomial proportions based on paired data, Journal of Educational and Behavioral Statistics 37 (2012), 479-488;
    K.-Y. Liang and S. L. Zeger, Longitudinal data analysis using generalized linear models, Biometrika 73 (1986),
    13-22 (variance); R. A. Fisher, The Design of Experiments (1935), section 21 (test).

    Args:
        first: 1 or 0 for each episode.
        second: of the same episodes.
        level: share of samples whose interval holds the true value.
        clusters: cluster of each episode; None: each is one of its own.

    Raises:
        ValueError: the lengths differ.
    """
    from scipy import stats

    differences = [round(a - b) for a, b in zip(first, second, strict=True)]
    n = len(differences)
    if not n:
        return PairedRates(UNKNOWN, math.nan, 0, 0)
    of_cluster: dict[Hashable, list[int]] = {}
    for cluster, difference in zip(range(n) if clusters is None else clusters, differences, strict=True):
        of_cluster.setdefault(cluster, []).append(difference)
    sums = np.array([sum(one) for one in of_cluster.values()])
    sizes = np.array([len(one) for one in of_cluster.values()])
    more = n / len(sizes)
    middle = sums.sum() / (n + 2 * more)
    spread = np.sum((np.array([*sums, more, -more]) - np.array([*sizes, more, more]) * middle) ** 2)
    half = float(stats.norm.ppf(0.5 + 0.5 * level)) * math.sqrt(spread) / (n + 2 * more)
    low, high = max(float(middle) - half, -1.0), min(float(middle) + half, 1.0)
    return PairedRates(
        Estimate(float(sums.sum()) / n, low, high),
        _swapped(sums),
        differences.count(1),
        differences.count(-1),
    )


def _swapped(sums: NDArray[np.int_]) -> float:
    """Return the share of all signs of some whole numbers whose sum is at least as far from 0 as theirs."""
    share = np.ones(1)  # of each sum, from the least to the largest, in steps of 1
    for size in np.abs(sums[sums != 0]).tolist():
        share = 0.5 * (np.pad(share, (0, 2 * size)) + np.pad(share, (2 * size, 0)))
    reach = len(share) // 2
    far = np.abs(np.arange(-reach, reach + 1)) >= abs(int(sums.sum()))
    return min(float(share[far].sum()), 1.0)
