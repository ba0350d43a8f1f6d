"""Scans as other tools write them: nothing is damaged in silence, and what cannot be known is asked for."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import dsrc
from dsrc.data.clouds.files import read_scan, scale_of
from dsrc.data.clouds.intensity import from_unit, to_unit
from dsrc.data.datasets.corrupt import corrupt_dataset
from dsrc.data.datasets.corrupt_scans import MANIFEST
from dsrc.data.formats.pcd import read_table
from sensors.corruptions import CORRUPTIONS
from sim.errors import DataError, SettingsError, notice
from tests.commands import dsrc as command
from tests.dsrc.data.clouds.test_corrupt import ALONE, BOXES, street

CLOUD = street().astype("<f4")
NO_RETURN = {"zeros": (0.0, 0.0, 0.0), "nan": (np.nan, np.nan, np.nan), "one nan": (np.nan, 3.0, 1.0)}


def corrupted(scan: Path, kind: str = "fog", **options: object) -> Path:
    (made,) = corrupt_dataset(scan, scan.with_name(f"{kind}_{scan.name}"), kind, **options)
    return made


def written(path: Path, rows: NDArray[np.generic]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(np.ascontiguousarray(rows).astype("<f4").tobytes())
    return path


def with_gaps(rows: NDArray[np.float32], gap: tuple[float, ...]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """A cloud with a row without a return before every fourth of its points, and after the last ones."""
    at = np.append(np.arange(0, len(rows), 4), [len(rows)] * 3)
    filler = np.array([*gap, 0.25], np.float32)
    gaps = np.insert(np.zeros(len(rows), bool), at, True)
    return np.insert(rows, at, filler, axis=0), gaps


@pytest.mark.parametrize("gap", NO_RETURN)
@pytest.mark.parametrize("family", ["physical", "paper"])
@pytest.mark.parametrize("kind", ALONE)
def test_rows_without_a_return_pass_through_and_nothing_is_added_for_them(kind: str, family: str, gap: str) -> None:
    if family == "paper" and CORRUPTIONS[kind].paper_apply is None:
        pytest.skip("without a published model")
    cloud = street()[::5]
    rows, gaps = with_gaps(cloud, NO_RETURN[gap])
    out = dsrc.corrupt(rows, kind, 4, 7, boxes=BOXES, family=family)
    silent = np.array([row.tobytes() == rows[0].tobytes() for row in out])
    assert silent.sum() == gaps.sum()
    assert np.array_equal(out[~silent], dsrc.corrupt(cloud, kind, 4, 7, boxes=BOXES, family=family))
    if kind == "noise":  # moves points, and neither adds nor removes one
        assert np.array_equal(silent, gaps)


def test_a_fieldless_cloud_of_nothing_but_silence_stays_as_it_is() -> None:
    for kind in ALONE:
        assert np.array_equal(dsrc.corrupt(np.zeros((9, 4), np.float32), kind, boxes=BOXES), np.zeros((9, 4)))


@pytest.mark.parametrize("encoding", ["ASCII", "BINARY", "BINARY_COMPRESSED"])
def test_a_cloud_of_pypcd4_with_padding_and_wide_fields_comes_back_to_it(tmp_path: Path, encoding: str) -> None:
    pypcd4 = pytest.importorskip("pypcd4")
    ring, counts = np.arange(len(CLOUD)) % 32, (1, 1, 1, 4, 1, 1, 3, 10)
    head = [
        "FIELDS x y z _ intensity ring normal _",
        "SIZE 4 4 4 1 4 2 4 1",
        "TYPE F F F U F U F U",
        f"COUNT {' '.join(map(str, counts))}",
        f"WIDTH {len(CLOUD)}",
        f"POINTS {len(CLOUD)}",
        "DATA binary",
    ]
    layout = pypcd4.MetaData.parse_header(head)
    table = np.zeros(len(CLOUD), layout.build_dtype())
    names = ("x", "y", "z", "intensity", "ring", "normal__0001")
    for name, values in zip(names, [*CLOUD.T, ring, ring], strict=True):
        table[name] = values
    pypcd4.PointCloud(layout, table).save(tmp_path / "a.pcd", encoding=pypcd4.Encoding[encoding])
    assert b"FIELDS x y z _ intensity ring normal _\n" in (tmp_path / "a.pcd").read_bytes()
    back = pypcd4.PointCloud.from_path(corrupted(tmp_path / "a.pcd", "point_dropping"))
    assert back.metadata.count == counts
    assert 0 < back.points < len(CLOUD)
    # Packed by pypcd4, the parts of a wide field follow each other; PCL's packed files, and ours, keep them together.
    names = names[: 5 if encoding == "BINARY_COMPRESSED" else 6]
    there = {row.tobytes() for row in pypcd4.PointCloud.from_path(tmp_path / "a.pcd").numpy(names)}
    assert {row.tobytes() for row in back.numpy(names)} < there


def organised(path: Path, points: NDArray[np.float32], extra: bytes = b"") -> Path:
    """A cloud of 32 rows with a viewpoint as PCL writes it, and Ouster's empty field.

    Source: the PCD specification, https://pointclouds.org/documentation/tutorials/pcd_file_format.html
    """
    head = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z intensity _\nSIZE 4 4 4 4 1\n"
        f"TYPE F F F F U\nCOUNT 1 1 1 1 0\nWIDTH {len(points) // 32}\nHEIGHT 32\n"
        f"VIEWPOINT 12.5 -3 1.8 0.7071068 0 0 0.7071068\nPOINTS {len(points)}\nDATA binary\n"
    )
    path.write_bytes(head.encode() + points.tobytes() + extra)
    return path


def test_an_organised_cloud_keeps_its_grid_while_it_can_and_says_when_it_cannot(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    notice.cache_clear()
    points = CLOUD[: len(CLOUD) // 32 * 32].copy()
    points[7::9, :3] = np.nan
    head = organised(tmp_path / "a.pcd", points).read_bytes().partition(b"DATA")[0]
    kept = corrupted(tmp_path / "a.pcd", "noise").read_bytes().partition(b"DATA")[0]
    assert kept == head.replace(b" _\nSIZE", b"\nSIZE").replace(b" 1\nTYPE", b"\nTYPE").replace(b" U\n", b"\n").replace(
        b" 0\nWIDTH", b"\nWIDTH"
    )
    assert not caplog.messages
    lost = corrupted(tmp_path / "a.pcd", "point_dropping")
    assert [message for message in caplog.messages if "HEIGHT 1" in message and "\n" not in message]
    assert b"\nHEIGHT 1\nVIEWPOINT 12.5 -3 1.8 0.7071068 0 0 0.7071068\n" in lost.read_bytes()
    assert np.count_nonzero(np.isnan(read_table(lost)["x"])) == np.count_nonzero(np.isnan(points[:, 0]))


@pytest.mark.parametrize(("extra", "said"), [(b"\n", 0), (bytes(15), 0), (bytes(64), 1)])
def test_bytes_after_the_points_are_no_points(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, extra: bytes, said: int
) -> None:
    notice.cache_clear()
    points = CLOUD[: len(CLOUD) // 32 * 32]
    assert len(read_table(organised(tmp_path / "a.pcd", points, extra))) == len(points)
    assert len(caplog.messages) == said


@pytest.mark.parametrize(("text", "order"), [(True, "="), (False, "<"), (False, ">")])
def test_a_cloud_of_plyfile_with_empty_elements_comes_back_to_it(tmp_path: Path, text: bool, order: str) -> None:
    plyfile = pytest.importorskip("plyfile")
    table = np.zeros(len(CLOUD), [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4"), ("id", "i4")])
    for name, values in zip(("x", "y", "z", "intensity", "id"), [*CLOUD.T, np.arange(len(CLOUD)) + 1], strict=True):
        table[name] = values
    faces = np.zeros(0, [("vertex_indices", "i4", (3,)), ("flag", "u1")])
    elements = [plyfile.PlyElement.describe(table, "vertex"), plyfile.PlyElement.describe(faces, "face")]
    plyfile.PlyData(elements, text=text, byte_order=order, comments=["made by", "element vertex 3"]).write(
        tmp_path / "a.ply"
    )
    made = corrupted(tmp_path / "a.ply", "point_dropping")
    back = plyfile.PlyData.read(made)
    assert [element.name for element in back.elements] == ["vertex", "face"]
    assert list(back.comments) == ["made by", "element vertex 3"]
    out = back["vertex"].data
    assert 0 < len(out) < len(table)
    assert np.array_equal(out.astype(table.dtype), table[out["id"] - 1])


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("end", ["\r\n", "\r", "\n"])
def test_lines_of_a_ply_may_end_as_on_any_system(tmp_path: Path, end: str, form: str) -> None:
    """By hand: plyfile writes the lines of this system; G. Turk, The PLY Polygon File Format (1994), by CR."""
    lines = ["ply", f"format {form} 1.0", "comment a\u00e9", "obj_info b", "element face 0"]
    lines += ["property list uchar int vertex_indices", f"element vertex {len(CLOUD)}"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "intensity")] + ["end_header"]
    rows = "".join(" ".join(map(repr, row)) + end for row in CLOUD.tolist())
    content = "".join(f"{line}{end}" for line in lines).encode("latin-1")
    (tmp_path / "a.ply").write_bytes(content + (rows.encode() if form == "ascii" else CLOUD.tobytes()))
    made = corrupted(tmp_path / "a.ply", "noise")
    assert made.read_bytes().startswith(content)
    table = read_scan(made).cloud.table
    assert len(table) == len(CLOUD)
    assert np.median(np.abs(table["x"] - CLOUD[:, 0])) < 0.2


EXTRA = {
    "scores": lambda n: np.tile([0.1, 0.2, 0.3, 0.4], (n, 1)),
    "ring, time": lambda n: np.column_stack([np.arange(n) % 64, np.arange(n) * 1e-5]),
    "normals, curvature": lambda n: np.column_stack([_units(n), np.full(n, 0.01)]),
    "one": lambda n: np.arange(n)[:, None] % 32,
    "colour": lambda n: np.random.default_rng(1).integers(0, 256, (n, 3)),
    "velocity": lambda n: np.column_stack([_units(n)[:, :2] * 9.0, np.zeros((n, 2))]),
    "eight classes": lambda n: np.eye(8)[np.random.default_rng(2).choice(8, n, p=[0.65] + 7 * [0.05])],
    "padding": lambda n: np.column_stack([np.arange(n) % 7 + 0.5, np.zeros((n, 3))]),
}


def _units(n: int) -> NDArray[np.float64]:
    found = np.random.default_rng(0).normal(size=(n, 3))
    return found / np.linalg.norm(found, axis=1)[:, None]


@pytest.mark.parametrize("kind", EXTRA)
def test_columns_that_nobody_declared_are_refused_and_declared_ones_stay_with_their_points(
    tmp_path: Path, kind: str
) -> None:
    cloud = CLOUD[: len(CLOUD) // 8 * 8]  # its size fits four columns, however wide its points are
    extra = EXTRA[kind](len(cloud)).astype("<f4")
    scan = written(tmp_path / "a.bin", np.hstack([cloud, extra]))
    with pytest.raises(DataError, match=r"a\.bin: .*--columns x,y,z,intensity,\.\.\.") as error:
        corrupted(scan)
    assert "\n" not in str(error.value)
    columns = ",".join(["x", "y", "z", "intensity", *"_" * extra.shape[1]])
    made = np.fromfile(corrupted(scan, "point_dropping", columns=columns), "<f4").reshape(-1, 4 + extra.shape[1])
    there = {row.tobytes() for row in np.hstack([cloud, extra])}
    assert 0 < len(made) < len(cloud)
    assert {row.tobytes() for row in made} <= there


@pytest.mark.parametrize("scale", [1.0, 255.0])
@pytest.mark.parametrize("order", ["rings", "firings", "shuffled", "half"])
def test_clouds_of_four_columns_are_taken_whatever_their_order(tmp_path: Path, scale: float, order: str) -> None:
    cloud = CLOUD[: len(CLOUD) // 32 * 32] * np.array([4, 4, 4, scale], np.float32)  # to 300 m
    rows = {
        "rings": cloud,
        "firings": cloud.reshape(32, -1, 4)[np.arange(32) % 2 * 16 + np.arange(32) // 2]
        .transpose(1, 0, 2)
        .reshape(-1, 4),
        "shuffled": np.random.default_rng(0).permutation(cloud),
        "half": cloud[cloud[:, 0] > 0],
    }[order]
    assert len(read_scan(written(tmp_path / "a.bin", rows)).cloud) == len(rows)


def test_columns_fit_or_are_refused(tmp_path: Path) -> None:
    scan = written(tmp_path / "a.bin", CLOUD)
    for columns in ("x,y,z", "x,y,z,intensity,ring", "x,y,intensity,z"):
        with pytest.raises(DataError, match=r"a\.bin: "):
            corrupted(scan, columns=columns)
    with pytest.raises(SettingsError, match="--columns: expected names with x, y, z"):
        corrupted(scan, columns="x,y,intensity")
    ply = tmp_path / "a.ply"
    ply.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n")
    with pytest.raises(DataError, match=r"--columns: expected a file without names of columns, found \*.ply"):
        corrupted(ply, columns="x,y,z")


def test_columns_in_another_order_are_those_of_the_cloud(tmp_path: Path) -> None:
    ring = np.arange(len(CLOUD)) % 32
    rows = np.column_stack([ring, CLOUD[:, [3, 2, 1, 0]]]).astype("<f4")
    names = "ring,intensity,z,y,x"
    plain = dsrc.corrupt(np.column_stack([CLOUD, ring]).astype("<f4"), "fog", ring=4)
    turned = dsrc.corrupt(rows, "fog", columns=names)
    assert np.array_equal(turned, plain[:, [4, 3, 2, 1, 0]])
    made = corrupted(written(tmp_path / "1.bin", rows), columns=names)
    np.save(tmp_path / "1.npy", rows)
    assert np.array_equal(np.load(corrupted(tmp_path / "1.npy", columns=names)).ravel(), np.fromfile(made, "<f4"))
    transform = dsrc.CorruptTransform(columns=names.split(","))
    assert transform(rows, index=3).shape[1] == 5


def test_an_array_with_fields_has_the_columns_that_it_names(tmp_path: Path) -> None:
    ring = np.arange(len(CLOUD)) % 32
    rows = np.zeros(len(CLOUD), [("intensity", ">f4"), ("z", "<f4"), ("y", "<f4"), ("x", "<f4"), ("ring", "<u2")])
    for name, values in zip(("x", "y", "z", "intensity", "ring"), (*CLOUD.T, ring), strict=True):
        rows[name] = values
    plain = dsrc.corrupt(np.column_stack([CLOUD, ring]).astype("<f4"), "fog", ring=4)
    out = dsrc.corrupt(rows, "fog")
    assert out.dtype == rows.dtype
    assert all(np.array_equal(out[name], plain[:, k]) for k, name in enumerate(("x", "y", "z", "intensity", "ring")))
    made = corrupted(written(tmp_path / "1.bin", np.column_stack([CLOUD, ring])), columns="x,y,z,intensity,ring")
    np.save(tmp_path / "1.npy", rows)
    kept = np.load(corrupted(tmp_path / "1.npy"))
    assert kept.dtype == rows.dtype
    assert np.array_equal(kept["ring"], np.fromfile(made, "<f4").reshape(-1, 5)[:, 4])
    with pytest.raises(SettingsError, match="columns: expected none with points that name their fields"):
        dsrc.corrupt(rows, "fog", columns=("x", "y", "z", "intensity", "ring"))
    with pytest.raises(DataError, match="fields: expected a field z"):
        dsrc.corrupt(rows[["x", "y"]], "fog")
    with pytest.raises(DataError, match=r"1.npy: --columns: expected a file without names of columns"):
        corrupted(tmp_path / "1.npy", columns="x,y,z")


@pytest.mark.parametrize("kind", ["U8", "S8", "?", "c8", "M8[s]", "O"])
def test_a_field_that_is_no_number_is_named(kind: str) -> None:
    rows = np.zeros(3, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("ring", kind)])
    with pytest.raises(DataError, match=r"points: type of ring: expected a number"):
        dsrc.corrupt(rows, "fog")


@pytest.mark.parametrize("name", ["scan.csv", "scan.las", "scan"])
def test_a_file_that_is_no_scan_is_told_which_are_read(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"1,2,3")
    with pytest.raises(DataError, match=r"data: expected a folder, or a scan \*.pcd.bin, \*.bin"):
        corrupted(tmp_path / name)


def test_one_bright_point_changes_no_scale() -> None:
    bright = CLOUD.copy()
    bright[5, 3] = 1.004
    plain, out = (dsrc.corrupt(rows, "fog", 3, boxes=BOXES) for rows in (CLOUD, bright))
    assert len(out) == pytest.approx(len(plain), abs=1)
    assert out[:, 3].max() <= np.float32(1.004)
    assert bright[5].tobytes() in {row.tobytes() for row in dsrc.corrupt(bright, "beam_missing", 1)}


def test_scans_of_a_folder_have_one_scale(tmp_path: Path) -> None:
    eight = CLOUD.copy()
    eight[:, 3] = np.rint(255 * eight[:, 3])
    dark = eight[:500].copy()
    dark[:, 3] = np.arange(500) % 2
    folder = tmp_path / "eight/velodyne"
    paths = [written(folder / f"{i}.bin", rows) for i, rows in enumerate((eight, dark))]
    assert scale_of(paths, None, folder) == 255.0
    assert scale_of(paths[1:], None, folder) == 1.0  # alone it is as good a cloud of fractions
    corrupt_dataset(folder, tmp_path / "out", "snow", severity=5)
    assert '"intensity_scale": 255.0' in (tmp_path / "out" / MANIFEST).read_text()
    both = corrupt_dataset(folder, tmp_path / "declared", "snow", severity=5, intensity_scale="255")
    assert [path.read_bytes() for path in both] == [(tmp_path / "out" / path.name).read_bytes() for path in both]
    written(folder / "2.bin", CLOUD)
    with pytest.raises(DataError, match=r"velodyne: intensity: expected one scale, found fractions in .*2\.bin"):
        corrupt_dataset(folder, tmp_path / "mixed", "fog")
    with pytest.raises(DataError, match=r"intensity_scale: expected 1.0 as asked for now"):
        corrupt_dataset(folder, tmp_path / "out", "snow", severity=5, intensity_scale=1)


@pytest.mark.parametrize(("scale", "most"), [(65535, 65535.0), ("waymo", 20.0)])
def test_other_scales_are_declared(tmp_path: Path, scale: str | float, most: float) -> None:
    cloud, wide = CLOUD.copy(), CLOUD.copy()
    wide[:, 3] = from_unit(CLOUD[:, 3], scale)
    cloud[::50, 3], wide[::50, 3] = 1.0, most
    scan = written(tmp_path / "a.bin", wide)
    with pytest.raises(DataError, match=r"intensity: expected .*--intensity-scale: 1, 255, 65535, waymo"):
        corrupted(scan)
    made = np.fromfile(corrupted(scan, intensity_scale=scale), "<f4").reshape(-1, 4)
    plain = np.fromfile(corrupted(written(tmp_path / "b.bin", cloud)), "<f4").reshape(-1, 4)
    assert len(made) == pytest.approx(len(plain), rel=0.01)
    assert to_unit(made[:, 3], scale).mean() == pytest.approx(plain[:, 3].mean(), rel=0.02)


def test_points_in_coordinates_of_a_map_are_refused(tmp_path: Path) -> None:
    points = CLOUD + np.array([5e5, 5e6, 0.0, 0.0])
    np.save(tmp_path / "utm.npy", points)
    with pytest.raises(DataError, match=r"utm\.npy: .*x y z: expected at most 10000 m, found 49.*subtract its place"):
        corrupted(tmp_path / "utm.npy")


def test_a_link_to_itself_is_told_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "loop.bin").symlink_to("loop.bin")
    done = command("corrupt", str(tmp_path / "loop.bin"), "--corruption", "fog", "--out", str(tmp_path / "o.bin"))
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1 and "loop.bin" in done.stderr
