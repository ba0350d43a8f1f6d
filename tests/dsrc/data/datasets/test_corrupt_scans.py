"""Scans of other data sets: each in its own format, with what belongs to its points, the same however it is made."""

from pathlib import Path

import numpy as np
import pytest

import dsrc
from dsrc.cli.main import run
from dsrc.data.clouds.files import read_scan
from dsrc.data.datasets.corrupt import corrupt_dataset
from dsrc.data.datasets.corrupt_scans import MANIFEST, frame_number
from dsrc.data.formats.kitti import encode_labels
from dsrc.data.formats.pcd import encode_table, read_table
from dsrc.runs.executors import Pool
from dsrc.runs.study import reused
from sensors.corruptions import drive_seed
from sim.boxes import Boxes
from sim.errors import DataError, SettingsError
from tests.dsrc.data.clouds.test_corrupt import BOXES, street

CLOUD = street().astype("<f4")
RING = np.repeat(np.arange(32)[::-1], 180)[: len(CLOUD)]


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """Nineteen scans as KITTI has them."""
    folder = tmp_path / "kitti/training/velodyne"
    folder.mkdir(parents=True)
    for number in range(19):
        (folder / f"{number:06d}.bin").write_bytes(CLOUD[number:].tobytes())
    return tmp_path / "kitti"


def test_a_folder_has_the_same_bytes_whoever_makes_it(kitti: Path, tmp_path: Path) -> None:
    for workers in (1, 2):
        made = corrupt_dataset(kitti, tmp_path / f"by{workers}", "fog", seed=3, pool=Pool(workers))
        assert made == [tmp_path / f"by{workers}/training/velodyne/{number:06d}.bin" for number in range(19)]
    assert tree(tmp_path / "by1") == tree(tmp_path / "by2")
    out = np.fromfile(made[7], "<f4").reshape(-1, 4)
    assert np.array_equal(out, dsrc.corrupt(CLOUD[7:], "fog", 3, drive_seed(3, "training/velodyne"), index=7))


def test_a_scan_alone_gets_the_bytes_that_it_gets_in_its_folder(kitti: Path, tmp_path: Path) -> None:
    corrupt_dataset(kitti, tmp_path / "all", "beam_missing")
    scan = kitti / "training/velodyne/000005.bin"
    assert corrupt_dataset(scan, tmp_path / "one.bin", "beam_missing") == [tmp_path / "one.bin"]
    assert (tmp_path / "one.bin").read_bytes() == (tmp_path / "all/training/velodyne/000005.bin").read_bytes()


def test_a_scan_alone_takes_no_earlier_folder(kitti: Path, tmp_path: Path) -> None:
    scan = kitti / "training/velodyne/000005.bin"
    with pytest.raises(SettingsError, match="leave out --reuse"):
        corrupt_dataset(scan, tmp_path / "one.bin", "beam_missing", reuse=(tmp_path,))


def test_finished_scans_are_skipped_and_missing_ones_made(kitti: Path, tmp_path: Path) -> None:
    out, seen = tmp_path / "out", []
    made = corrupt_dataset(kitti, out, "noise")
    whole, when = tree(out), made[1].stat().st_mtime_ns
    made[0].unlink()
    (made[3].parent / ".000003.bin.0123abcd.tmp").write_bytes(b"part")
    corrupt_dataset(kitti, out, "noise", progress=lambda done, total: seen.append((done, total)))
    assert tree(out) == whole
    assert made[1].stat().st_mtime_ns == when
    assert seen == [(18, 19), (19, 19)]
    (kitti / "training/velodyne/000001.bin").write_bytes(CLOUD[:50].tobytes())
    corrupt_dataset(kitti, out, "noise")
    assert made[1].stat().st_size == 50 * 16
    with pytest.raises(DataError, match=f"{MANIFEST}: severity: expected 5"):
        corrupt_dataset(kitti, out, "noise", severity=5)


