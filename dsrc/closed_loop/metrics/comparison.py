"""Comparisons of perceptions over the results of a campaign: corruption errors, harm of cooperation, gain per MB."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import numpy as np

from dsrc.closed_loop.types import FAILED, Outcome


class Result(Protocol):
    """Result of an episode: what decided it, its outcome, and its metrics, see `EpisodeMetrics`; None is undefined."""

    @property
    def scenario(self) -> str:
        """Name of the scenario."""
        ...

    @property
    def perception(self) -> str:
        """Name of the perception in tables."""
        ...

    @property
    def corruption(self) -> str:
        """Kind, or `clean`."""
        ...

    @property
    def severity(self) -> int:
        """1 to 5; 0 for clean."""
        ...

    @property
    def who(self) -> str:
        """Agents whose sensors are corrupted."""
        ...

    @property
    def fault(self) -> str:
        """Faults beside corruption and channel, or ""."""
        ...

    @property
    def defence(self) -> str:
        """Defences against attacks, or ""."""
        ...

    @property
    def channel(self) -> str:
        """Name of the channel."""
        ...

    @property
    def seed(self) -> int:
        """Seed of the episode."""
        ...

    @property
    def outcome(self) -> str:
        """Value of an `Outcome`."""
        ...

    @property
    def metrics(self) -> Mapping[str, float | None]:
        """Metrics by name."""
        ...


Value = Callable[[Result], float]
"""Function from a result to the number that is compared."""


def metric(result: Result, name: str) -> float:
    """Return a metric; NaN where it is undefined or missing."""
    value = result.metrics.get(name)
    return math.nan if value is None else value


def collided(result: Result) -> float:
    """Return 1 for a crash, else 0."""
    return metric(result, "collision")


def arrived(result: Result) -> float:
    """Return 1 for an arrival, else 0."""
    return float(result.outcome == Outcome.ARRIVED.value)


def counted(results: Sequence[Result], failed: bool = False) -> list[Result]:
    """Return the results whose crash, or lack of one, counts.

    An episode that lost its encounter is neither a success nor a failure; one whose perception or driver failed ended
    before its driving could be judged, so that it must not count as one without a crash.

    Args:
        failed: keep episodes whose perception or driver failed, for arrivals: they are none.
    """
    dropped = {Outcome.DESYNCHRONISED} if failed else {Outcome.DESYNCHRONISED, *FAILED}
    return [one for one in results if one.outcome not in dropped and not math.isnan(collided(one))]


def pairs(
    results: Sequence[Result], others: Sequence[Result], any_channel: bool = False, failed: bool = False
) -> list[tuple[Result, Result]]:
    """Return the counted results of one scenario, seed, corruption, severity, agents, faults, defence and channel.

    Args:
        any_channel: channels may differ: a perception without helpers has none.
        failed: see `counted`.

    Raises:
        ValueError: two results of one side have the same key.
    """
    ours, theirs = _by_key(counted(results, failed), any_channel=False), _by_key(counted(others, failed), any_channel)
    cut = -1 if any_channel else None
    return [(one, theirs[key[:cut]]) for key, one in ours.items() if key[:cut] in theirs]


def _by_key(results: Sequence[Result], any_channel: bool) -> dict[tuple, Result]:
    found: dict[tuple, Result] = {}
    for one in results:
        key = (one.scenario, one.seed, one.corruption, one.severity, one.who, one.fault, one.defence, one.channel)
        known = key[: -1 if any_channel else None]
        if known in found:
            raise ValueError(f"two results of {known}")
        found[known] = one
    return found


def corruption_errors(results: Sequence[Result], reference: Sequence[Result]) -> dict[str, float]:
    """Return the corruption error of each corruption: errors summed over the severities, over those of a reference.

    CE_c = sum_s E_sc / sum_s E_sc(reference), where E is the collision rate. 1 is as bad as the
    reference; NaN where the reference makes no error, or has other severities.

    Source: D. Hendrycks and T. Dietterich, Benchmarking neural network robustness to common corruptions and
    perturbations, ICLR 2019, section 4.
    """
    ours, theirs = _error_sums(results), _error_sums(reference)
    errors = {}
    for kind, (severities, total) in ours.items():
        same, base = theirs.get(kind, (set(), 0.0))
        errors[kind] = total / base if same == severities and base > 0.0 else math.nan
    return errors


def _error_sums(results: Sequence[Result]) -> dict[str, tuple[set[int], float]]:
    cells: dict[tuple[str, int], list[float]] = {}
    for one in counted(results):
        if one.corruption != "clean":
            cells.setdefault((one.corruption, one.severity), []).append(collided(one))
    sums: dict[str, tuple[set[int], float]] = {}
    for (kind, severity), values in cells.items():
        severities, total = sums.get(kind, (set(), 0.0))
        sums[kind] = severities | {severity}, total + float(np.mean(values))
    return sums


def mean_corruption_error(errors: Mapping[str, float]) -> float:
    """Return the mean of the corruption errors (mCE); NaN where one is unknown, or without any."""
    return float(np.mean(list(errors.values()))) if errors else math.nan


def harm_rate(together: Sequence[Result], alone: Sequence[Result]) -> float:
    """Return the share of pairs in which cooperation made it worse: it crashes, and the ego alone does not.

    Args:
        alone: results of the same seeds without.
    """
    found = [collided(ours) > collided(theirs) for ours, theirs in pairs(together, alone, any_channel=True)]
    return float(np.mean(found)) if found else math.nan


def gain_per_megabyte(together: Sequence[Result], alone: Sequence[Result]) -> float:
    """Return the crashes that cooperation saves per megabyte received: the difference of their rates over mean MB.

    NaN where nothing was received.

    Args:
        alone: results of the same seeds without.
    """
    found = pairs(together, alone, any_channel=True)
    received = sum(metric(ours, "received_mb") for ours, _ in found)
    if not received > 0.0:
        return math.nan
    return sum(collided(theirs) - collided(ours) for ours, theirs in found) / received


def avoidable(results: Sequence[Result], careful: Sequence[Result]) -> list[float]:
    """Return for each crash 1 if a careful driver avoids it on the same scenario and seed, else 0.

    Crashes on seeds that the careful driver has not driven, or on which it lost the encounter, are left out.

    Source: UN Regulation No. 157, annex 3: a crash is unavoidable if a competent and careful human driver crashes too.

    Args:
        careful: of `CarefulDriver` with the truth.
    """
    known = {(one.scenario, one.seed): collided(one) for one in counted(careful)}
    crashes = [(one.scenario, one.seed) for one in counted(results) if collided(one)]
    return [1.0 - known[key] for key in crashes if key in known]
