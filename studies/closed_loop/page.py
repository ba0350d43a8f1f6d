"""Write the tables of report.md and of the pages that quote it anew from the committed results, without driving.

`dsrc drive PLAN.toml --docs studies/closed_loop/report.md` writes them after
driving; this is for changes of the tables.

Usage:
    python -m studies.closed_loop.page
"""

import argparse
import os
from pathlib import Path

import msgspec

from dsrc.closed_loop.campaign.plan import Campaign
from dsrc.closed_loop.campaign.run import CampaignResult, read_results
from dsrc.closed_loop.report.report import publish_report, sections, write_report
from dsrc.tables.document import replace_block, slug
from sim.catalog.load import scenarios_in
from sim.errors import SettingsError
from sim.settings import read_toml

PAGE = Path(__file__).with_name("report.md")
SUMMARIES = tuple(PAGE.parents[2] / f"docs/{name}.md" for name in ("closed_loop_results", "attacks"))


def committed(plan: Path) -> tuple[Path, CampaignResult]:
    """Return the folder of a plan's committed results, and the campaign with those that are there.

    Folders of scenarios stand for those in them. The plan's detectors are not opened: those that do not ship are taken
    from the history only to drive with them.
    """
    campaign = read_toml(plan, Campaign, SettingsError)
    beside = Path(os.path.relpath(plan.parent))  # results name scenarios from the root of the project
    folders = {name: scenarios_in(str(beside / name)) for name in campaign.scenarios if (beside / name).is_dir()}
    scenarios = tuple(one for name in campaign.scenarios for one in folders.get(name, [name]))
    campaign = msgspec.structs.replace(campaign, scenarios=scenarios)
    folder = PAGE.with_suffix("") / slug(campaign.name)
    files = [folder / f"{what}.csv" for what in ("results", "controls", "careful")]
    parts = [tuple(read_results([file], whole=False).values()) if file.is_file() else () for file in files]
    return folder, CampaignResult(campaign, *parts, made=0, seconds=0.0)


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    for plan in sorted(PAGE.parent.glob("*.toml")):
        folder, result = committed(plan)
        if result.results:
            write_report(result, folder)
            print(publish_report(result, folder, PAGE))
        for section in sections(result) if result.results else ():
            name = f"{folder.name}/{section.name}"
            for page in SUMMARIES:
                if f"<!-- begin {name} -->" in page.read_text(encoding="utf-8"):
                    replace_block(page, name, section.markdown(folder))


if __name__ == "__main__":
    main()
