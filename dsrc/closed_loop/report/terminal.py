"""Tables of campaigns for a terminal."""

from rich.box import SIMPLE
from rich.table import Table

from dsrc.closed_loop.campaign.run import CampaignResult
from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.report.cells import COLUMNS, condition_cells, groups


def summary_table(result: CampaignResult) -> Table:
    """Return the table of a campaign for a terminal: a line per perception and condition, by scenario.

    A star marks perceptions that have no class for a conflict actor.
    """
    several, blind = len(result.plan.scenarios) > 1, not all(one.detectable for one in result.results)
    caption = "*: no class for the road user" if blind else None
    table = Table(title=result.plan.name, caption=caption, box=SIMPLE, padding=0)
    # Names of perceptions and conditions may wrap where the terminal is narrow, the rest may not.
    scenarios = [one.scenario for one in result.results] if several else []
    table.add_column("perception", min_width=max(map(len, scenarios), default=None))
    table.add_column("condition")
    for heading in COLUMNS:
        table.add_column(heading, justify="right", no_wrap=True)
    for scenario in dict.fromkeys(one.scenario for one in result.results):
        if several:
            table.add_section()
            table.add_row(f"[bold]{scenario}[/]")
        for perception, condition, group in groups([r for r in result.results if r.scenario == scenario]):
            values = [value.partition(" [")[0] for value in condition_cells(group)]
            name = perception if all(one.detectable for one in group) else f"{perception} *"
            table.add_row(name, condition, *values)
    return table


def comparison_table(former: EpisodeLog, again: EpisodeLog) -> Table:
    """Return a table of two looks at the same traffic, a line per second."""
    names = former.settings.perception, again.settings.perception
    table = Table(title=f"{former.settings.scenario.name}, seed {former.settings.seed}: the same traffic to two eyes")
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
