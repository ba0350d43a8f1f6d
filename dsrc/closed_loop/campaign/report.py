"""Report of a campaign: a table for the terminal, tables in Markdown, plots, and the worst episodes by name."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.box import SIMPLE
from rich.table import Table

from dsrc.closed_loop.campaign.episode import EpisodeResult
from dsrc.closed_loop.campaign.plan import Campaign
from dsrc.closed_loop.campaign.run import CampaignResult
from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.metrics.comparison import (
    Result,
    avoidable,
    collided,
    corruption_errors,
    counted,
    gain_per_megabyte,
    harm_rate,
    mean_corruption_error,
    metric,
    pairs,
)
from dsrc.closed_loop.metrics.statistics import Estimate, mean, paired_rates, rate
from dsrc.closed_loop.types import Outcome
from sensors.corruptions import CLEAN
from sim.files import write_file
from sim.radio import get_channel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WORST = 12
_SEEN_S = 1.5
"""Least time between the first box of the conflict actor and the crash: who drives 40 km/h stops in it, at 8 m/s2."""
_TRACKED_S = 0.4
"""Most time between its first box and its track: two more percepts at 5 Hz."""
_COLUMNS = ("episodes", "crashed", "stuck", "lost", "score", "progress")


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
    for heading in _COLUMNS:
        table.add_column(heading, justify="right", no_wrap=True)
    for scenario in dict.fromkeys(one.scenario for one in result.results):
        if several:
            table.add_section()
            table.add_row(f"[bold]{scenario}[/]")
        for perception, condition, group in _groups([r for r in result.results if r.scenario == scenario]):
            values = [value.partition(" [")[0] for value in _cells(group)]
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


def write_report(result: CampaignResult, out: Path) -> list[Path]:
    """Write report.md and its plots into a folder; return the paths."""
    from dsrc.evaluation.figures.style import png_bytes

    pictures = []
    for name, figure in _plots(result).items():
        path = out / f"{name}.png"
        write_file(path, png_bytes(figure))
        pictures.append(path)
    report = out / "report.md"
    write_file(report, markdown(result, [path.name for path in pictures]))
    return [report, *pictures, out / "results.csv"]


def _plots(result: CampaignResult) -> "dict[str, Figure]":
    """Return the plots that a campaign has results for, by name: of one severity, but for theirs of one channel."""
    # Matplotlib takes as long to import as all else that a finished campaign's table needs.
    from dsrc.closed_loop.report.plots import (
        collision_and_score,
        cost_of_channel,
        deadly_corruptions,
        rate_over_severity,
    )

    common, apart = _parts(result)
    plan, every = result.plan, common or apart
    severity = plan.severities[len(plan.severities) // 2]
    one_channel = [one for one in every if one.channel == plan.channels[0]]
    shown = [one for one in one_channel if one.corruption == CLEAN or one.severity == severity]
    figures = {"collisions": collision_and_score(shown, title=plan.name)}
    if any(one.corruption != CLEAN for one in shown):
        figures["corruptions"] = deadly_corruptions(shown)
    if len(plan.severities) > 1:
        figures["severities"] = rate_over_severity(one_channel)
    clean = [one for one in every if one.corruption == CLEAN]
    quantities = {"delay, s": _delay_s, "lost packets": _loss}
    cost = {label: value for label, value in quantities.items() if len({value(one) for one in clean}) > 1}
    if cost:
        figures["channels"] = cost_of_channel(clean, cost)
    return figures


def _delay_s(result: Result) -> float:
    return get_channel(result.channel).delay_s


def _loss(result: Result) -> float:
    return get_channel(result.channel).packet_loss


def markdown(result: CampaignResult, pictures: Sequence[str] = ()) -> str:
    """Return the tables of a campaign in Markdown.

    Args:
        result: of the campaign.
        pictures: names of plots to show.
    """
    common, apart = _parts(result)
    parts = [f"# {result.plan.name}", _conditions_part(result, common), _apart_part(result, apart)]
    parts += [f"![{name.removesuffix('.png').replace('_', ' ')}]({name})" for name in pictures]
    first = result.plan.channels[0]
    parts += [_scenarios_part([[one for one in part if one.channel == first] for part in (common, apart)])]
    parts += [_differences_part(result.plan, common)]
    parts += [_robustness_part(result.plan, common), _causes_part(common), _worst_part(result)]
    if result.controls:
        fine = sum(one.outcome == Outcome.ARRIVED.value for one in result.controls)
        parts.append(f"Controls with the truth: {fine} of {len(result.controls)} arrived.")
    return "\n\n".join(part for part in parts if part) + "\n"


def _parts(result: CampaignResult) -> tuple[list[EpisodeResult], list[EpisodeResult]]:
    """Return the episodes that all perceptions of a campaign have the classes for, and the others.

    A comparison over the others would compare classes: who has none for a pedestrian is blind by construction.
    """
    unknown = {(one.scenario, one.seed) for one in result.results if not one.detectable}
    apart = [one for one in result.results if (one.scenario, one.seed) in unknown]
    return [one for one in result.results if (one.scenario, one.seed) not in unknown], apart


def _unknown(group: Sequence[EpisodeResult]) -> str:
    """Return the number of episodes with a road user that the perception has no class for."""
    return str(sum(not one.detectable for one in group))


def _conditions_part(result: CampaignResult, common: Sequence[EpisodeResult]) -> str:
    if not common:
        return ""
    text = (
        "Crashed: share of the episodes that met their encounter, with its Wilson interval of 95 %. Lost: episodes "
        "that never met it, not counted. Score: CARLA's driving score 2.1, with a bootstrap interval. Progress: share "
        "of the reference distance."
    )
    if result.careful:
        text += (
            " Avoidable: share of the crashes that the careful driver of UN R157 avoids on the same seeds when it "
            "knows the truth, with its Wilson interval."
        )
    return f"## All scenarios\n\n{_conditions(result, common)}\n\n{text}"


def _apart_part(result: CampaignResult, apart: Sequence[EpisodeResult]) -> str:
    """Return the table of the episodes that a perception has no class for."""
    if not apart:
        return ""
    kinds = " and ".join("buses" if kind == "bus" else f"{kind}s" for kind in sorted({one.road_user for one in apart}))
    text = (
        f"Encounters with {kinds}, which some perceptions have no class for: no part of the table of all scenarios, of "
        "the paired differences and of the corruption errors. No class: episodes in which the perception is blind for "
        "the conflict actor for that reason."
    )
    return f"## {kinds.capitalize()}\n\n{text}\n\n{_conditions(result, apart, blind=True)}"


def _conditions(result: CampaignResult, results: Sequence[EpisodeResult], blind: bool = False) -> str:
    """Return a table with a line per perception and condition."""
    more = (["avoidable"] if result.careful else []) + (["no class"] if blind else [])
    headings = ("perception", "condition", *_COLUMNS, *more)
    lines = [_row(*headings), _rule(len(headings))]
    for perception, condition, group in _groups(results):
        avoided = [_share(rate(avoidable(group, result.careful)))] if result.careful else []
        unknown = [_unknown(group)] if blind else []
        lines.append(_row(perception, condition, *_cells(group), *avoided, *unknown))
    return "\n".join(lines)


def _scenarios_part(parts: Sequence[Sequence[EpisodeResult]]) -> str:
    """Return the clean collision rates by scenario and perception, marked where it has no class.

    Args:
        parts: of one channel, the episodes for all perceptions and those that are apart.
    """
    common, apart = parts
    rows = []
    names = list(dict.fromkeys(one.perception for one in (*common, *apart)))
    for part, results in (("", common), ("apart", apart)):
        clean = [one for one in results if one.corruption == CLEAN]
        for scenario in dict.fromkeys(one.scenario for one in clean):
            group = [one for one in clean if one.scenario == scenario]
            title = f"{scenario} ({group[0].road_user})" if part else scenario
            rows.append(_row(title, *(_crashes([one for one in group if one.perception == name]) for name in names)))
    lines = [_row("scenario", *names), _rule(len(names) + 1), *rows]
    text = "Share of episodes with a crash, through the first channel." + (
        " *: no class for the road user." if apart else ""
    )
    return f"## By scenario, clean\n\n{text}\n\n" + "\n".join(lines)


def _crashes(group: Sequence[EpisodeResult]) -> str:
    """Return the collision rate of some episodes, and how many were stuck or lost."""
    met = counted(group)
    counts = {"stuck": sum(one.outcome == Outcome.STUCK.value for one in group), "lost": len(group) - len(met)}
    rates = _share(rate([collided(one) for one in met]))
    text = ", ".join([rates, *(f"{count} {what}" for what, count in counts.items() if count)])
    return text if all(one.detectable for one in group) else f"{text} *"


def _differences_part(plan: Campaign, results: Sequence[EpisodeResult]) -> str:
    """Return what each perception gains over `ego`, the detector without helpers, over paired episodes."""
    alone = next((one.name for one in plan.perceptions if one.kind == "ego"), None)
    if alone is None or len(plan.perceptions) < 2:
        return ""
    lines = [
        _row("perception", "condition", "pairs", f"crashes less those of {alone}", "p", "harm rate", "gain per MB"),
        _rule(7),
    ]
    base = [one for one in results if one.perception == alone]
    for perception, condition, group in _groups(results):
        if perception == alone:
            continue
        matched = pairs(group, base, any_channel=True)
        if not matched:
            continue
        ours, theirs = [collided(a) for a, _ in matched], [collided(b) for _, b in matched]
        found = paired_rates(ours, theirs)
        same = [b for _, b in matched]
        harm = harm_rate([a for a, _ in matched], same)
        gain = gain_per_megabyte([a for a, _ in matched], same)
        lines.append(
            _row(
                perception,
                condition,
                str(len(matched)),
                _share(found.difference, signed=True),
                f"{found.p_value:.3f}",
                _percent(harm),
                "" if gain != gain else f"{gain:.3f}",
            )
        )
    return "## Paired differences\n\n" + "\n".join(lines)


def _robustness_part(plan: Campaign, results: Sequence[EpisodeResult]) -> str:
    """Return corruption errors of every perception relative to `ego`, the form of mCE."""
    alone = next((one.name for one in plan.perceptions if one.kind == "ego"), None)
    kinds = list(dict.fromkeys(one.corruption for one in results if one.corruption != CLEAN))
    if alone is None or not kinds:
        return ""
    base = [one for one in results if one.perception == alone and one.corruption != CLEAN]
    lines = [_row("perception", "mCE", *kinds), _rule(len(kinds) + 2)]
    for one in plan.perceptions:
        own = [r for r in results if r.perception == one.name and r.corruption != CLEAN]
        if own:
            errors = corruption_errors(own, base)
            values = [mean_corruption_error(errors), *(errors.get(kind, float("nan")) for kind in kinds)]
            lines.append(_row(one.name, *("" if value != value else f"{value:.2f}" for value in values)))
    text = f"Collision rate under a corruption over that of {alone}; 1 is as bad."
    return f"## Closed-loop corruption error\n\n{text}\n\n" + "\n".join(lines)


def _causes_part(results: Sequence[EpisodeResult]) -> str:
    """Return what came late in the crashes of encounters: the sight of the conflict actor, its track, or neither."""
    crashed = [one for one in results if one.outcome == Outcome.CRASHED.value and one.road_user]
    if not crashed:
        return ""
    kinds = ("not seen", "seen late", "tracked late", "in time")
    lines = [_row("perception", "condition", "crashes", *kinds), _rule(7)]
    for perception, condition, group in _groups(crashed):
        found = [_late(one) for one in group]
        lines.append(_row(perception, condition, str(len(group)), *(str(found.count(kind)) for kind in kinds)))
    text = (
        "Crashes in encounters, whoever the ego crashed with, by what came late first. Not seen: no percept had a box "
        f"of the conflict actor. Seen late: the first one did less than {_SEEN_S:g} s before the crash. Tracked late: "
        f"its track was confirmed more than {_TRACKED_S:g} s after that, or never. In time: neither."
    )
    return f"## What came late\n\n{text}\n\n" + "\n".join(lines)


def _late(one: EpisodeResult) -> str:
    seen_s, tracked_s, crash_s = (metric(one, name) for name in ("seen_s", "tracked_s", "duration_s"))
    if seen_s != seen_s:
        return "not seen"
    # Times are sums of steps: rounded, so that equal ones are.
    if round(crash_s - seen_s, 6) < _SEEN_S:
        return "seen late"
    return "in time" if round(tracked_s - seen_s, 6) <= _TRACKED_S else "tracked late"


def _worst_part(result: CampaignResult) -> str:
    crashed = [one for one in result.results if one.outcome == Outcome.CRASHED.value and one.detectable]
    failed = [one for one in result.results if one.outcome == Outcome.PERCEPTION_FAILED.value]
    if not crashed and not failed:
        return ""
    worst = sorted(crashed, key=lambda one: -metric(one, "delta_v_mps"))[:_WORST]
    lines = [_row("scenario", "seed", "perception", "condition", "closing m/s", "delta-v m/s", "log"), _rule(7)]
    for one in worst:
        closing, change = metric(one, "impact_mps"), metric(one, "delta_v_mps")
        numbers = f"{closing:.1f}", f"{change:.1f}"
        lines.append(
            _row(one.scenario, str(one.seed), one.perception, _condition(one), *numbers, f"episodes/{one.key}.npz")
        )
    text = "## Hardest crashes\n\n" + "\n".join(lines)
    if failed:
        first = failed[0]
        text += f"\n\nPerceptions failed in {len(failed)} episodes, first: {first.message}"
    return text


def _groups(results: Sequence[EpisodeResult]) -> list[tuple[str, str, list[EpisodeResult]]]:
    """Return results by perception and condition, in the order of their first appearance."""
    found: dict[tuple[str, str], list[EpisodeResult]] = {}
    for perception in dict.fromkeys(one.perception for one in results):
        for one in (one for one in results if one.perception == perception):
            found.setdefault((perception, _condition(one)), []).append(one)
    return [(*key, group) for key, group in found.items()]


def _condition(one: EpisodeResult) -> str:
    text = one.corruption if one.corruption == CLEAN else f"{one.corruption} {one.severity}"
    text += "" if one.who == "all" else f", {one.who}"
    return text if one.channel == "ideal" else f"{text}, {one.channel}"


def _cells(group: Sequence[EpisodeResult]) -> tuple[str, ...]:
    met = counted(group)
    return (
        str(len(group)),
        _share(rate([collided(one) for one in met])),
        str(sum(one.outcome == Outcome.STUCK.value for one in group)),
        str(len(group) - len(met)),
        _score(mean([metric(one, "driving_score_2_1") for one in met])),
        _percent(mean([metric(one, "completion") for one in met]).value),
    )


def _share(found: Estimate, signed: bool = False) -> str:
    if found.value != found.value:
        return ""
    sign = "+" if signed else ""
    return f"{100 * found.value:{sign}.0f} % [{100 * found.low:.0f}, {100 * found.high:.0f}]"


def _score(found: Estimate) -> str:
    if found.value != found.value:
        return ""
    return f"{found.value:.2f}" + ("" if found.low != found.low else f" [{found.low:.2f}, {found.high:.2f}]")


def _percent(value: float) -> str:
    return "" if value != value else f"{100 * value:.0f} %"


def _row(*cells: str) -> str:
    return "| " + " | ".join(cells) + " |"


def _rule(columns: int) -> str:
    return "|" + "---|" * columns
