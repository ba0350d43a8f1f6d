"""Tables and figures of the DSRC paper, from a benchmark.

Usage:
    python -m studies.dsrc_paper studies/dsrc_paper/benchmark.toml --out runs/benchmark --docs PAGE.md

It runs the plan as `dsrc benchmark` does and adds the tables of the paper. `[pictures]` of
the plan names the teacher, the methods and the frames of Figures 6 and 8. Missing detector files are left out.
"""

import argparse
import sys
from pathlib import Path

from msgspec.structs import replace

from dsrc.evaluation.config import available, read_benchmark
from dsrc.evaluation.report.report import RESULTS, write_report
from dsrc.evaluation.runner import run_plan
from dsrc.runs.executors import Pool
from dsrc.tables.document import publish
from sim.errors import UserError
from sim.files import write_file
from studies.dsrc_paper.pictures import check_pictures
from studies.dsrc_paper.report import write_paper


def main() -> None:
    """Run the command of the module's first lines; a user's mistake is one line and exit code 2."""
    parser = argparse.ArgumentParser(prog="python -m studies.dsrc_paper", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("plan", type=Path, help="benchmark, a TOML")
    parser.add_argument("--out", type=Path, required=True, help="folder of the benchmark")
    parser.add_argument("--docs", type=Path, help="Markdown document that gets the tables, between their markers")
    options = parser.parse_args()
    try:
        plan = read_benchmark(options.plan)
        teacher = str(plan.pictures.get("teacher", ""))
        if teacher and (beside := options.plan.parent / teacher).exists():
            plan = replace(plan, pictures={**plan.pictures, "teacher": str(beside)})
        plan, absent = available(plan)
        check_pictures(plan)
        result = run_plan(plan, options.out, Pool())
        ours, papers = ({s.name: s for s in write(result, options.out)} for write in (write_report, write_paper))
        sections = list((ours | papers).values())
        write_file(options.out / "tables.md", "\n".join(section.markdown(Path()) for section in sections))
        if options.docs is not None:
            publish(sections, options.out, options.docs, plan.name, RESULTS)
        if absent:
            sys.stdout.write(f"Missing detector files, left out: {', '.join(absent)}.\n")
    except UserError as error:
        sys.stderr.write(f"dsrc_paper: {error}\n")
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
