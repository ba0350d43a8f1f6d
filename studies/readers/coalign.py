"""A DAIR-V2X-C tree as CoAlign's own loader reads it, beside what is read here.

Usage:
    python -m studies.readers.coalign data/test_dair/cooperative-vehicle-infrastructure --coalign ../CoAlign

after `dsrc dataset convert data/test --to dair --out data/test_dair`. Run it by a Python that has the requirements of
both. Differences are the largest over all frames. The exit code is 0 where points are the same and poses and corners
of boxes differ by at most 1 cm, else 1.
"""

import argparse
import importlib
import sys
from pathlib import Path

import numpy as np

import dsrc
from studies.readers.opencood import checkout, parsed, raise_to, told


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("tree", type=Path, help="folder cooperative-vehicle-infrastructure")
    parser.add_argument("--coalign", type=Path, required=True, help="checkout with a package opencood")
    parser.add_argument("--split", default="test", help="split of the tree; default: test")
    options = parsed(parser, __doc__)
    checkout(options.coalign)
    loader = importlib.import_module("opencood.data_utils.datasets.basedataset.dairv2x_basedataset")
    split = str(options.tree / f"{options.split}.json")
    settings = {
        **{"data_dir": str(options.tree), "root_dir": split, "validate_dir": split, "data_augment": []},
        **{"input_source": ["lidar"], "label_type": "lidar", "fusion": {"args": {}}},
        "preprocess": {"core_method": "BasePreprocessor", "args": {}, "cav_lidar_range": [-100, -40, -3, 100, 40, 1]},
        "postprocess": {"core_method": "VoxelPostprocessor", "anchor_args": {"num": 2}},
    }
    theirs = loader.DAIRV2XBaseDataset(settings, visualize=False, train=False)
    world_from = importlib.import_module("opencood.utils.transformation_utils").x_to_world
    places = {
        index: (drive, row)
        for drive in dsrc.open_drives(options.tree / options.split)
        for row, index in enumerate(drive.frames)
    }
    if len(theirs) != len(places):
        sys.exit(f"frames: {len(theirs)} theirs, {len(places)} ours")
    totals: dict[str, float] = {"points": 0, "boxes": 0}
    for number, name in enumerate(theirs.split_info):
        drive, row = places[int(name)]
        ours, found = drive.read(row), theirs.retrieve_base_data(number)
        for side, agent in enumerate(ours.agents):
            points = np.asarray(found[side]["lidar_np"])[:, :3]
            if not np.array_equal(points[np.isfinite(points).all(axis=1)], agent.sweep.points):
                totals["sweeps of other points"] = totals.get("sweeps of other points", 0) + 1
            totals["points"] += len(points)
            pose = world_from(found[side]["params"]["lidar_pose"])
            raise_to(totals, "poses in the world, m", pose - agent.sweep.world_from_lidar)
        for label in found[0]["params"]["vehicles_all"]:
            corners = np.array(label["world_8_points"])
            box = np.linalg.norm(ours.truth.center - corners.mean(axis=0), axis=1).argmin()
            apart = np.linalg.norm(corners[:, None] - ours.truth.corners()[box], axis=2)
            raise_to(totals, "corners of boxes, m", apart.min(axis=1))
            totals["boxes"] += 1
    told(totals)


if __name__ == "__main__":
    main()
