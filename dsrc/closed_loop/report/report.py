"""Report of a campaign: report.md with its tables, plots, and the sections of a document with them."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from dsrc.closed_loop.campaign.plan import Campaign
from dsrc.closed_loop.campaign.run import CampaignResult
from dsrc.closed_loop.metrics.comparison import Result
from dsrc.closed_loop.report.findings import NOTHING, Findings, causes_csv, joined_calibrations
from dsrc.closed_loop.report.gate import GATE_NAMES
from dsrc.closed_loop.report.page import campaign_page
from dsrc.closed_loop.report.tables import NAMES, of_first_channel, parts_of, tables
from dsrc.runs.executors import Progress
from dsrc.runs.provenance import provenance
from dsrc.tables.document import Section, check_document, publish
from sensors.corruptions import CLEAN
from sim.files import write_file
from sim.radio import get_channel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PICTURES = {
    "collisions": "Collision rate and driving score of each perception, clean and under each corruption or fault",
    "corruptions": "Which corruption kills: collision rate of each perception, by scenario and corruption",
    "severities": "Collision rate over the severity of each corruption",
    "channels": "Cost of the delay and the loss of messages",
    "shares": "Causes of the crashes",
    "reliability": "How often detections of a score are right, in the loop",
}
"""Captions of the plots, by name."""


def write_report(
    result: CampaignResult, out: Path, more: Findings = NOTHING, progress: Progress | None = None
) -> list[Path]:
    """Write report.md, its plots and report.html into the folder of a campaign; return all paths of its results.

    Args:
        progress: called with pictures of failures done and pictures in all.
    """
    from dsrc.tables.figure import write_figure

    pictures, plots = [], _plots(result, more)
    made_by = provenance(msgspec.to_builtins(result.plan), seed=0)  # the seeds are in the plan
    for name, plot in plots.items():
        path = out / f"{name}.png"
        write_figure(path, plot(), made_by)
        pictures.append(path)
    for name in _PICTURES.keys() - plots.keys():
        (out / f"{name}.png").unlink(missing_ok=True)  # of a run before
    report = out / "report.md"
    write_file(report, markdown(result, more))
    causes = [out / "causes.csv"] if more.causes else []
    (out / "causes.csv").unlink(missing_ok=True)
    for path in causes:
        write_file(path, causes_csv(result.results, more.causes))
    page, every = out / "report.html", tables(result, more).values()
    shown = [(_PICTURES[name], out / f"{name}.png") for name in plots]
    write_file(page, campaign_page(result, more, every, shown, out / "episodes", progress))
    return [report, page, *pictures, out / "results.csv", *causes]


def check_publication(plan: Campaign, document: Path) -> None:
    """Check before a campaign that its tables can be written into a document, see `publish_report`.

    Raises:
        UserError: the document cannot be written to or is no text; a marker has no end, or is of no section.
    """
    check_document(document, plan.name, (*NAMES, *_PICTURES))


def publish_report(result: CampaignResult, out: Path, document: Path, more: Findings = NOTHING) -> Path:
    """Write the tables and plots of a campaign between their markers in a document, their files beside it.

    Args:
        out: its folder, with the report.
        document: Markdown, see `dsrc.tables.document.publish`; sections are named like the tables and plots.

    Returns:
        The folder of the files beside the document.

    Raises:
        DataError: the document is no text, or a begin marker has no end.
    """
    found = sections(result, more)
    absent = [name for name in (*NAMES, *_PICTURES) if name not in {section.name for section in found}]
    files = ["report.md", "results.csv", *(f"{name}.png" for name in _plots(result, more))]
    files += [f"{name}.csv" for name in ("controls", "careful") if getattr(result, name)]
    return publish(found, out, document, result.plan.name, files, absent)


def markdown(result: CampaignResult, more: Findings = NOTHING) -> str:
    """Return the report of a campaign."""
    disturbed = "with a fault" if any(one.fault for one in result.results) else "corrupted"
    disturbed += " or defended" if any(one.defence for one in result.results) else ""
    driven = {
        what: sorted({one.seed for one in result.results if one.clean == clean})
        for what, clean in (("clean", True), (disturbed, False))
    }
    seeds = ", ".join(f"{_seeds(listed)} {what}" for what, listed in driven.items() if listed)
    parts = [f"# {result.plan.name}", f"Driven by `dsrc drive`: {len(result.results)} episodes, seeds {seeds}."]
    for section in sections(result, more):
        title = "" if section.picture else f"## {section.about}\n\n"
        parts.append(f"{title}{section.markdown(Path()).strip()}")
    return "\n\n".join(parts) + "\n"


def _seeds(listed: Sequence[int]) -> str:
    whole = list(listed) == list(range(listed[0], listed[-1] + 1))
    return f"{listed[0]} to {listed[-1]}" if whole and len(listed) > 2 else " ".join(map(str, listed))


def sections(result: CampaignResult, more: Findings = NOTHING) -> list[Section]:
    """Return the tables and plots of a campaign as sections of a document, in the order of the report."""
    every = tables(result, more)
    found = [Section(name, replace(one, title="").markdown(), about=one.title) for name, one in every.items()]
    plots = [Section(name, picture=f"{name}.png", about=_PICTURES[name]) for name in _plots(result, more)]
    first = sum(section.name in (*GATE_NAMES, "conditions", "apart") for section in found)
    return [*found[:first], *plots, *found[first:]]


def _plots(result: CampaignResult, more: Findings) -> "dict[str, Callable[[], Figure]]":
    """Return makers of the plots that a campaign has results for, by name: of one severity, but for theirs."""
    # Matplotlib takes as long to import as all else that a finished campaign's table needs.
    from dsrc.closed_loop.report.plots import (
        collision_and_score,
        cost_of_channel,
        deadly_corruptions,
        rate_over_severity,
        reliability_in_the_loop,
        shares_of_causes,
    )

    common, apart = parts_of(result)
    whole = common or apart
    plan, every = result.plan, [one for one in whole if not one.fault and not one.defence]
    severity = plan.severity[len(plan.severity) // 2]
    one_channel = [one for one in every if one.channel == plan.radios[0]]
    planned = {condition.kind for condition in plan.conditions}
    shown = [one for one in one_channel if one.corruption == CLEAN or one.severity == severity]
    faulty = [
        one
        for one in of_first_channel(plan, whole)
        if not one.defence and (one.fault or one.channel != plan.radios[0] or one.corruption not in planned)
    ]
    both = partial(collision_and_score, [*shown, *faulty], title=plan.name)
    plots: dict[str, Callable[[], Figure]] = {"collisions": both}
    if any(one.corruption != CLEAN for one in shown):
        plots["corruptions"] = partial(deadly_corruptions, shown)
    if len(plan.severity) > 1:
        plots["severities"] = partial(rate_over_severity, one_channel)
    clean = [one for one in every if one.corruption == CLEAN]
    quantities = {"delay, s": _delay_s, "lost packets": _loss}
    cost = {label: value for label, value in quantities.items() if len({value(one) for one in clean}) > 1}
    if cost:
        plots["channels"] = partial(cost_of_channel, clean, cost)
    if any(one.key in more.causes for one in whole):
        plots["shares"] = partial(shares_of_causes, whole, more.causes)
    if joined_calibrations(whole, more.calibrations):
        plots["reliability"] = partial(reliability_in_the_loop, whole, more.calibrations)
    return plots


def _delay_s(result: Result) -> float:
    return get_channel(result.channel).delay_s


def _loss(result: Result) -> float:
    return get_channel(result.channel).packet_loss
