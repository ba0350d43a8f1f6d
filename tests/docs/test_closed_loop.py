"""Closed loop: the tables of its pages are in the committed campaigns."""

import re
from pathlib import Path

import msgspec

from dsrc.closed_loop.campaign.jobs import episodes_of
from dsrc.closed_loop.campaign.run import CampaignResult
from dsrc.closed_loop.report.report import markdown, sections
from dsrc.faults.fault import faults_text
from studies.closed_loop.page import PAGE, SUMMARIES, committed


def campaigns() -> dict[str, CampaignResult]:
    """Committed campaigns with the results of theirs that are committed, by the name of their folder."""
    found = (committed(path) for path in sorted(PAGE.parent.glob("*.toml")))
    return {folder.name: result for folder, result in found}


def test_the_tables_of_the_closed_loop_are_those_of_its_campaigns() -> None:
    found = campaigns()
    page = PAGE.read_text(encoding="utf-8")
    blocks = {
        f"{folder}/{section.name}": section.markdown(Path("report") / folder)
        for folder, result in found.items()
        for section in sections(result)
    }
    block = re.compile(r"<!-- begin (\S+/\S+) -->\n(.*?)\n<!-- end \1 -->", re.DOTALL)
    places, *quoted = (block.findall(text) for text in (page, *(one.read_text("utf-8") for one in SUMMARIES)))
    published = {
        "which-corruption-kills",
        "taught-with-corruption",
        "range-around-the-ego",
        "nothing-is-hidden",
        "background-traffic",
        "pedestrians-and-bicycles",
        "attacks",
        "attacks-on-detectors",
        "what-cooperation-gives",
        "what-cooperation-gives-with-detectors",
        "what-cooperation-gives-by-boxes",
        "what-cooperation-gives-under-faults",
        "what-cooperation-gives-in-mined-encounters",
        "what-cooperation-gives-in-mined-encounters-with-detectors",
        "redundancy-mitigation",
    }
    assert {name.partition("/")[0] for name, _ in places} == published
    quoted = [[one for one in shown if one[0].partition("/")[0] in published] for shown in quoted]
    assert all(quoted) and all(shown == blocks[name] for name, shown in sum(quoted, places))
    for folder in published:
        result = found[folder]
        assert (PAGE.with_suffix("") / folder / "report.md").read_text(encoding="utf-8") == markdown(result)
        shipped = tuple(msgspec.structs.replace(one, checkpoint="") for one in result.plan.perceptions)
        jobs = episodes_of(msgspec.structs.replace(result.plan, perceptions=shipped))
        planned = {
            (job.scenario, job.seed, job.perception, job.condition.kind, faults_text(job.faults), ",".join(job.defence))
            for job in jobs
        }
        assert planned == {
            (one.scenario, one.seed, one.perception, one.corruption, one.fault, one.defence) for one in result.results
        }