def test_scans_that_other_code_made_are_taken_when_asked(
    kitti: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    made = corrupt_dataset(kitti, out, "noise")
    whole = tree(out)
    made[1].unlink()
    monkeypatch.setattr("dsrc.data.datasets.corrupt_scans.code_hash", lambda entry: "0" * 64)
    with pytest.raises(DataError, match=f"{MANIFEST}: code: expected '0000.*--reuse"):
        corrupt_dataset(kitti, out, "noise")
    with pytest.raises(DataError, match="reuse: expected a folder of corrupted scans"):
        corrupt_dataset(kitti, out, "noise", reuse=(kitti,))
    corrupt_dataset(kitti, out, "noise", reuse=(out,))
    assert sorted(reused(out)) == [f"training/velodyne/{number:06d}.bin" for number in range(2, 19)]
    changed = {name for name, content in tree(out).items() if content != whole.get(name)}
    assert changed == {MANIFEST, "reused.json"}


def test_the_scans_of_one_folder_share_their_dead_beams(kitti: Path, tmp_path: Path) -> None:
    def dead(file: Path) -> set[int]:
        kept = {row.tobytes() for row in np.fromfile(file, "<f4").reshape(-1, 4)}
        ring = np.array([row.tobytes() in kept for row in CLOUD])
        rings = np.rint(np.degrees(np.arctan2(CLOUD[:, 2], np.hypot(*CLOUD[:, :2].T))) * 31 / 32).astype(int)
        return set(rings) - set(rings[ring])

    made = corrupt_dataset(kitti, tmp_path / "out", "beam_missing", severity=4)
    assert len(dead(made[0])) >= 12
    assert dead(made[0]) == dead(made[9])


def test_labels_of_semantickitti_stay_in_step(tmp_path: Path) -> None:
    velodyne, labels = tmp_path / "sequences/00/velodyne", tmp_path / "sequences/00/labels"
    velodyne.mkdir(parents=True)
    labels.mkdir()
    (velodyne / "000000.bin").write_bytes(CLOUD.tobytes())
    known = np.arange(len(CLOUD), dtype="<u4") << 16 | 40
    known[:400] = known[:400] & 0xFFFF0000 | 10
    (labels / "000000.label").write_bytes(known.tobytes())
    for kind in ("crosstalk", "incomplete_echo"):
        corrupt_dataset(tmp_path / "sequences", tmp_path / kind, kind, severity=5)
        out = np.fromfile(tmp_path / kind / "00/velodyne/000000.bin", "<f4").reshape(-1, 4)
        now = np.fromfile(tmp_path / kind / "00/labels/000000.label", "<u4")
        row = now >> 16
        real = now > 0
        assert len(now) == len(out)
        assert np.array_equal(out[real], CLOUD[row[real]])
        assert real.all() == (kind == "incomplete_echo")
    assert np.count_nonzero(now & 0xFFFF == 10) == 400 - int(0.95 * 400)
    assert np.count_nonzero(now & 0xFFFF == 40) == len(CLOUD) - 400
    corrupt_dataset(velodyne / "000000.bin", tmp_path / "one/a.bin", "incomplete_echo", severity=5)
    assert (tmp_path / "one/a.label").read_bytes() == now.tobytes()
    assert not (tmp_path / "labels").exists()


def test_nuscenes_keeps_intensity_and_ring(tmp_path: Path) -> None:
    rows = np.column_stack([CLOUD[:, :3], np.rint(255 * CLOUD[:, 3]), RING]).astype("<f4")
    scan = tmp_path / "LIDAR_TOP/n015-2018-07-24__LIDAR_TOP__1532402927647951.pcd.bin"
    scan.parent.mkdir()
    scan.write_bytes(rows.tobytes())
    (made,) = corrupt_dataset(tmp_path / "LIDAR_TOP", tmp_path / "out", "beam_missing", severity=4)
    out = np.fromfile(made, "<f4").reshape(-1, 5)
    assert len(np.unique(out[:, 4])) == 16
    assert {row.tobytes() for row in out} <= {row.tobytes() for row in rows}
    assert frame_number(scan) == (1532402927647951, pytest.approx(1532402927.647951))


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_keeps_its_form_and_its_fields(form: str, tmp_path: Path) -> None:
    order = ">" if form.endswith("big_endian") else "<"
    fields = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "u1"), ("id", "i4")]
    table = np.zeros(len(CLOUD), [(name, order + kind) for name, kind in fields])
    for name, column in zip("xyz", CLOUD.T, strict=False):
        table[name] = column
    table["intensity"], table["id"] = np.rint(255 * CLOUD[:, 3]), np.arange(len(CLOUD)) + 1
    kinds = {"f4": "float", "u1": "uchar", "i4": "int"}
    listed = "".join(f"property {kinds[kind]} {name}\n" for name, kind in fields)
    header = f"ply\nformat {form} 1.0\ncomment scan\nelement vertex {len(table)}\n{listed}end_header\n"
    text = "".join(" ".join(map(str, row)) + "\n" for row in table.tolist()).encode()
    (tmp_path / "a.ply").write_bytes(header.encode() + (text if form == "ascii" else table.tobytes()))
    (made,) = corrupt_dataset(tmp_path / "a.ply", tmp_path / "b.ply", "fog", severity=5)
    out = read_scan(made).cloud.table
    assert out.dtype == (table.dtype if form != "ascii" else out.dtype)
    assert 0 < len(out) < len(table)
    kept = out["id"] > 0
    assert made.read_bytes().startswith(f"ply\nformat {form} 1.0\ncomment scan\nelement vertex {len(out)}\n".encode())
    same = np.abs(out["x"][kept] - table["x"][out["id"][kept] - 1]) < 1e-6
    assert same.mean() > 0.5


