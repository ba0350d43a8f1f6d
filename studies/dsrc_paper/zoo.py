"""Table of the detectors of a campaign: how each was trained, what it reaches on validation, its size and hash.

Usage:
    python -m studies.dsrc_paper.zoo runs --docs docs/zoo.md
    python -m studies.dsrc_paper.zoo runs

Everything is read from the run folders. `dsrc model verify FOLDER` measures a detector anew and compares.
"""

import argparse
import csv
import io
import json
from pathlib import Path

from sim.errors import UserError
from sim.files import file_sha256
from studies.dsrc_paper.campaign import record
from studies.dsrc_paper.trainings import SEEDS, Training, campaign
from studies.look import put_table

HEAD = (
    "detector",
    "method",
    "stage",
    "starts from",
    "teacher",
    "steps",
    "precision",
    "minutes",
    "AP@0.5 / 0.7, %",
    "MB",
    "SHA-256",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, help="folder of the run folders")
    parser.add_argument("--docs", type=Path, help="Markdown document that gets the table, between its markers")
    options = parser.parse_args()
    if not (found := rows(options.runs)):
        parser.error(f"runs: expected finished trainings in {options.runs}, found none")
    try:
        put_table(options.docs, "zoo", HEAD, found)
    except UserError as error:
        parser.error(str(error))


def rows(runs: Path) -> list[tuple[str, ...]]:
    """Return a row per finished training of the campaign, with whole or halved distillation."""
    known = {training.name: training for weights in (1.0, 0.5) for training in campaign(SEEDS, weights)}
    lines = csv.DictReader(io.StringIO(record(list(known.values()), runs)))
    return [row(line, known[line["name"]], runs) for line in lines]


def row(line: dict[str, str], training: Training, runs: Path) -> tuple[str, ...]:
    """Return the row of a training, whose line is that of `trainings.csv`."""
    detector = training.detector(runs)
    # Of the file itself, in half precision; the last line of metrics.csv is of the weights before they were rounded.
    metrics = json.loads((training.folder(runs) / "result.json").read_text(encoding="utf-8"))["metrics"]
    ap = " / ".join(f"{100.0 * metrics[f'val/ap_bev_{iou}']:.1f}" for iou in (50, 70))
    made = json.loads((training.folder(runs) / "settings.json").read_text(encoding="utf-8"))
    precision = "bfloat16" if made["settings"]["recipe"]["bfloat16"] else "float32"
    return (
        *(line["name"], line["method"], line["stage"], line["init"] or "-", line["teacher"] or "-", line["steps"]),
        *(precision, f"{float(line['minutes']):.0f}", ap, f"{detector.stat().st_size / 1e6:.1f}"),
        f"`{file_sha256(detector)[:12]}`",
    )


if __name__ == "__main__":
    main()
