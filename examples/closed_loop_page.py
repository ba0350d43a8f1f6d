"""Write the tables and plots of docs/closed_loop.md anew from the committed results, without driving an episode.

A campaign that is driven writes them itself (`dsrc drive PLAN.toml --docs docs/closed_loop.md`). This is for changes of
the tables: episodes would be driven again after any change to the code.

Usage:
    python examples/closed_loop_page.py
"""

import argparse
from pathlib import Path

from dsrc.closed_loop.campaign.plan import read_campaign
from dsrc.closed_loop.campaign.run import CampaignResult, read_results
from dsrc.closed_loop.report.report import publish_report, write_report
from dsrc.tables.document import slug

PAGE = Path(__file__).parents[1] / "docs/closed_loop.md"


def committed(plan: Path) -> tuple[Path, CampaignResult]:
    """Return the folder of a plan's committed results, and the campaign with those that are there."""
    campaign = read_campaign(plan)
    folder = plan.parent / slug(campaign.name)
    files = [folder / f"{what}.csv" for what in ("results", "controls", "careful")]
    parts = [tuple(read_results([file]).values()) if file.is_file() else () for file in files]
    return folder, CampaignResult(campaign, *parts, made=0, seconds=0.0)


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    for plan in sorted(PAGE.with_suffix("").glob("*.toml")):
        folder, result = committed(plan)
        if result.results:
            write_report(result, folder)
            print(publish_report(result, folder, PAGE))


if __name__ == "__main__":
    main()
