"""Agreement of computed causes of errors with hand labels.

`labels.csv` has the labels of errors of `small-dsrc.pt`, drawn by two seeds and evenly over four conditions: a frame by
its position in the drive, a missed object by its id, a false box by its place in the order of the scores, the label and
its evidence. Those of draw 45 were given from pictures, points, boxes and scores before any cause was looked at, and
then showed what to mend; those of draw 46 were given after that, with the rules known. `amid made points` came later:
the nine misses in snow whose evidence names flakes were `no box` until then.

The results are those of `dsrc evaluate data/dsrc-sim/test --checkpoint dsrc/checkpoints/small-dsrc.pt --corruption snow
fog --frames 16 --no-ego-alone --fault "loss:0.3 + delay:0.2" --out runs/causes`.

Usage:
    python -m studies.causes.agreement runs/causes
"""

import argparse
import csv
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from dsrc.evaluation.causes.results import FILE

LABELS = Path(__file__).with_name("labels.csv")
FRAME = ("condition", "drive", "position")


def rows_of(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV, lines of comment left out."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print each disagreement, then how many agree."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, help="folder of dsrc evaluate")
    folder = parser.parse_args(arguments).results
    named = {"missed": "object_id", "false": "rank"}
    written = {
        (*(row[name] for name in (*FRAME, "error")), row[named[row["error"]]]): row for row in rows_of(folder / FILE)
    }
    right, gone, labels = Counter[str](), Counter[str](), rows_of(LABELS)
    for row in labels:
        place = (*(row[name] for name in (*FRAME, "error")), row["which"])
        cause = written.get(place)
        gone[row["draw"]] += cause is None
        if cause is not None and cause["kind"] == row["label"]:
            right[row["draw"]] += 1
        else:
            found = "no error in these results" if cause is None else f"{cause['kind']}, {cause['sentence']}"
            print(f"{', '.join(place)}: {row['label']} by hand, {row['evidence']}; {found}")
    for draw, count in Counter(row["draw"] for row in labels).items():
        there = count - gone[draw]
        print(
            f"draw {draw}: {right[draw]} of {there} agree, {right[draw] / there:.0%}; {gone[draw]} are no errors here"
        )


if __name__ == "__main__":
    main()
