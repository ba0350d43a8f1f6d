"""Tables of a campaign: what they count, and what they leave out."""

import pytest
from msgspec.structs import replace

from dsrc.closed_loop.campaign.episode import EpisodeResult
from dsrc.closed_loop.campaign.plan import Campaign, PerceptionSpec
from dsrc.closed_loop.campaign.run import CampaignResult
from dsrc.closed_loop.report.tables import ALL_CORRUPTIONS, tables
from tests.dsrc.closed_loop.results import PLAN, RESULTS, one


def tables_of(*results: EpisodeResult, plan: Campaign = PLAN) -> dict[str, list[list[str]]]:
    """Cells of the tables by name, headings first."""
    found = tables(CampaignResult(plan, results, (), (), 0, 0.0))
    return {
        name: [
            [cell.strip() for cell in line.strip("|").split("|")]
            for line in table.markdown().splitlines()
            if line.startswith("|") and not line.startswith("| ---")
        ]
        for name, table in found.items()
    }


def test_rates_and_arrivals_are_of_the_episodes_that_met_their_encounter() -> None:
    found = tables_of(*RESULTS)
    assert found["arrived"] == [
        ["perception", "clean", "fog 3", "snow 3", ALL_CORRUPTIONS],
        ["truth", "3 of 3", "", "", ""],
        ["alone", "0 of 3", "0 of 2", "0 of 2", "0 of 4"],
        ["together", "2 of 2", "2 of 2", "2 of 2", "4 of 4"],
    ]
    crashed = {row[0]: row[1:] for row in found["crashed"]}
    assert crashed["alone"][0].startswith("100 % [") and crashed["alone"][1].startswith("0 % [")
    assert crashed["alone"][-1] == "0 %", "episodes of one seed are alike, so there is no interval of independent ones"
    assert crashed["together"][0].startswith("0 % [")


def test_a_fault_of_the_radio_alone_is_a_column_as_other_faults_are() -> None:
    """It is written as a channel, so that both spellings find one episode; another channel has no column."""
    plan = Campaign(
        scenarios=PLAN.scenarios, perceptions=PLAN.perceptions, channel=("ideal", "c-v2x"), fault=("loss:0.3",)
    )
    driven = [
        replace(one("together", seed, outcome), channel=channel)
        for channel, outcome in (("ideal", "arrived"), ("ideal,loss=0.3", "crashed"), ("c-v2x", "crashed"))
        for seed in range(2)
    ]
    found = tables_of(*driven, plan=plan)
    assert found["arrived"] == [["perception", "clean", "ideal,loss=0.3"], ["together", "2 of 2", "0 of 2"]]
    assert [row[1] for row in found["conditions"][1:]] == ["clean", "ideal,loss=0.3", "c-v2x"]
    assert found["scenarios"][1][1].startswith("0 % ["), "clean episodes have no fault"


def test_a_perception_that_fails_neither_crashes_nor_arrives() -> None:
    found = tables_of(one("together", 0, "crashed", at_fault=0.0), one("together", 1, "perception failed"))
    assert found["arrived"][1] == ["together", "0 of 2"]
    assert found["crashed"][1][1].startswith("100 % [")
    cells = dict(zip(found["conditions"][0], found["conditions"][1], strict=True))
    assert (cells["episodes"], cells["at fault"], cells["lost"], cells["failed"]) == ("2", "0", "0", "1")


def test_pairs_of_one_encounter_and_seed_are_one_cluster_under_all_corruptions() -> None:
    found = tables_of(*RESULTS)
    assert found["arrivals"] == [
        ["", "clean", "fog 3", "snow 3", ALL_CORRUPTIONS],
        ["together less alone", "+100 (2, 0)", "+100 (2, 0)", "+100 (2, 0)", "+100 (4, 0)"],
    ]
    rows = {tuple(row[:2]): row[2:] for row in found["differences"]}
    assert rows["together", "clean"][0] == "2" and rows["together", "clean"][1].startswith("-100 %")
    # Two clusters of two pairs: of four ways to swap them two are as far from 0; nobody crashes under corruptions.
    assert rows["together", ALL_CORRUPTIONS][0] == "4" and rows["together", ALL_CORRUPTIONS][2] == "1.000"
    many = [
        one(name, seed, outcome)
        for seed in range(6)
        for name, outcome in (("alone", "timeout"), ("together", "arrived"))
    ]
    assert tables_of(*many)["arrivals"][1][1] == "**+100 (6, 0)**", "p = 2 / 2^6"


@pytest.mark.parametrize(
    ("seen_s", "tracked_s", "column"),
    [
        pytest.param(3.6, 3.7, "seen late", id="seen 1.4 s before"),
        pytest.param(35 * 0.1, 36 * 0.1, "in time", id="seen 1.5 s before"),
        pytest.param(14 * 0.1, 19 * 0.1, "tracked late", id="tracked 0.5 s later"),
        pytest.param(14 * 0.1, 18 * 0.1, "in time", id="tracked 0.4 s later"),
        pytest.param(2.0, None, "tracked late", id="never tracked"),
        pytest.param(None, None, "not seen", id="never seen"),
    ],
)
def test_a_crash_has_one_thing_that_came_late(seen_s: float | None, tracked_s: float | None, column: str) -> None:
    times = {"duration_s": 5.0, "seen_s": seen_s, "tracked_s": tracked_s}
    heads, counts = tables_of(one("alone", 0, "crashed", **times))["causes"]
    assert [head for head, count in zip(heads[3:], counts[3:], strict=True) if count == "1"] == [column]


