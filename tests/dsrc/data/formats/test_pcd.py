from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dsrc.data.formats import pcd
from dsrc.data.formats.lzf import decompress
from dsrc.data.formats.pcd import encode_pcd, encode_sensor_pcd, encode_table, read_pcd, read_table
from sensors.sweep import POINT_FIELDS, UNKNOWN_MATERIAL, make_sweep
from sim.errors import DataError
from tests.dsrc.data.toy import toy_frame

ASCII = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z rgb
SIZE 4 4 4 4
TYPE F F F {kind}
COUNT 1 1 1 1
WIDTH {n}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {n}
DATA ascii
1.5 2 -3 {rgb}
-0.25 4e-1 0 0
"""


@pytest.fixture
def written(tmp_path: Path) -> Path:
    (tmp_path / "000000.pcd").write_bytes(b"".join(encode_pcd(toy_frame(0).agents[0].sweep)))
    return tmp_path / "000000.pcd"


def test_a_sweep_reads_back_bit_for_bit(written: Path) -> None:
    sweep = toy_frame(0).agents[0].sweep
    back = read_pcd(written, sweep.world_from_lidar, sweep.time_s, sweep.spec)
    for name in POINT_FIELDS:
        assert getattr(back, name).dtype == getattr(sweep, name).dtype
        assert np.array_equal(getattr(back, name), getattr(sweep, name)), name


def test_opv2v_finds_a_left_handed_cloud_with_red_intensity(written: Path) -> None:
    sweep, table = toy_frame(0).agents[0].sweep, read_table(written)
    assert table.dtype.names[:4] == ("x", "y", "z", "rgb")
    assert np.array_equal(table["y"], -sweep.points[:, 1])
    red = (table["rgb"] >> 16) / 255.0
    assert np.abs(red - sweep.intensity).max() <= 0.5 / 255 + 1e-6
    assert not (table["rgb"] & 0xFFFF).any()


def test_an_empty_sweep_is_a_valid_file(tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_bytes(b"".join(encode_pcd(make_sweep(np.zeros((0, 3))))))
    assert len(read_pcd(tmp_path / "a.pcd")) == 0


def test_ascii_colour_becomes_intensity_whether_packed_as_number_or_float(tmp_path: Path) -> None:
    packed = 51 << 16
    as_float = repr(float(np.array(packed, np.uint32).view(np.float32)))
    for kind, rgb in (("U", str(packed)), ("F", as_float), ("I", str(packed))):
        (tmp_path / "a.pcd").write_text(ASCII.format(n=2, rgb=rgb, kind=kind))
        sweep = read_pcd(tmp_path / "a.pcd")
        assert sweep.points.tolist() == [[1.5, -2.0, -3.0], [-0.25, np.float32(-0.4), 0.0]]
        assert sweep.intensity.tolist() == [np.float32(0.2), 0.0]


@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
@pytest.mark.parametrize("compiled", [True, False])
def test_text_may_have_any_columns_in_any_order_and_no_last_line_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line_end: str, compiled: bool
) -> None:
    if not compiled:
        monkeypatch.setattr(pcd, "read_numbers", lambda text, count: None)
    n = 50
    rng = np.random.default_rng(0)
    table = np.zeros(
        n, [("label", "<u4"), ("z", "<f8"), ("normal", "<f4", 3), ("intensity", "<f4"), ("y", "<f4"), ("x", "<f4")]
    )
    table["label"] = rng.integers(0, 2**32, n)
    for name in ("z", "normal", "intensity", "y", "x"):
        table[name] = rng.normal(size=table[name].shape) * 10.0 ** rng.integers(-5, 5, table[name].shape)
    head = ASCII.format(n=n, rgb=0, kind="F").split("DATA")[0]
    for old, new in (
        ("x y z rgb", "label z normal intensity y x"),
        ("4 4 4 4", "4 8 4 4 4 4"),
        ("F F F F", "U F F F F F"),
        ("1 1 1 1", "1 1 3 1 1 1"),
    ):
        assert old in head
        head = head.replace(old, new, 1)
    lines = [" ".join(repr(v.item()) for part in row for v in np.atleast_1d(part)) for row in table]
    (tmp_path / "a.pcd").write_bytes((head + "DATA ascii\n" + "\n".join(lines)).replace("\n", line_end).encode())
    assert np.array_equal(read_table(tmp_path / "a.pcd"), table)
    assert np.array_equal(read_pcd(tmp_path / "a.pcd").points[:, 0], table["x"])


def test_a_word_among_many_numbers_is_named(tmp_path: Path) -> None:
    head = ASCII.format(n=40, rgb=0, kind="U").split("DATA")[0] + "DATA ascii\n"
    (tmp_path / "a.pcd").write_text(head + "1 2 3 0\n" * 20 + "1 2 one 0\n" + "1 2 3 0\n" * 19)
    with pytest.raises(DataError, match=r"a.pcd: DATA: expected numbers, found .*'one'"):
        read_pcd(tmp_path / "a.pcd")
    (tmp_path / "a.pcd").write_text(head + "1 2 3 0\n" * 39 + "1 2 3")
    with pytest.raises(DataError, match="DATA: expected 160 numbers for 40 points, found 159 numbers"):
        read_pcd(tmp_path / "a.pcd")


def test_intensity_of_0_to_255_is_scaled_when_there_is_no_colour(tmp_path: Path) -> None:
    table = np.zeros(2, [("x", "<f8"), ("y", "<f4"), ("z", "<f4"), ("intensity", "u1"), ("_", "<f4")])
    table["intensity"] = [0, 255]
    (tmp_path / "a.pcd").write_bytes(encode_table(table))
    assert read_pcd(tmp_path / "a.pcd").intensity.tolist() == [0.0, 1.0]


@pytest.mark.parametrize("cut", [1, 40, 41 * 400, 41 * 400 + 5, 41 * 400 + 200])
def test_a_truncated_file_is_named(written: Path, cut: int) -> None:
    written.write_bytes(written.read_bytes()[:-cut])
    with pytest.raises(DataError, match=r"000000.pcd: (DATA: expected 16400 bytes for 400 points|header)") as caught:
        read_pcd(written)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("POINTS 2", "POINTS 3", "POINTS: expected WIDTH x HEIGHT = 2 x 1, found 3"),
        ("WIDTH 2\n", "WIDTH two\n", "WIDTH: expected a whole number, found two"),
        ("SIZE 4 4 4 4", "SIZE 4 4 4", "SIZE: expected 4 entries as in FIELDS, found 3"),
        ("TYPE F F F", "TYPE F F Q", "TYPE and SIZE of z"),
        ("FIELDS x y z", "FIELDS x y q", "FIELDS: expected a field z"),
        ("FIELDS x y z rgb", "FIELDS x y z label", "FIELDS: expected a field rgb or intensity"),
        ("FIELDS x y z", "FIELDS x y y", "FIELDS: "),
        ("COUNT 1 1 1 1", "COUNT 1 1 1 0", "DATA: expected 6 numbers for 2 points, found 8 numbers"),
        ("COUNT 1 1 1 1", "COUNT 1 1 1 -1", "COUNT of rgb: expected a whole number"),
        (
            "x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1",
            "x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 2 1",
            "COUNT of y",
        ),
        ("DATA ascii", "DATA binary_packed", "DATA: expected ascii, binary or binary_compressed, found binary_packed"),
        ("-0.25", "nan", "x of point 1: expected a finite number, found nan"),
        ("-0.25", "many", "DATA: expected numbers"),
        ("-0.25 ", "", "DATA: expected 8 numbers for 2 points, found 7 numbers"),
        ("VERSION", "Version", "header: expected one of VERSION"),
        ("DATA ascii", "", "header"),
    ],
)
def test_a_broken_file_gets_one_line_that_names_the_field(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = ASCII.format(n=2, rgb=0, kind="U")
    assert old in text
    (tmp_path / "broken.pcd").write_text(text.replace(old, new))
    with pytest.raises(DataError) as caught:
        read_pcd(tmp_path / "broken.pcd")
    assert str(caught.value).startswith(f"{tmp_path / 'broken.pcd'}: ") and message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_without_the_newer_fields_reads_as_before(written: Path) -> None:
    sweep, table = toy_frame(0).agents[0].sweep, read_table(written)
    older = table.dtype.names[:-2]
    assert table.dtype.names == (*older, "material", "cosine")
    written.write_bytes(encode_table(np.array(table[list(older)].tolist(), [(n, table.dtype[n]) for n in older])))
    back = read_pcd(written)
    assert (back.material == UNKNOWN_MATERIAL).all() and not back.cosine.any()
    for name in POINT_FIELDS[:-2]:
        assert np.array_equal(getattr(back, name), getattr(sweep, name)), name


def test_infinite_intensity_and_a_missing_file_are_refused(written: Path) -> None:
    sweep = read_pcd(written)
    bad = sweep.intensity.copy()
    bad[3] = np.inf
    written.write_bytes(b"".join(encode_pcd(replace(sweep, intensity=bad))))
    with pytest.raises(DataError, match="intensity of point 3"):
        read_pcd(written)
    with pytest.raises(DataError, match="file not found"):
        read_pcd(written.with_name("nothing.pcd"))


def literals(data: bytes) -> bytes:
    """The plainest LZF: runs of up to 32 bytes as they are."""
    return b"".join(bytes([len(data[i : i + 32]) - 1]) + data[i : i + 32] for i in range(0, len(data), 32))


def compressed(table: np.ndarray, packed: bytes | None = None, size: int | None = None) -> bytes:
    """A PCD file as PCL compresses it: the fields one after another, each of all points."""
    columns = b"".join(table[name].tobytes() for name in table.dtype.names)
    packed = literals(columns) if packed is None else packed
    head = encode_table(table[:0]).replace(b"WIDTH 0", b"WIDTH %d" % len(table))
    head = head.replace(b"POINTS 0", b"POINTS %d" % len(table)).replace(b"DATA binary", b"DATA binary_compressed")
    return head + np.array([len(packed), len(columns) if size is None else size], "<u4").tobytes() + packed


def test_a_compressed_file_reads_as_the_plain_one(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    table = np.zeros(300, [("x", "<f4"), ("y", "<f8"), ("z", "<f4"), ("intensity", "u1"), ("ring", "<u2")])
    for name in ("x", "y", "z"):
        table[name] = rng.normal(size=300)
    table["intensity"], table["ring"] = rng.integers(0, 256, 300), rng.integers(0, 64, 300)
    (tmp_path / "plain.pcd").write_bytes(encode_table(table))
    (tmp_path / "packed.pcd").write_bytes(compressed(table))
    assert np.array_equal(read_table(tmp_path / "packed.pcd"), read_table(tmp_path / "plain.pcd"))
    assert np.array_equal(read_pcd(tmp_path / "packed.pcd").points, read_pcd(tmp_path / "plain.pcd").points)


def test_lzf_repeats_earlier_bytes_even_those_it_is_writing() -> None:
    # "ab", then 5 bytes from 2 back (overlapping), then 7 + 2 + 3 = 12 bytes from 7 back, then a literal.
    packed = bytes([1]) + b"ab" + bytes([(5 - 2) << 5, 1]) + bytes([7 << 5, 3, 6]) + bytes([0]) + b"!"
    text = b"ab" + b"ababa"
    assert decompress(packed, 20) == text + (text * 2)[:12] + b"!"
    far = literals(bytes(range(256)) * 2) + bytes([(3 - 2) << 5 | 511 >> 8, 511 & 255])
    assert decompress(far, 515)[-3:] == bytes([0, 1, 2])


@pytest.mark.parametrize(
    ("packed", "size", "message"),
    [
        (b"\x1fshort", None, "DATA: expected 16 bytes after decompression, found damaged data"),
        (b"\x20\x05", None, "found damaged data"),
        (literals(bytes(8)), None, "DATA: expected 16 bytes after decompression, found 8"),
        (literals(bytes(40)), None, "found damaged data"),
        (None, 17, "DATA: expected 16 bytes for 1 points, found 17 bytes"),
    ],
)
def test_a_damaged_compressed_file_gets_one_line(
    tmp_path: Path, packed: bytes | None, size: int | None, message: str
) -> None:
    table = np.zeros(1, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
    (tmp_path / "a.pcd").write_bytes(compressed(table, packed, size))
    with pytest.raises(DataError) as caught:
        read_pcd(tmp_path / "a.pcd")
    assert message in str(caught.value) and "a.pcd" in str(caught.value) and "\n" not in str(caught.value)
    (tmp_path / "a.pcd").write_bytes(compressed(table)[:-3])
    with pytest.raises(DataError, match="DATA: expected 17 compressed bytes, found 14 bytes"):
        read_pcd(tmp_path / "a.pcd")


def test_a_real_sensors_file_is_not_mirrored_and_marks_lost_beams_by_nan(tmp_path: Path) -> None:
    table = np.zeros(3, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
    table["y"], table["intensity"] = [4.0, np.nan, -2.0], [255.0, 7.0, 64.0]
    (tmp_path / "a.pcd").write_bytes(encode_table(table))
    sweep = read_pcd(tmp_path / "a.pcd", mirrored=False, full_scale=256.0)
    assert sweep.points[:, 1].tolist() == [4.0, -2.0]
    assert sweep.intensity.tolist() == [255 / 256, 0.25]


def test_a_sweep_survives_the_form_of_real_sensors_bit_for_bit(tmp_path: Path) -> None:
    sweep = toy_frame(0).agents[0].sweep
    (tmp_path / "a.pcd").write_bytes(b"".join(encode_sensor_pcd(sweep)))
    back = read_pcd(tmp_path / "a.pcd", mirrored=False, full_scale=256.0)
    for name in POINT_FIELDS:
        assert np.array_equal(getattr(back, name), getattr(sweep, name)), name
    table = read_table(tmp_path / "a.pcd")
    assert table.dtype.names[:4] == ("x", "y", "z", "intensity") and table["intensity"].max() > 200.0


def test_records_hold_every_column_to_the_bit() -> None:
    sweep = toy_frame(0).agents[0].sweep
    table = np.zeros(len(sweep), pcd._RECORD)
    table["x"], table["y"], table["z"] = sweep.points[:, 0], -sweep.points[:, 1], sweep.points[:, 2]
    for field, column in pcd.COLUMNS.items():
        table[field] = getattr(sweep, column)
    table["rgb"] = np.round(sweep.intensity * 255.0).astype(np.uint32) << 16
    assert b"".join(encode_pcd(sweep)) == encode_table(table)
