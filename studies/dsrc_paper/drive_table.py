"""Table of the drives of a split: frames, agents and ground truth as an evaluation counts them.

Usage:
    python -m studies.dsrc_paper.drive_table data/dsrc-sim/test --docs docs/datasets.md --name dsrc-sim

It writes the table between `<!-- begin NAME/drives -->` and `<!-- end NAME/drives -->`; without `--docs` it is printed.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dsrc.data.drives import Drive, open_drives
from dsrc.data.sample import make_sample
from dsrc.ops.grid import GridSpec
from dsrc.tables.document import replace_block
from dsrc.tables.table import Column, Table, TableRow
from sim.errors import UserError

GRID = GridSpec(range_m=(-51.2, -25.6, -3.0, 51.2, 25.6, 2.6))
"""Range of the recipe `small`, in which boxes are counted."""


@dataclass(frozen=True, slots=True)
class DriveRow:
    """Row of the table: one drive.

    Attributes:
        drive: its name.
        frames: number of frames.
        vehicles: number of vehicles with a LiDAR, the ego included.
        roadside: number of roadside units.
        boxes: ground truth of an evaluation, summed over the frames: vehicles in range that any agent in communication
            range has a point on.
        unseen: boxes without a point from the ego.
        path_m: length of the ego's path, m.
    """

    drive: str
    frames: int
    vehicles: int
    roadside: int
    boxes: int
    unseen: int
    path_m: float


def count(drive: Drive, grid: GridSpec) -> DriveRow:
    """Return the counts of a drive; the ego and the boxes are those of `make_sample`.

    Args:
        drive: at least one frame.
        grid: the range, in the ego LiDAR's frame.
    """
    boxes, unseen, places = 0, 0, []
    for i in range(len(drive)):
        frame = drive.read(i)
        sample = make_sample(frame, None, grid)
        boxes += len(sample.boxes)
        unseen += len(sample.boxes) - len(sample.agent_boxes[0])
        places.append(frame.agent(sample.agent_ids[0]).sweep.world_from_lidar[:2, 3])
    kinds = [agent.kind for agent in frame.agents]
    return DriveRow(
        drive=drive.drive.name,
        frames=len(drive),
        vehicles=kinds.count("vehicle"),
        roadside=kinds.count("roadside"),
        boxes=boxes,
        unseen=unseen,
        path_m=float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum()),
    )


def table(rows: Sequence[DriveRow]) -> str:
    """Return the rows as a Markdown table with a row of sums."""
    columns = [Column(head) for head in ("frames", "agents", "boxes", "boxes per frame")]
    columns += [Column("without a point from the ego"), Column("path of the ego", unit="m")]
    lines = []
    for row in rows:
        agents = f"{row.vehicles} + {row.roadside} roadside" if row.roadside else f"{row.vehicles}"
        lines.append(TableRow(f"`{row.drive}`", (row.frames, agents, *_boxes([row]), row.path_m)))
    frames = f"{sum(row.frames for row in rows):,}"
    lines.append(TableRow(f"{len(rows)} drives", (frames, "", *_boxes(rows), "")))
    return Table("drives", "", "drive", tuple(columns), tuple(lines)).markdown().rstrip()


def _boxes(rows: Sequence[DriveRow]) -> tuple[str, str, str]:
    frames, boxes, unseen = (sum(getattr(row, name) for row in rows) for name in ("frames", "boxes", "unseen"))
    return f"{boxes:,}", f"{boxes / frames:.1f}", f"{unseen:,} ({unseen / max(boxes, 1):.0%})"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command of the module's first lines; a user's mistake is one line and exit code 2."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.dsrc_paper.drive_table", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("folder", type=Path, help="drives, in any supported format")
    parser.add_argument("--docs", type=Path, help="document to write the table into; default: print it")
    parser.add_argument("--name", default="dsrc-sim", help="name of the dataset in the markers")
    options = parser.parse_args(arguments)
    try:
        text = table([count(drive, GRID) for drive in open_drives(options.folder)])
        if options.docs is None:
            sys.stdout.write(f"{text}\n")
        else:
            replace_block(options.docs, f"{options.name}/drives", text)
    except UserError as error:
        sys.stderr.write(f"drive_table: {error}\n")
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
