"""Files of single scans, read as a table of all their columns and written back in the same format.

| file               | columns                                          | data sets                          |
|--------------------|--------------------------------------------------|------------------------------------|
| `.bin`             | x y z intensity, float32                         | KITTI, SemanticKITTI               |
| `.pcd.bin`         | x y z intensity ring, float32                    | nuScenes: HDL-32E, intensity to 255|
| `.npy`             | x y z, intensity if there are four, anything     | (P, C) floats                      |
| `.pcd`, `.ply`     | fields x y z and, by their names, intensity, ring | any; vertices alone                |

Points are x forward, y left, z up in the sensor's frame. Fields of PCD and PLY that hold no finite point, as those of
beams without a return, are left out. Beside the folder of `velodyne/N.bin` may be labels: `labels/N.label` of
SemanticKITTI, `label_2/N.txt` of KITTI.
"""

import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dsrc.data.clouds.cloud import EIGHT_BIT, Cloud
from dsrc.data.clouds.corrupt import array_of, cloud_of
from dsrc.data.clouds.ply import decode_ply, encode_ply
from dsrc.data.formats import kitti_labels
from dsrc.data.formats.pcd import encode_table, read_table
from sensors.corruptions.published.incomplete_echo import SEMANTIC_KITTI
from sim.errors import DataError, complaint
from sim.reading import parsing, read_bytes

NUSCENES = ".pcd.bin"
"""End of the names of nuScenes' scans, which alone tells their five columns from KITTI's four."""
ENDINGS = (NUSCENES, ".bin", ".npy", ".pcd", ".ply")
"""Ends of the names of scans, the longest of those that fit first."""
NUSCENES_SENSOR = "hdl-32e"
"""Preset of the LiDAR of nuScenes."""

_INTENSITY = ("intensity", "reflectivity", "reflectance", "remission", "scalar_intensity", "i")
_RING = ("ring", "laser_id", "channel", "scalar_ring")
_LABEL_BITS = 0xFFFF


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """Scan of a file.

    Attributes:
        cloud: its points.
        encode: returns the file of a table of the same columns.
        sensor: name of the preset that the format implies, None without one.
    """

    cloud: Cloud
    encode: Callable[[NDArray[np.void]], bytes]
    sensor: str | None = None


def ending_of(path: Path) -> str | None:
    """Return the one of `ENDINGS` that a file has, None where it is no scan."""
    name = path.name.lower()
    return next((ending for ending in ENDINGS if name.endswith(ending) and not name.startswith(".")), None)


def is_scan(path: Path) -> bool:
    """Return whether a path names a scan, which need not exist, and is no folder."""
    return ending_of(path) is not None and not path.is_dir()


def scans_below(folder: Path) -> list[Path]:
    """Return the scans at any depth below a folder, sorted; DataError without any."""
    found = sorted(path for path in folder.rglob("*") if is_scan(path))
    if not found:
        raise DataError(complaint(folder, "folder", f"drives, or scans *{', *'.join(ENDINGS)}", "neither"))
    return found


def read_scan(path: Path) -> Scan:
    """Read the scan of a file.

    Raises:
        DataError: the file is missing, damaged or of another kind, or lacks coordinates.
    """
    ending = ending_of(path)
    if ending is None:
        raise DataError(complaint(path, "scan", f"a file *{', *'.join(ENDINGS)}", path.suffix or "no ending"))
    if ending == ".pcd":
        return _scan_of_fields(path, read_table(path), encode_table)
    content = read_bytes(path, f"{ending} scan")
    with parsing(path, f"{ending} scan"):
        if ending == ".ply":
            table, header = decode_ply(path, content)
            return _scan_of_fields(path, table, partial(encode_ply, header=header))
        if ending == ".npy":
            rows = np.load(io.BytesIO(content), allow_pickle=False)
        else:
            width = 5 if ending == NUSCENES else 4
            if len(content) % (4 * width):
                hint = f"; points of 20 bytes, as nuScenes has them, are read from *{NUSCENES}" if width == 4 else ""
                expected = f"whole points of {4 * width} bytes"
                raise DataError(complaint(path, "size", expected, f"{len(content)} bytes", hint))
            rows = np.frombuffer(content, "<f4").reshape(-1, width)
        try:
            cloud = cloud_of(rows, 4 if ending == NUSCENES else None)
        except DataError as error:
            raise DataError(f"{path}: {error}") from None
    if ending == ".npy":
        return Scan(cloud, lambda table: _npy(array_of(table, rows.dtype)))
    if ending == ".bin":
        return Scan(cloud, lambda table: table.tobytes())
    full = Cloud(cloud.table, cloud.axes, cloud.intensity, cloud.ring, EIGHT_BIT)
    return Scan(full, lambda table: table.tobytes(), NUSCENES_SENSOR)


def labels_of(path: Path) -> Path:
    """Return where SemanticKITTI keeps the labels of a scan."""
    return path.parent.parent / "labels" / f"{path.stem}.label"


def read_labels(path: Path, points: int) -> NDArray[np.uint32]:
    """Read (P,) SemanticKITTI labels, classes in the lower 16 bits.

    Raises:
        DataError: the file is missing, or has another number of labels than points.
    """
    content = read_bytes(path, "labels of points")
    if len(content) != 4 * points:
        raise DataError(complaint(path, "labels", f"{4 * points} bytes for {points} points", f"{len(content)} bytes"))
    return np.frombuffer(content, "<u4")


def vehicles_among(labels: NDArray[np.uint32]) -> NDArray[np.bool_]:
    """Return the (P,) mask of SemanticKITTI labels of vehicles."""
    return np.isin(labels & _LABEL_BITS, [one for names in SEMANTIC_KITTI for one in names])


def kitti_boxes(path: Path) -> NDArray[np.float64] | None:
    """Return (M, 7) boxes of the vehicles of a scan, sensor frame, m and rad, from KITTI's `label_2` beside its folder.

    None without such a file.

    Raises:
        DataError: the labels or their calibration are damaged.
    """
    labels = path.parent.parent / "label_2" / f"{path.stem}.txt"
    if not labels.is_file() or not path.stem.isdigit():
        return None
    return kitti_labels.read_labels(labels, kitti_labels.calibration_of(labels.parent, int(path.stem)))[0].array


def _scan_of_fields(path: Path, table: NDArray[np.void], encode: Callable[[NDArray[np.void]], bytes]) -> Scan:
    """Return the scan of a table by the names of its fields, without points that are not finite."""
    names = {name.lower(): name for name in table.dtype.names or ()}
    for axis in "xyz":
        if axis not in names:
            raise DataError(complaint(path, "fields", f"a field {axis}", " ".join(names)))
    wide = [name for name in names.values() if table.dtype[name].shape]
    if wide:
        raise DataError(complaint(path, f"COUNT of {wide[0]}", "1", table.dtype[wide[0]].shape[0]))
    axes = names["x"], names["y"], names["z"]
    table = table[np.all([np.isfinite(table[name]) for name in axes], axis=0)]
    intensity, ring = (next((names[n] for n in known if n in names), None) for known in (_INTENSITY, _RING))
    return Scan(Cloud(table, axes, intensity, ring), encode)


def _npy(rows: NDArray[np.generic]) -> bytes:
    file = io.BytesIO()
    np.save(file, rows, allow_pickle=False)
    return file.getvalue()