def test_time_and_braking_are_compared_where_a_driver_arrives_with_all_of_its_eyes() -> None:
    def driven(name: str, *seconds: float, brake: float = 3.0) -> list[EpisodeResult]:
        more = {"mean_speed_mps": 10.0, "hardest_brake_mps2": brake}
        ends = ["crashed" if one == 0.0 else "arrived" for one in seconds]
        both = enumerate(zip(ends, seconds, strict=True))
        return [one(name, seed, end, duration_s=value, **more) for seed, (end, value) in both]

    results = [*driven("truth", 8.0, 9.0, 10.0), *driven("alone", 0.0, 12.0, 13.0, brake=5.0)]
    results += driven("together", 8.0, 9.0, 14.0)
    assert "pace" not in tables_of(*results), "plans of one driver have their other tables"
    plan = replace(PLAN, perceptions=tuple(replace(one, driver="planning") for one in PLAN.perceptions))
    found = tables_of(*results, plan=plan)["pace"]
    rows = {row[0]: dict(zip(found[0], row, strict=True)) for row in found[1:]}
    assert {row["all arrive"] for row in rows.values()} == {"2"} and {row["driver"] for row in rows.values()} == {
        "planning"
    }
    assert rows["alone"]["crashed"].startswith("33 % [") and rows["truth"]["crashed"].startswith("0 % [")
    assert rows["alone"]["less the first"] == "+3.0 [3.0, 3.0]" and rows["truth"]["less the first"] == ""
    assert rows["together"]["less the first"].startswith("+2.0 [")
    assert rows["alone"]["harsh"].startswith("100 %") and rows["together"]["harsh"].startswith("0 %")
    assert rows["truth"]["m/s"] == "10.0 [10.0, 10.0]"


def test_drivers_are_compared_with_themselves_alone() -> None:
    own = PerceptionSpec(name="alone", uses="ego", driver="anticipating")
    plan = replace(PLAN, perceptions=(PLAN.perceptions[0], own))
    results = tuple(one(name, 0, "arrived", duration_s=9.0) for name in ("truth", "alone"))
    assert "pace" not in tables(CampaignResult(plan, results, (), (), 0, 0.0))


def test_a_scenario_of_a_path_has_the_name_of_its_folder() -> None:
    for path, title in (("runs/mined/queue_1", "queue_1"), ("town/scenario.toml", "town"), ("lta_truck", "lta_truck")):
        rows = tables_of(*(replace(episode, scenario=path) for episode in RESULTS))["scenarios"]
        assert [row[0] for row in rows] == ["scenario", title]


def test_without_an_encounter_there_is_nobody_to_see() -> None:
    assert "causes" not in tables_of(one("alone", 0, "crashed", road_user="", duration_s=5.0))


def test_without_results_there_are_no_tables() -> None:
    assert not tables_of()


def test_attacks_and_defences_are_a_table_of_who_stopped_and_who_was_refused() -> None:
    plan = replace(PLAN, perceptions=(PerceptionSpec(name="team-sight"),), fault=("ghost",), defence=("none", "motion"))
    told = {"needless_stops": 0.0, "helpers_honest": 2.0, "helpers_wronged": 0.0, "false_told": 0.0}
    lie = told | {"helpers_honest": 1.0, "false_told": 10.0, "false_refused": 5.0}
    stuck = lie | {"needless_stops": 1.0, "false_refused": 0.0}
    defended = {"fault": "ghost:1", "defence": "free-space,motion"}
    results = [
        one("team-sight", 0, "arrived", needless_stops=0.0),
        replace(one("team-sight", 0, "stuck", **stuck), fault="ghost:1"),
        replace(one("team-sight", 1, "desynchronised", **stuck), fault="ghost:1"),
        *(
            replace(one("team-sight", seed, "arrived", **(lie | {"helpers_wronged": seed})), **defended)
            for seed in range(2)
        ),
    ]
    heads, *rows = tables_of(*results, plan=plan)["lies"]
    cells = [dict(zip(heads, row, strict=True)) for row in rows]
    assert [(row["attack"], row["defence"], row["episodes"], row["met"]) for row in cells] == [
        ("clean", "none", "1", "1"), ("ghost:1", "none", "2", "1"), ("ghost:1", "free-space, motion", "2", "2"),
    ]  # fmt: skip
    assert [row["arrived"] for row in cells] == ["100 % [21, 100]", "0 % [0, 66]", "100 % [34, 100]"]
    assert [row["needless stops"].partition(" [")[0] for row in cells] == ["0 %", "100 %", "0 %"]
    assert [row["attacks refused"].partition(" [")[0] for row in cells] == ["", "0 %", "50 %"]
    assert [row["wrongly refused"].partition(" [")[0] for row in cells] == ["", "0 %", "50 %"]
    assert "lies" not in tables_of(*RESULTS)
