"""Drives as OpenCOOD's own loader, or a fork's such as DSRC's, reads them, beside what is read here.

Usage:
    python -m studies.readers.opencood data/test --opencood ../OpenCOOD
    python -m studies.readers.opencood data/test --opencood ../DSRC --frames 20

Run it by a Python that has the requirements of both. Differences are the largest over all frames and agents. The exit
code is 0 where agents and points are the same and poses and boxes differ by at most 1 cm, else 1.
"""

import argparse
import importlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import cm, colormaps
from numpy.typing import NDArray

import dsrc

MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
"""From CARLA's left-handed world and sensor frames to ours, and back."""
MOST_M = 0.01


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("data", type=Path, help="folder of drives that `dsrc generate` wrote")
    parser.add_argument("--opencood", type=Path, required=True, help="checkout with a package opencood")
    parser.add_argument("--frames", type=int, default=10, help="frames of each drive, evenly spread; default: 10")
    options = parsed(parser, __doc__)
    checkout(options.opencood)
    base = importlib.import_module("opencood.data_utils.datasets.basedataset").BaseDataset
    settings = {"data_augment": [], "root_dir": str(options.data), "validate_dir": str(options.data)}
    theirs = base(settings, visualize=False, train=False)
    drives = dsrc.open_drives(options.data)
    if len(theirs) != sum(map(len, drives)):
        sys.exit(f"frames: {len(theirs)} theirs, {sum(map(len, drives))} ours")
    totals: dict[str, float] = {"points": 0, "boxes": 0}
    first = 0
    for drive in sorted(drives, key=lambda drive: drive.drive.name):
        rows = np.unique(np.linspace(0, len(drive) - 1, min(options.frames, len(drive))).round().astype(int))
        for row in rows.tolist():
            compare(drive.read(row), theirs.retrieve_base_data(first + row), totals)
        first += len(drive)
    told(totals)


def checkout(folder: Path) -> None:
    """Make the packages of a checkout importable, with two names that today's matplotlib and numpy no longer have."""
    sys.path.insert(0, str(folder.resolve()))
    for module, name, value in ((cm, "get_cmap", colormaps.get_cmap), (np, "Inf", np.inf)):
        if not hasattr(module, name):
            setattr(module, name, value)


def parsed(parser: argparse.ArgumentParser, text: str | None) -> argparse.Namespace:
    """Return the options of a command line; a script's text is its help."""
    parser.description, _, parser.epilog = (text or "").partition("\n\n")
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    return parser.parse_args()


def told(totals: Mapping[str, float]) -> None:
    """Print the totals and exit, with 1 where points or agents differ, or anything by more than 1 cm."""
    for name, value in totals.items():
        print(f"{name:45s} {value:g}")
    worst = max(value for name, value in totals.items() if name.endswith("m"))
    others = totals.get("frames of other agents", 0) + totals.get("sweeps of other points", 0)
    sys.exit(int(others > 0 or worst > MOST_M))


def compare(ours: dsrc.Frame, theirs: Mapping[str, Mapping[str, Any]], totals: dict[str, float]) -> None:
    """Add the differences of one frame to the totals."""
    ids = [agent.agent_id for agent in ours.agents]
    if sorted(ids) != sorted(map(int, theirs)) or not theirs[str(ids[0])]["ego"]:
        totals["frames of other agents"] = totals.get("frames of other agents", 0) + 1
        return
    ego_from_world = np.linalg.inv(ours.agents[0].sweep.world_from_lidar)
    place = {int(k): row for row, k in enumerate(ours.truth.object_id)}
    for agent in ours.agents:
        found = theirs[str(agent.agent_id)]
        points = np.asarray(found["lidar_np"])[:, :3] * np.float32([1.0, -1.0, 1.0])
        if not np.array_equal(points, agent.sweep.points):
            totals["sweeps of other points"] = totals.get("sweeps of other points", 0) + 1
        totals["points"] += len(points)
        matrix = MIRROR @ np.asarray(found["params"]["transformation_matrix"]) @ MIRROR
        raise_to(totals, "transforms to the ego, m", matrix - ego_from_world @ agent.sweep.world_from_lidar)
        for key, vehicle in found["params"]["vehicles"].items():
            row = place[int(key)]
            centre = MIRROR[:3, :3] @ np.add(vehicle["location"], vehicle["center"])
            raise_to(totals, "centres of boxes, m", centre - ours.truth.center[row])
            raise_to(totals, "sizes of boxes, m", 2.0 * np.array(vehicle["extent"]) - ours.truth.size[row])
            totals["boxes"] += 1


def raise_to(totals: dict[str, float], name: str, difference: NDArray[np.float64]) -> None:
    """Keep the largest difference of a name."""
    totals[name] = max(totals.get(name, 0.0), float(np.abs(difference).max()))


if __name__ == "__main__":
    main()
