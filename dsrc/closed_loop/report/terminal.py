"""Tables of campaigns for a terminal."""

from dataclasses import replace

from dsrc.closed_loop.campaign.run import CampaignResult
from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.perception.open import parse_perception
from dsrc.closed_loop.report.cells import COLUMNS, condition_cells, groups, scenario_title
from dsrc.closed_loop.types import FAILED
from dsrc.tables.table import Cell, Column, Table, TableRow
from sensors.corruptions import CLEAN
from sim.radio import IDEAL


def summary_table(result: CampaignResult) -> Table:
    """Table of a campaign for a terminal: a row per perception and condition, by scenario.

    A star marks perceptions that have no class for a conflict actor. What failed has a column, and why is below.
    """
    blind = not all(one.detectable for one in result.results)
    notes = ["*: no class for the road user"] if blind else []
    for name in dict.fromkeys(one.perception for one in result.results):
        driven = [one for one in result.results if one.perception == name]
        for end in FAILED:
            failed = [one.message for one in driven if one.outcome == end]
            if failed:
                notes.append(f"{name}: {end} in {len(failed)} of {len(driven)} episodes: {failed[0]}")
    columns = [Column("perception", align="left"), Column("condition", align="left")]
    failing = any(one.outcome in FAILED for one in result.results)
    columns += [replace(column, terminal=failing or column.title != "failed") for column in COLUMNS]
    rows = []
    scenarios = list(dict.fromkeys(one.scenario for one in result.results))
    for scenario in scenarios:
        for perception, condition, group in groups([r for r in result.results if r.scenario == scenario]):
            values = [cell.partition(" [")[0] for cell in condition_cells(group)]
            name = perception if all(one.detectable for one in group) else f"{perception} *"
            rows.append(TableRow(scenario_title(scenario), (name, condition, *values)))
    caption = "\n".join(notes)
    title = result.plan.name if len(scenarios) > 1 else ""
    return Table("summary", title, "scenario", tuple(columns), tuple(rows), caption=caption, grouped=True)


def _eyes(log: EpisodeLog, with_driver: bool) -> str:
    """Return the perception of a log, its corruption and channel, and on request its driver."""
    settings = log.settings
    text = parse_perception(settings.perception).name
    text += "" if settings.corruption == CLEAN else f" in {settings.condition.label}"
    text += f" with {settings.fault}" if settings.fault else ""
    text += f" defended by {settings.defence}" if settings.defence else ""
    text += "" if settings.channel == IDEAL else f", {settings.channel}"
    return f"{text}, {settings.driver}" if with_driver else text


def comparison_table(former: EpisodeLog, again: EpisodeLog) -> Table:
    """Table of two looks at the same traffic, a row per second."""
    names = tuple(_eyes(log, former.settings.driver != again.settings.driver) for log in (former, again))
    heads = [f"{what}, {name}" for name in names for what in ("tracks", "m/s²", "because")]
    every = max(1, round(1.0 / former.settings.scenario.step_s))
    start = former.ticks[0].actors.time_s
    rows = []
    for number in range(0, min(len(former), len(again)), every):
        both = former.ticks[number], again.ticks[number]
        cells: list[Cell] = []
        for tick in both:
            cells += [len(tick.tracks), f"{tick.decision.acceleration_mps2:+.1f}", tick.decision.reason]
        rows.append(TableRow(f"{both[0].actors.time_s - start:.1f}", tuple(cells)))
    title = f"{former.settings.scenario.name}, seed {former.settings.seed}: the same traffic to two eyes"
    caption = f"{names[1]}: {again.outcome}: {again.message}" if again.outcome in FAILED else ""
    return Table("comparison", title, "time s", tuple(map(Column, heads)), tuple(rows), caption=caption)
