"""MCAP files as the package mcap reads them, beside the drives that they are from.

Usage:
    python -m studies.readers.mcap data/test_mcap --source data/test

after `dsrc dataset convert data/test --to mcap --out data/test_mcap`. Differences are the largest over all frames.
The exit code is 0 where points are the same and boxes differ by at most 1 cm, else 1.
"""

import argparse
import base64
import json
import sys
from pathlib import Path

import numpy as np

import dsrc
from dsrc.data.datasets.convert import names_of
from studies.readers.opencood import parsed, raise_to, told

KINDS = {3: "<u2", 6: "<i4", 7: "<f4"}
"""Numbers of Foxglove's `NumericType`."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path, help="folder that `dsrc dataset convert --to mcap` wrote")
    parser.add_argument("--source", type=Path, required=True, help="folder of the drives that it is from")
    options = parsed(parser, __doc__)
    try:
        from mcap.reader import make_reader
    except ImportError:
        sys.exit("the package mcap is missing: pip install mcap")
    totals: dict[str, float] = {"points": 0, "boxes": 0}
    drives = dsrc.open_drives(options.source)
    for name, drive in zip(names_of([drive.drive for drive in drives]), drives, strict=True):
        frames = {round(frame.time_s * 1e9): frame for frame in (drive.read(row) for row in range(len(drive)))}
        with (options.folder / f"{name}.mcap").open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages():
                compare(channel.topic, json.loads(message.data), frames[message.log_time], totals)
    told(totals)


def compare(topic: str, message: dict, frame: dsrc.Frame, totals: dict[str, float]) -> None:
    """Add the differences of one message to the totals."""
    if topic == "/truth":
        place = {str(k): row for row, k in enumerate(frame.truth.object_id)}
        for entity in message["entities"]:
            row, cube = place[entity["id"]], entity["cubes"][0]
            raise_to(totals, "centres of boxes, m", vector(cube["pose"]["position"]) - frame.truth.center[row])
            raise_to(totals, "sizes of boxes, m", vector(cube["size"]) - frame.truth.size[row])
            totals["boxes"] += 1
    elif topic.startswith("/agents/"):
        sweep = frame.agent(int(topic.split("/")[2])).sweep
        fields = message["fields"]
        layout = {
            "names": [field["name"] for field in fields],
            "formats": [KINDS[field["type"]] for field in fields],
            "offsets": [field["offset"] for field in fields],
            "itemsize": message["point_stride"],
        }
        cloud = np.frombuffer(base64.b64decode(message["data"]), np.dtype(layout))
        if not np.array_equal(np.stack([cloud[axis] for axis in "xyz"], axis=1), sweep.points):
            totals["sweeps of other points"] = totals.get("sweeps of other points", 0) + 1
        totals["points"] += len(cloud)


def vector(message: dict[str, float]) -> np.ndarray:
    """Return x, y, z of a message."""
    return np.array([message[axis] for axis in "xyz"])


if __name__ == "__main__":
    main()