def test_pcd_and_npy_keep_their_columns(tmp_path: Path) -> None:
    fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("t", "<f8")]
    table = np.zeros(len(CLOUD), fields)
    for name, column in zip(("x", "y", "z", "intensity"), CLOUD.T, strict=True):
        table[name] = column
    table["ring"], table["t"] = RING, np.arange(len(CLOUD)) * 1e-6
    table["x"][3] = np.nan
    (tmp_path / "a.pcd").write_bytes(encode_table(table))
    (made,) = corrupt_dataset(tmp_path / "a.pcd", tmp_path / "b.pcd", "beam_missing", severity=3)
    out = read_table(made)
    assert out.dtype == table.dtype
    # A row without a return stays, whatever becomes of its beam.
    assert len(np.unique(out["ring"][np.isfinite(out["x"])])) == 24
    assert {row.tobytes() for row in out} < {row.tobytes() for row in table}
    rows = np.column_stack([CLOUD, np.arange(len(CLOUD))]).astype(np.float64)
    np.save(tmp_path / "a.npy", rows)
    (made,) = corrupt_dataset(tmp_path / "a.npy", tmp_path / "b.npy", "point_dropping")
    out = np.load(made)
    assert out.dtype == np.float64
    assert np.array_equal(out, rows[out[:, 4].astype(int)])


def test_a_preset_and_a_sensor_are_options(kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["corrupt", str(kitti / "training/velodyne/000000.bin"), "--corruption", "cross_sensor"]
    run([*words, "--preset", "robo3d_heavy", "--sensor", "hdl-32e", "--out", str(tmp_path / "a.bin")])
    assert capsys.readouterr().out == f"{tmp_path / 'a.bin'}\n"
    out = np.fromfile(tmp_path / "a.bin", "<f4").reshape(-1, 4)
    assert len(out) == pytest.approx(len(CLOUD) / 8, rel=0.3)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"corruption": "pose_error"}, "several agents"),
        ({"corruption": "incomplete_echo"}, "boxes of the vehicles"),
        ({"corruption": "fog", "sensor": "hdl"}, "unknown lidar"),
        ({"corruption": "fog", "corrupted_agents": "ego"}, "corrupted-agents"),
        ({"corruption": "fog", "preset": "none"}, "preset"),
        ({"corruption": "fog", "preset": "robo3d_heavy", "severity": 5}, "leave out the severity"),
        ({"corruption": "spray"}, "boxes of the vehicles with velocities"),
        ({"corruption": "fog", "out": "a.txt"}, r"\*.bin"),
    ],
)
def test_a_wrong_option_is_one_line(kitti: Path, tmp_path: Path, change: dict, said: str) -> None:
    scan = kitti / "training/velodyne/000000.bin"
    with pytest.raises((SettingsError, DataError), match=said) as error:
        corrupt_dataset(scan, tmp_path / change.pop("out", "a.bin"), **change)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.bin", b"123", r"whole points of 16 bytes, found 3 bytes; .* nuScenes .* \*.pcd.bin"),
        ("a.pcd.bin", b"0" * 16, "whole points of 20 bytes"),
        ("a.npy", b"no array", "a.npy"),
        ("a.npy", b"\x93NUMPY\x01\x00\x06\x00{}   \n", "a.npy"),
        ("a.ply", b"ply\nend_header\n", "vertices"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement face 3\nend_header\n", "vertices alone"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\n", "2 numbers"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float q\nend_header\n1\n", "a field x"),
        ("a.pcd", b"# .PCD", "header"),
    ],
)
def test_a_damaged_scan_is_one_line_with_its_name(tmp_path: Path, name: str, content: bytes, said: str) -> None:
    (tmp_path / name).write_bytes(content)
    out = tmp_path / f"out{name[1:]}"
    with pytest.raises(DataError, match=said) as error:
        corrupt_dataset(tmp_path / name, out, "fog")
    assert "\n" not in str(error.value)
    assert str(tmp_path / name) in str(error.value)
    assert not out.exists()


