"""Tables of campaigns for a terminal."""

from rich.box import SIMPLE
from rich.table import Table
from rich.text import Text

from dsrc.closed_loop.campaign.run import CampaignResult
from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.perception.open import parse_perception
from dsrc.closed_loop.report.cells import COLUMNS, condition_cells, groups
from dsrc.closed_loop.types import Outcome
from sensors.corruptions import CLEAN
from sim.radio import IDEAL


def summary_table(result: CampaignResult) -> Table:
    """Return the table of a campaign for a terminal: a line per perception and condition, by scenario.

    A star marks perceptions that have no class for a conflict actor. Perceptions that failed are below the table.
    """
    several, blind = len(result.plan.scenarios) > 1, not all(one.detectable for one in result.results)
    notes = ["*: no class for the road user"] if blind else []
    for name in dict.fromkeys(one.perception for one in result.results):
        driven = [one for one in result.results if one.perception == name]
        failed = [one.message for one in driven if one.outcome == Outcome.PERCEPTION_FAILED.value]
        if failed:
            notes.append(f"{name}: perception failed in {len(failed)} of {len(driven)} episodes: {failed[0]}")
    caption = Text("\n".join(notes)) if notes else None
    table = Table(title=result.plan.name, caption=caption, box=SIMPLE, padding=0)
    # Names of perceptions and conditions may wrap where the terminal is narrow, the rest may not.
    scenarios = [one.scenario for one in result.results] if several else []
    table.add_column("perception", min_width=max(map(len, scenarios), default=None))
    table.add_column("condition")
    shown = [place for place, heading in enumerate(COLUMNS) if heading != "failed"]
    for place in shown:
        table.add_column(COLUMNS[place], justify="right", no_wrap=True)
    for scenario in dict.fromkeys(one.scenario for one in result.results):
        if several:
            table.add_section()
            table.add_row(f"[bold]{scenario}[/]")
        for perception, condition, group in groups([r for r in result.results if r.scenario == scenario]):
            cells = condition_cells(group)
            values = [cells[place].partition(" [")[0] for place in shown]
            name = perception if all(one.detectable for one in group) else f"{perception} *"
            table.add_row(name, condition, *values)
    return table


def _eyes(log: EpisodeLog, with_driver: bool) -> str:
    """Return the perception of a log, its corruption and channel, and on request its driver."""
    settings = log.settings
    text = parse_perception(settings.perception).name
    text += "" if settings.corruption == CLEAN else f" in {settings.corruption} {settings.severity}"
    text += "" if settings.who == "all" else f" of {settings.who}"
    text += "" if settings.channel == IDEAL else f", {settings.channel}"
    return f"{text}, {settings.driver}" if with_driver else text


def comparison_table(former: EpisodeLog, again: EpisodeLog) -> Table:
    """Return a table of two looks at the same traffic, a line per second."""
    names = tuple(_eyes(log, former.settings.driver != again.settings.driver) for log in (former, again))
    failed = again.outcome is Outcome.PERCEPTION_FAILED
    table = Table(
        title=f"{former.settings.scenario.name}, seed {former.settings.seed}: the same traffic to two eyes",
        caption=Text(f"{names[1]}: perception failed: {again.message}") if failed else None,
    )
    for heading in ("time s", *(f"{what}, {name}" for name in names for what in ("tracks", "m/s²", "because"))):
        table.add_column(heading, justify="right")
    every = max(1, round(1.0 / former.settings.scenario.step_s))
    start = former.ticks[0].actors.time_s
    for row in range(0, min(len(former), len(again)), every):
        both = former.ticks[row], again.ticks[row]
        cells = [
            text
            for tick in both
            for text in (
                str(len(tick.tracks)),
                f"{tick.decision.acceleration_mps2:+.1f}",
                tick.decision.reason,
            )
        ]
        table.add_row(f"{both[0].actors.time_s - start:.1f}", *cells)
    return table
