"""Comparisons of perceptions over results made by hand."""

import math
from dataclasses import dataclass, field, replace

import pytest

from dsrc.closed_loop.metrics.comparison import (
    avoidable,
    corruption_errors,
    counted,
    gain_per_megabyte,
    harm_rate,
    mean_corruption_error,
    pairs,
)


@dataclass(frozen=True)
class One:
    scenario: str = "ima"
    perception: str = "ego"
    corruption: str = "clean"
    severity: int = 0
    who: str = "all"
    fault: str = ""
    defence: str = ""
    channel: str = "ideal"
    seed: int = 0
    outcome: str = "arrived"
    metrics: dict[str, float | None] = field(default_factory=dict)


def result(crash: float, seed: int = 0, corruption: str = "clean", severity: int = 0, **rest: float) -> One:
    metrics = {"collision": crash, "driving_score_2_1": 1.0 - 0.5 * crash, **rest}
    return One(seed=seed, corruption=corruption, severity=severity, metrics=metrics)


def test_the_corruption_error_sums_over_severities_before_it_divides() -> None:
    """Rates 0.5 and 1.0 over 0.25 and 0.75: 1.5 / 1.0; the mean of the ratios would be 1.67."""
    ours = [result(k, seed, "fog", 1) for seed, k in enumerate((1.0, 0.0))]
    ours += [result(1.0, seed, "fog", 3) for seed in range(2)]
    base = [result(k, seed, "fog", 1) for seed, k in enumerate((1.0, 0.0, 0.0, 0.0))]
    base += [result(k, seed, "fog", 3) for seed, k in enumerate((1.0, 1.0, 1.0, 0.0))]
    assert corruption_errors(ours, base) == {"fog": pytest.approx(1.5)}


def test_an_error_without_a_like_reference_is_unknown_and_so_is_the_mean() -> None:
    ours = [result(1.0, 0, "fog", 1), result(1.0, 0, "snow", 1)]
    base = [result(0.0, 0, "fog", 1), result(1.0, 0, "snow", 3)]
    errors = corruption_errors(ours, base)
    assert math.isnan(errors["fog"]) and math.isnan(errors["snow"])
    assert math.isnan(mean_corruption_error(errors))
    assert mean_corruption_error({"fog": 1.5, "snow": 0.5}) == 1.0


def test_clean_episodes_and_those_that_lost_their_encounter_are_no_error() -> None:
    lost = One(corruption="fog", severity=1, seed=1, outcome="desynchronised", metrics={"collision": 1.0})
    ours = [result(0.0), result(0.0, 0, "fog", 1), lost]
    assert corruption_errors(ours, [result(1.0, 0, "fog", 1)]) == {"fog": 0.0}


def test_a_perception_that_fails_is_no_episode_without_a_crash() -> None:
    failed, driven = replace(result(0.0), outcome="perception failed"), result(0.0, seed=1)
    assert counted([failed, driven]) == [driven]
    assert counted([failed, driven], failed=True) == [failed, driven], "and it is no arrival"
    assert pairs([failed], [result(0.0)]) == [] and len(pairs([failed], [result(0.0)], failed=True)) == 1


def test_pairs_are_of_one_scenario_seed_and_corruption() -> None:
    ours = [result(0.0, 0), result(0.0, 1), result(0.0, 2, "fog", 1)]
    others = [result(1.0, 1), result(1.0, 2)]
    assert pairs(ours, others) == [(ours[1], others[0])]
    with pytest.raises(ValueError, match="two results"):
        pairs(ours, [others[0], others[0]])


def test_harm_is_the_share_of_pairs_that_cooperation_made_worse() -> None:
    together = [result(k, seed) for seed, k in enumerate((1.0, 0.0, 0.0, 1.0))]
    alone = [result(k, seed) for seed, k in enumerate((0.0, 1.0, 0.0, 1.0))]
    assert harm_rate(together, alone) == 0.25
    assert math.isnan(harm_rate(together, []))


def test_the_gain_per_megabyte_is_what_was_saved_over_what_was_received() -> None:
    """Two of three crashes less for 0.5, 1.5 and 2 MB: 2 / 4; through any channel against an ego that has none."""
    together = [
        One(seed=seed, channel="its-g5-6", metrics={"collision": 0.0, "received_mb": size})
        for seed, size in enumerate((0.5, 1.5, 2.0))
    ]
    alone = [result(k, seed) for seed, k in enumerate((1.0, 1.0, 0.0))]
    assert gain_per_megabyte(together, alone) == pytest.approx(0.5)
    assert math.isnan(gain_per_megabyte(alone, alone))


def test_a_crash_is_avoidable_if_the_careful_driver_avoids_it() -> None:
    """Of five crashes it avoids two and shares one; one it has not driven, and on one it lost its encounter."""
    results = [result(1.0, seed) for seed in range(5)] + [result(0.0, 5)]
    careful = [result(0.0, 0), result(0.0, 1), result(1.0, 2), replace(result(0.0, 3), outcome="desynchronised")]
    assert avoidable(results, [*careful, result(0.0, 5)]) == [1.0, 1.0, 0.0]
    assert avoidable([result(0.0)], careful) == []