def test_labels_of_kitti_say_where_vehicles_are(kitti: Path, tmp_path: Path) -> None:
    labels, calib = kitti / "training/label_2", kitti / "training/calib"
    labels.mkdir()
    scan = kitti / "training/velodyne/000000.bin"
    with pytest.raises(SettingsError, match=r"000000.bin: .* boxes of the vehicles"):
        corrupt_dataset(scan, tmp_path / "without.bin", "incomplete_echo")
    boxes = Boxes.from_array(BOXES[:, :7])
    ignored = "DontCare -1 -1 -10 503.9 169.7 590.6 190.1 -1 -1 -1 -1000 -1000 -1000 -10\n"
    (labels / "000000.txt").write_text(encode_labels(boxes, "camera", np.zeros(2, np.int64)) + ignored)
    corrupt_dataset(scan, tmp_path / "nominal.bin", "incomplete_echo", severity=5)
    kept = {row.tobytes() for row in np.fromfile(tmp_path / "nominal.bin", "<f4").reshape(-1, 4)}
    lost = np.array([row.tobytes() not in kept for row in CLOUD])
    on = boxes.contains(CLOUD[:, :3], 0.2).any(axis=0)
    assert lost.sum() >= 0.9 * on.sum() > 20 and not (lost & ~on).any()
    calib.mkdir()  # a camera 100 m to the right: the boxes are elsewhere
    rotation = "R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 -100 0 0 -1 0 1 0 0 0\n"
    (calib / "000000.txt").write_text(rotation)
    corrupt_dataset(scan, tmp_path / "moved.bin", "incomplete_echo", severity=5)
    assert (tmp_path / "moved.bin").read_bytes() == scan.read_bytes()
    (labels / "000000.txt").write_text("Car 0 0\n")
    corrupt_dataset(scan, tmp_path / "fog.bin", "fog")
    with pytest.raises(DataError, match=r"000000.txt: line 1: expected 15 columns, found 3"):
        corrupt_dataset(scan, tmp_path / "broken.bin", "incomplete_echo")


def test_a_scan_of_another_number_of_labels_and_a_folder_of_nothing_are_refused(tmp_path: Path) -> None:
    for folder in ("velodyne", "labels", "empty"):
        (tmp_path / "a" / folder).mkdir(parents=True)
    (tmp_path / "a/velodyne/1.bin").write_bytes(CLOUD.tobytes())
    (tmp_path / "a/labels/1.label").write_bytes(b"1234")
    with pytest.raises(DataError, match="labels: expected"):
        corrupt_dataset(tmp_path / "a/velodyne", tmp_path / "out", "fog")
    with pytest.raises(DataError, match="missing: no such folder"):
        corrupt_dataset(tmp_path / "missing", tmp_path / "out", "fog")
    with pytest.raises(DataError, match=r"missing\.bin: file not found; expected a .bin scan"):
        corrupt_dataset(tmp_path / "missing.bin", tmp_path / "out.bin", "fog")
    with pytest.raises(DataError, match=r"empty: folder: expected drives, or scans \*.pcd.bin, .* found neither"):
        corrupt_dataset(tmp_path / "a/empty", tmp_path / "out", "fog")


def test_settings_that_the_first_scan_refuses_leave_the_folder_free(kitti: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(SettingsError, match=r"000000.bin: .* boxes of the vehicles"):
        corrupt_dataset(kitti, out, "incomplete_echo")
    assert not tree(out)
    corrupt_dataset(kitti, out, "point_dropping")
    assert len(tree(out)) == 20
