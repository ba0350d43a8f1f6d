"""Scores side by side, and routes with and without their hazard."""

from typing import Any

import msgspec

from dsrc.closed_loop.campaign.episode import EpisodeResult
from dsrc.closed_loop.campaign.run import CampaignResult
from dsrc.closed_loop.report.conditions import Condition, judged
from dsrc.closed_loop.report.scores import HAZARD_HEADS, SCORE_HEADS, hazard_rows, score_rows, success
from dsrc.closed_loop.report.tables import tables
from tests.dsrc.closed_loop.results import PLAN, one


def control(result: EpisodeResult, name: str = "no_conflict") -> EpisodeResult:
    return msgspec.structs.replace(result, scenario=f"{result.scenario}:{name}")


def named(heads: tuple[str, ...], row: tuple[str, ...]) -> dict[str, Any]:
    return dict(zip(heads, row, strict=True))


def test_a_success_is_an_arrival_without_an_infraction() -> None:
    assert success(one("a", 0, "arrived")) == 1.0
    assert success(one("a", 0, "arrived", red_lights=1.0)) == 0.0, "a red light"
    assert [success(one("a", 0, end)) for end in ("crashed", "timeout", "perception failed")] == [0.0, 0.0, 0.0]
    results = [one("a", 0, "arrived", red_lights=1.0), one("a", 1, "arrived"), one("a", 2, "desynchronised")]
    (half,) = judged([Condition.parse("success>=50%")], results)
    assert half.holds and half.episodes == 2


def test_time_is_of_arrivals_and_scores_are_of_all_that_met_their_encounter() -> None:
    results = [one("a", 0, "arrived", duration_s=10.0, pdms=1.0, seen_s=2.0)]
    results += [one("a", 1, "crashed", duration_s=3.0, pdms=0.0, seen_s=4.0), one("a", 2, "desynchronised", pdms=1.0)]
    (row,) = score_rows(results)
    found = named(SCORE_HEADS, row)
    assert found["episodes"] == "2" and found["s to arrive"] == "10.0"
    assert found["PDMS"].startswith("0.50 [") and found["first sight s"].startswith("3.0 [")
    assert found["success"].startswith("50 % [") and found["comfort"] == "", "no episode has it"


def test_a_route_is_compared_with_its_counterpart_of_the_same_seed_perception_and_condition() -> None:
    here = [one("a", 0, "crashed"), one("a", 1, "arrived", duration_s=12.0), one("b", 0, "arrived", duration_s=9.0)]
    without = [one("a", 0, "arrived"), one("a", 1, "arrived", duration_s=9.0), one("b", 1, "arrived")]
    fog = [one("a", 0, "crashed", "fog")]
    (row,) = hazard_rows([*here, *fog, *map(control, without)])
    found = named(HAZARD_HEADS, row)
    assert (found["perception"], found["condition"], found["without"], found["pairs"]) == (
        "a",
        "clean",
        "no_conflict",
        "2",
    )
    assert found["success without"].startswith("100 %") and found["success with"].startswith("50 %")
    assert found["more successes"].startswith("-50 % [") and found["more s"] == "3.0"
    assert not hazard_rows(here), "without controls there is nothing to compare"


def test_the_report_has_both_tables() -> None:
    results = [one("truth", 0, "arrived", duration_s=10.0), control(one("truth", 0, "arrived", duration_s=8.0))]
    found = tables(CampaignResult(PLAN, tuple(results), (), (), 0, 0.0))
    assert len(found["scores"].rows) == 1 and len(found["hazards"].rows) == 1
    assert "hazards" not in tables(CampaignResult(PLAN, tuple(results[:1]), (), (), 0, 0.0))
