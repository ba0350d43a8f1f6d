"""Optimisers of `dsrc search` at equal budget on one encounter: tables and plot of docs/search.md.

Usage:
    python -m studies.closed_loop.search --out runs/search
"""

import argparse
from pathlib import Path

from dsrc.cli.progress import progress
from dsrc.closed_loop.falsification.report import best_figure, failure_table, optimizer_table, write_search
from dsrc.closed_loop.falsification.run import search_failures
from dsrc.options.search import SearchOptions
from dsrc.tables.document import replace_block
from dsrc.tables.figure import write_figure

OPTIONS = SearchOptions(
    scenario=("lta_truck",),
    fault=(
        "brake_gain:0.1..1 from 0..6 s for 0.5..6 s",
        "control_delay:0..1.5 from 0..6 s for 0.5..6 s",
        "speed_reading:0.3..1 from 0..6 s for 0.5..6 s + missed_cycles:0..1 from 0..6 s for 0.5..6 s",
    ),
    optimizer=("tpe", "random", "grid"),
    budget=60,
    failures=3,
)


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("runs/search"))
    parser.add_argument("--docs", type=Path, default=Path("docs/search.md"))
    args = parser.parse_args()
    with progress("search") as report:
        found = search_failures(OPTIONS, args.out, progress=report)
    write_search(found, args.out)
    write_figure(args.docs.parent / "pictures" / "search.png", best_figure(found))
    for name, table in (("optimizers", optimizer_table(found)), ("failures", failure_table(found))):
        replace_block(args.docs, f"search/{name}", table.markdown())


if __name__ == "__main__":
    main()
