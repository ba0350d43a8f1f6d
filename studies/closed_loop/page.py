"""Write the tables and plots of report.md anew from the committed results, without driving an episode.

`dsrc drive PLAN.toml --docs studies/closed_loop/report.md` writes them after
driving; this is for changes of the tables.

Usage:
    python -m studies.closed_loop.page
"""

import argparse
from pathlib import Path

from dsrc.closed_loop.campaign.plan import Campaign
from dsrc.closed_loop.campaign.run import CampaignResult, read_results
from dsrc.closed_loop.report.report import publish_report, write_report
from dsrc.tables.document import slug
from sim.errors import SettingsError
from sim.settings import read_toml

PAGE = Path(__file__).with_name("report.md")


def committed(plan: Path) -> tuple[Path, CampaignResult]:
    """Return the folder of a plan's committed results, and the campaign with those that are there.

    The plan's detectors are not opened: those that do not ship are taken from the history only to drive with them.
    """
    campaign = read_toml(plan, Campaign, SettingsError)
    folder = PAGE.with_suffix("") / slug(campaign.name)
    files = [folder / f"{what}.csv" for what in ("results", "controls", "careful")]
    parts = [tuple(read_results([file]).values()) if file.is_file() else () for file in files]
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


if __name__ == "__main__":
    main()
