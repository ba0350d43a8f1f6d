"""Readers of sweeps of other data sets, one target for each file that a drive is read from."""

import importlib.util
from collections.abc import Callable
from pathlib import Path

from dsrc.data.datasets.convert import convert
from dsrc.data.drives import open_drives
from tests.dsrc.data.sweeps import trees
from tests.fuzz.target import Target

_LARGEST = 100_000


def sweep_targets(folder: Path) -> list[Target]:
    """Write a small tree of every layout whose packages are there; return its readers."""
    made: list[tuple[str, Callable[[Path], Path], str]] = [
        ("KITTI object", trees.kitti_object, "numpy"),
        ("KITTI tracking", trees.kitti_tracking, "numpy"),
        ("SemanticKITTI", trees.semantic_kitti, "numpy"),
        ("nuScenes", trees.nuscenes, "numpy"),
        ("OpenLABEL", trees.openlabel, "numpy"),
        ("folder of scans", trees.scans, "numpy"),
        ("Argoverse 2", trees.argoverse, "pyarrow"),
        ("bag", trees.rosbag, "rosbags"),
    ]
    found = []
    for name, make, package in made:
        if importlib.util.find_spec(package) is not None:
            found += _of_tree(name, make(folder / "sweeps" / name.replace(" ", "_")))
    settings = folder / "sweeps" / "folder_of_scans" / "scans" / "scans.toml"
    settings.write_text('columns = "x,y,z,intensity"\nintensity_scale = 1.0\nsensor = "vlp-16"\nheight = 1.5\n')
    found.append(Target("folder of scans: scans.toml", settings, _reader(settings.parent), "text"))
    if importlib.util.find_spec("mcap") is not None:
        convert(data=trees.scans(folder / "sweeps" / "source"), out=folder / "sweeps" / "foxglove", to="mcap")
        found += _of_tree("Foxglove", folder / "sweeps" / "foxglove")
    return found


def _of_tree(name: str, tree: Path) -> list[Target]:
    """Return a target for one file of each kind in a tree."""
    kinds = {
        (path.parent, path.suffix if path.stem.isdecimal() else path.name): path
        for path in sorted(tree.rglob("*"), reverse=True)
        if path.is_file() and path.stat().st_size < _LARGEST and path.name != "conversion.json"
    }
    texts = (".txt", ".json", ".yaml")
    return [
        Target(f"{name}: {path.relative_to(tree)}", path, _reader(tree), "text" if path.suffix in texts else "bytes")
        for path in kinds.values()
    ]


def _reader(tree: Path) -> Callable[[Path], object]:
    return lambda _: [drive.read(i) for drive in open_drives(tree) for i in range(min(len(drive), 2))]
