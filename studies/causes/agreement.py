"""Agreement of computed causes of errors with hand labels.

`labels.csv` has the labels of errors of `small-dsrc.pt`, drawn by two seeds and evenly over four conditions: a frame by
its position in the drive, a missed object by its id, a false box by its place in the order of the scores, the label and
its evidence. Those of draw 45 were given from pictures, points, boxes and scores before any cause was looked at, and
then showed what to mend; those of draw 46 were given after that, with the rules known.

The results are those of `dsrc evaluate data/dsrc-sim/test --checkpoint dsrc/checkpoints/small-dsrc.pt --corruption snow
fog --frames 16 --no-ego-alone --fault "loss:0.3 + delay:0.2" --out runs/causes`.

Usage:
    python -m studies.causes.agreement runs/causes
"""

import argparse
import csv
from collections import Counter
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

from dsrc.data.drives import open_drive
from dsrc.evaluation.causes.cause import Circumstances, ErrorCause, frame_causes
from dsrc.evaluation.causes.results import FILE
from dsrc.evaluation.stored import read_index, read_run
from dsrc.evaluation.stress import IOU, SURE
from sensors.corruptions import CORRUPTIONS, drive_seed

LABELS = Path(__file__).with_name("labels.csv")
FRAME = ("condition", "drive", "position")


def rows_of(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV, lines of comment left out."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))


@lru_cache
def causes_with_sweeps(folder: Path, condition: str, drive: str, position: str) -> list[ErrorCause]:
    """Causes in a frame under a corruption as the review page has them, which makes the corrupted sweeps again."""
    index = read_index(folder)
    run = next(one for one in index.runs if one.condition.label == condition)
    row = next(row for row, one in enumerate(index.drives) if one.name == drive)
    table = next(one for one in read_run(folder, run.cells[row]).frames() if one.position[0] == int(position))
    frame = open_drive(Path(index.drives[row].path)).read(int(position))
    corrupted = run.condition.apply(frame, drive_seed(index.seed, drive))
    return frame_causes(table, frame, SURE, IOU, Circumstances(condition, corrupted, range_m=run.range_m))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print each disagreement, then how many agree: with the sweeps at hand, and in `causes.csv`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, help="folder of dsrc evaluate")
    folder = parser.parse_args(arguments).results
    named = {"missed": "object_id", "false": "rank"}
    written = {
        (*(row[name] for name in (*FRAME, "error")), row[named[row["error"]]]): row for row in rows_of(folder / FILE)
    }
    right, labels = Counter[tuple[str, str]](), rows_of(LABELS)
    for row in labels:
        frame, error, which = [row[name] for name in FRAME], row["error"], row["which"]
        line = written[(*frame, error, which)]
        kind, sentence = line["kind"], line["sentence"]
        if frame[0].split()[0] in CORRUPTIONS:
            known = causes_with_sweeps(folder, *frame)
            cause = next(one for one in known if one.error == error and str(getattr(one, named[error])) == which)
            kind, sentence = cause.kind, cause.sentence
        right[row["draw"], "with the sweeps"] += kind == row["label"]
        right[row["draw"], FILE] += line["kind"] == row["label"]
        if kind != row["label"]:
            print(f"{', '.join(frame)}, {error} {which}: {row['label']} by hand, {row['evidence']}; {kind}, {sentence}")
    for (draw, source), count in right.items():
        drawn = sum(row["draw"] == draw for row in labels)
        print(f"draw {draw}, {source}: {count} of {drawn} agree, {count / drawn:.0%}")


if __name__ == "__main__":
    main()
