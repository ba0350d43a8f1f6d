"""KITTI's object tree as OpenPCDet's own code reads its labels and calibrations, beside the drives that it is from.

Usage:
    python -m studies.readers.kitti data/test_kitti --source data/test --openpcdet ../OpenPCDet

after `dsrc dataset convert data/test --to kitti --out data/test_kitti --agent-id all --view around`. Two files of the
checkout are used, `object3d_kitti.py` and `calibration_kitti.py` in `pcdet/utils`, which need numpy alone.
Differences are the largest over all frames. The exit code is 0 where points are the same and boxes differ by at most
1 cm, else 1.
"""

import argparse
import csv
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np

import dsrc
from dsrc.data.datasets.convert import names_of
from dsrc.data.formats.levelling import levelled
from sim.geometry import invert
from studies.readers.opencood import parsed, raise_to, told


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("tree", type=Path, help="folder that `dsrc dataset convert --to kitti` wrote")
    parser.add_argument("--source", type=Path, required=True, help="folder of the drives that it is from")
    parser.add_argument("--openpcdet", type=Path, required=True, help="checkout of OpenPCDet")
    options = parsed(parser, __doc__)
    objects, calibrations = (loaded(options.openpcdet, name) for name in ("object3d_kitti", "calibration_kitti"))
    found = dsrc.open_drives(options.source)
    drives = dict(zip(names_of([drive.drive for drive in found]), found, strict=True))
    totals: dict[str, float] = {"points": 0, "boxes": 0}
    with (options.tree / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        drive = drives[row["drive"]]
        frame = drive.read(drive.frames.index(int(row["frame"])))
        agent = frame.agent(int(row["agent"]))
        sweep = levelled(agent.sweep) if agent.kind == "roadside" else agent.sweep
        number = row["number"]
        cloud = np.fromfile(options.tree / f"training/velodyne/{number}.bin", np.float32).reshape(-1, 4)
        if not np.array_equal(cloud[:, :3], sweep.points):
            totals["sweeps of other points"] = totals.get("sweeps of other points", 0) + 1
        totals["points"] += len(cloud)
        calibration = calibrations.Calibration(options.tree / f"training/calib/{number}.txt")
        truth = frame.truth.transform(invert(sweep.world_from_lidar))
        for label in objects.get_objects_from_label(options.tree / f"training/label_2/{number}.txt"):
            center = calibration.rect_to_lidar(label.loc[None])[0] + [0.0, 0.0, 0.5 * label.h]
            box = np.linalg.norm(truth.center - center, axis=1).argmin()
            raise_to(totals, "centres of boxes, m", center - truth.center[box])
            raise_to(totals, "sizes of boxes, m", np.array([label.l, label.w, label.h]) - truth.size[box])
            turn = np.exp(1j * (-label.ry - 0.5 * np.pi)) - np.exp(1j * truth.yaw[box])
            raise_to(totals, "headings of boxes, times 1 m", np.abs(turn))
            totals["boxes"] += 1
    told(totals)


def loaded(checkout: Path, name: str) -> ModuleType:
    """Return a module of pcdet.utils without its package, which needs CUDA."""
    path = checkout / "pcdet" / "utils" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None or not path.is_file():
        sys.exit(f"{path}: file not found")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


if __name__ == "__main__":
    main()
