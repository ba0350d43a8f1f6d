"""Files of single scans, read as a table of all their columns and written back in the same format.

| file               | columns                                          | data sets                          |
|--------------------|--------------------------------------------------|------------------------------------|
| `.bin`             | x y z intensity, float32, or those declared      | KITTI, SemanticKITTI               |
| `.pcd.bin`         | x y z intensity ring, float32, or those declared | nuScenes: HDL-32E, intensity to 255|
| `.npy`             | (P, C) floats x y z, the fourth is the intensity, anything; or those declared         |
| `.npy`             | (P,) fields x y z and, by their names, intensity, ring | as ROS's messages become      |
| `.pcd`, `.ply`     | fields x y z and, by their names, intensity, ring | any; vertices alone                |

Points are x forward, y left, z up in the sensor's frame. Beside the folder of `velodyne/N.bin` may be labels:
`labels/N.label` of SemanticKITTI, `label_2/N.txt` of KITTI.
"""

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dsrc.data.clouds.cloud import Cloud
from dsrc.data.clouds.columns import KITTI, check_values
from dsrc.data.clouds.columns import NUSCENES as NUSCENES_COLUMNS
from dsrc.data.clouds.corrupt import array_of, cloud_of
from dsrc.data.clouds.intensity import EIGHT_BIT, Intensities, Scale
from dsrc.data.clouds.ply import decode_ply, encode_ply
from dsrc.data.formats import kitti_labels
from dsrc.data.formats.pcd import NOWHERE, encode_table, padded, read_organised
from sensors.corruptions.published.incomplete_echo import SEMANTIC_KITTI
from sensors.sweep import Sweep
from sim.errors import DataError, complaint, notice, option
from sim.reading import parsing, read_bytes

NUSCENES = ".pcd.bin"
"""End of the names of nuScenes' scans, which alone tells their five columns from KITTI's four."""
ENDINGS = (NUSCENES, ".bin", ".npy", ".pcd", ".ply")
"""Ends of the names of scans, the longest of those that fit first."""
NUSCENES_SENSOR = "hdl-32e"
"""Preset of the LiDAR of nuScenes."""
_NO_NAMES = "a file without names of columns"
_LABEL_BITS = 0xFFFF
_DECLARE = (
    f"declare those of other files by {option('columns')} x,y,z,intensity,...; points of 20 bytes, as nuScenes has "
    f"them, are read from *{NUSCENES}"
)


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """Scan of a file.

    Attributes:
        cloud: its points.
        encode: returns the file of a table of the same columns; told whether its rows are those of the cloud in order.
        sensor: name of the preset that the format implies, None without one.
    """

    cloud: Cloud
    encode: Callable[[NDArray[np.void], bool], bytes]
    sensor: str | None = None

    def file(self, sweep: Sweep) -> tuple[bytes, NDArray[np.int64]]:
        """Return the file of a corrupted sweep that `cloud.sweep` has made, and (Q,) the row that each of its rows was.

        Rows of added points are -1; rows without a return are where they were.
        """
        table, row = self.cloud.of(sweep), self.cloud.rows(sweep)
        return self.encode(table, np.array_equal(row, np.arange(len(self.cloud)))), row


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


def read_scan(path: Path, columns: Sequence[str] | None = None, scale: Scale | None = None) -> Scan:
    """Read the scan of a file.

    Args:
        columns: names of the columns of a file without names, see `parse_columns`; None for those of its format.
        scale: of the intensities; None for that of the format, or the one found in them.

    Raises:
        DataError: the file is missing, damaged or of another kind, lacks coordinates, or its size or its values do not
            fit the columns; or columns of a file that names its own.
    """
    ending = ending_of(path)
    if ending is None:
        raise DataError(complaint(path, "scan", f"a file *{', *'.join(ENDINGS)}", path.suffix or "no ending"))
    if columns is not None and ending in (".pcd", ".ply"):
        raise DataError(complaint(path, option("columns"), _NO_NAMES, f"*{ending}, which has them"))
    if ending == ".pcd":
        scan = _pcd(path)
    else:
        content = read_bytes(path, f"{ending} scan")
        with parsing(path, f"{ending} scan"):
            if ending == ".ply":
                table, header = decode_ply(path, content)
                scan = Scan(Cloud.named(path, table), lambda table, _: encode_ply(table, header))
            elif ending == ".npy":
                scan = _npy(path, content, columns)
            else:
                scan = _rows(path, content, columns or (NUSCENES_COLUMNS if ending == NUSCENES else KITTI))
    if ending == NUSCENES and columns is None:
        scan = Scan(replace(scan.cloud, scale=EIGHT_BIT), scan.encode, NUSCENES_SENSOR)
    return scan if scale is None else replace(scan, cloud=replace(scan.cloud, scale=scale))


def scale_of(paths: Sequence[Path], columns: Sequence[str] | None, where: Path) -> Scale:
    """Return the one scale of the intensities of many scans, such as those of a folder `where`, which are all read.

    Raises:
        DataError: a scan cannot be read, or the scale cannot be found.
    """
    return intensities_of(paths, columns).scale(where)


def intensities_of(paths: Sequence[Path], columns: Sequence[str] | None) -> Intensities:
    """Return what the intensities of scans tell of their scale; DataError where one cannot be read."""
    return Intensities.joined([_intensities_of(path, columns) for path in paths])


def _intensities_of(path: Path, columns: Sequence[str] | None) -> Intensities:
    cloud = read_scan(path, columns).cloud
    if cloud.intensity is None:
        return Intensities()
    found = Intensities.of(cloud.table[cloud.intensity][cloud.returns], path.name)
    return found if cloud.scale is None else replace(found, bits=True, fractions=None)


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


def _pcd(path: Path) -> Scan:
    table, taken = read_organised(path)

    def encode(table: NDArray[np.void], same_rows: bool) -> bytes:
        if taken.height > 1 and not same_rows:
            notice("points of organised clouds were lost or added: these are written without their grid, HEIGHT 1")
        return encode_table(table, taken if same_rows else replace(taken, height=NOWHERE.height))

    return Scan(Cloud.named(path, table), encode)


def _rows(path: Path, content: bytes, columns: Sequence[str]) -> Scan:
    """Return the scan of rows of float32."""
    table = np.dtype([(padded(name, column), "<f4") for column, name in enumerate(columns)])
    if len(content) % table.itemsize:
        field, expected = f"size of columns {','.join(columns)}", f"whole points of {table.itemsize} bytes"
        raise DataError(complaint(path, field, expected, f"{len(content)} bytes", f"; {_DECLARE}"))
    rows = np.frombuffer(content, table)
    check_values(path, rows)
    return Scan(Cloud.named(path, rows), lambda table, _: table.tobytes())


def _npy(path: Path, content: bytes, columns: Sequence[str] | None) -> Scan:
    rows = np.load(io.BytesIO(content), allow_pickle=False)
    if rows.dtype.names and columns is not None:
        raise DataError(complaint(path, option("columns"), _NO_NAMES, f"fields {' '.join(rows.dtype.names)}"))
    try:
        cloud = cloud_of(rows, columns=columns)
    except DataError as error:
        raise DataError(f"{path}: {error}") from None

    def encode(table: NDArray[np.void], _: bool) -> bytes:
        file = io.BytesIO()
        np.save(file, array_of(table, rows.dtype), allow_pickle=False)
        return file.getvalue()

    return Scan(cloud, encode)
