import json
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from dsrc.data.formats.opv2v import compact
from dsrc.data.formats.opv2v.compact import encode_compact, read_columns, read_compact
from dsrc.data.formats.pcd import COLUMNS, encode_pcd
from sensors.sweep import POINT_FIELDS, Sweep, make_sweep
from sim.errors import DataError
from tests.dsrc.data.toy import SPEC, toy_frame


def same_bits(a: Sweep, b: Sweep) -> bool:
    columns = [(getattr(a, name), getattr(b, name)) for name in POINT_FIELDS]
    return all(x.dtype == y.dtype and x.shape == y.shape and x.tobytes() == y.tobytes() for x, y in columns)


@pytest.fixture
def sweep() -> Sweep:
    return toy_frame(0).agents[0].sweep


@pytest.fixture
def written(tmp_path: Path, sweep: Sweep) -> Path:
    (tmp_path / "000000.compact").write_bytes(encode_compact(sweep))
    return tmp_path / "000000.compact"


def test_a_sweep_reads_back_bit_for_bit(written: Path, sweep: Sweep) -> None:
    back = read_compact(written, sweep.world_from_lidar, sweep.time_s, sweep.spec)
    assert same_bits(back, sweep)
    assert (back.time_s, back.spec) == (sweep.time_s, SPEC)


def test_an_empty_cloud_reads_back(tmp_path: Path) -> None:
    (tmp_path / "a.compact").write_bytes(encode_compact(make_sweep(np.zeros((0, 3)))))
    assert same_bits(read_compact(tmp_path / "a.compact"), make_sweep(np.zeros((0, 3))))


def random_sweep(seed: int, points: int, firing_columns: int) -> Sweep:
    """Draw a sweep of any bits at all: all kinds of NaN, infinities, subnormal numbers, negative ids."""
    rng = np.random.default_rng(seed)
    sweep = make_sweep(np.zeros((points, 3)))
    drawn: dict[str, Any] = {}
    for name in POINT_FIELDS:
        old = getattr(sweep, name)
        bits = rng.integers(0, 256, old.nbytes, dtype=np.uint8)
        bits[rng.random(old.nbytes) < 0.2] = rng.choice([0, 127, 128, 255])
        drawn[name] = bits.view(old.dtype).reshape(old.shape)
    if firing_columns:
        drawn["column"] = rng.integers(0, firing_columns, points).astype(np.int32)
        drawn["time_offset"] = drawn["time_offset"][drawn["column"] % max(points, 1)]
    return replace(sweep, **drawn)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), st.integers(0, 300), st.integers(0, 40))
def test_any_bits_read_back(tmp_path_factory: pytest.TempPathFactory, seed: int, points: int, columns: int) -> None:
    path = tmp_path_factory.mktemp("any") / "a.compact"
    sweep = random_sweep(seed, points, columns)
    path.write_bytes(encode_compact(sweep))
    back = read_columns(path)
    assert np.stack([back[name] for name in "xyz"], axis=1).tobytes() == sweep.points.tobytes()
    assert all(back[field].tobytes() == getattr(sweep, column).tobytes() for field, column in COLUMNS.items())


def test_any_change_of_the_points_changes_the_start_of_the_file(sweep: Sweep) -> None:
    """Drives without checksums are known by it, see `dsrc.data.checksums.marks_of_change`."""
    darker = sweep.intensity.copy()
    darker[200] *= 0.5
    one, two = encode_compact(sweep), encode_compact(replace(sweep, intensity=darker))
    assert one[:1000] != two[:1000]


def test_times_are_kept_once_per_firing_column(tmp_path: Path) -> None:
    column = np.tile(np.arange(100), 20)
    sweep = make_sweep(np.zeros((2000, 3)), column=column, time_offset=column * 0.001)
    (tmp_path / "a.compact").write_bytes(encode_compact(sweep))
    entry = next(c for c in head_of(tmp_path / "a.compact")["columns"] if c["name"] == "time")
    assert (entry["per"], entry["rows"]) == ("column", 100)
    assert same_bits(read_compact(tmp_path / "a.compact"), sweep)


def test_a_smooth_sweep_takes_a_quarter_of_the_bytes_of_a_pcd() -> None:
    angle = np.tile(np.linspace(0, 2 * np.pi, 1800), 32)
    ring, column = np.repeat(np.arange(32), 1800), np.tile(np.arange(1800), 32)
    far = 20 + 5 * np.sin(3 * angle) + np.random.default_rng(0).normal(0, 0.02, len(angle))
    points = np.stack([far * np.cos(angle), far * np.sin(angle), far * (ring - 20) * 0.01], axis=1)
    sweep = make_sweep(points, ring=ring, column=column, time_offset=column * 5.5e-5, intensity=np.cos(angle) ** 2)
    assert len(encode_compact(sweep)) < 0.25 * len(b"".join(encode_pcd(sweep)))


@pytest.mark.parametrize(("column", "field"), [("points", "x of point 5"), ("intensity", "intensity of point 5")])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_coordinate_or_intensity_that_is_not_finite_is_an_error(
    written: Path, sweep: Sweep, column: str, field: str, value: float
) -> None:
    bad = getattr(sweep, column).copy()
    bad[5] = value
    written.write_bytes(encode_compact(replace(sweep, **{column: bad})))
    with pytest.raises(DataError, match=rf"000000\.compact: {field}: expected a finite number, found {value}"):
        read_compact(written)


def head_of(path: Path) -> dict:
    return json.loads(path.read_bytes().split(b"\n", 2)[1])


def edit(path: Path, change: Callable[[dict], None], body: Callable[[bytes], bytes] = lambda b: b) -> None:
    """Change the header of a file, and its body, whose checksum is put right."""
    mark, head, content = path.read_bytes().split(b"\n", 2)
    header, content = json.loads(head), body(content)
    header["check"] = zlib.crc32(content)
    change(header)
    path.write_bytes(b"\n".join([mark, json.dumps(header).encode(), content]))


def put(column: int, **values: object) -> Callable[[Path], None]:
    return lambda path: edit(path, lambda header: header["columns"][column].update(values))


def swapped_block(block: bytes) -> Callable[[Path], None]:
    """Put another block in the place of the lowest bytes of x."""

    def change(path: Path) -> None:
        size = head_of(path)["columns"][0]["planes"][0]
        planes = [len(block), *head_of(path)["columns"][0]["planes"][1:]]
        edit(path, lambda header: header["columns"][0].update(planes=planes), lambda body: block + body[size:])

    return change


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-50] ^= 1
    path.write_bytes(content)


def other_version(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"cloud 1", b"cloud 2", 1))


def foreign_column(path: Path) -> None:
    entry = {"name": "doppler", "type": "<f4", "per": "point", "rows": 400, "planes": [0, 0, 0, 0]}
    edit(path, lambda header: header["columns"].append(entry))


def many_columns(path: Path) -> None:
    """Point 0 was fired in a column that has no time."""
    sweep = make_sweep(np.zeros((50, 3)), column=np.arange(50), time_offset=np.arange(50))
    path.write_bytes(encode_compact(sweep))
    short = [zstandard.compress(bytes(10)) for _ in range(4)]
    start = sum(sum(c["planes"]) for c in head_of(path)["columns"][:6])
    end = start + sum(head_of(path)["columns"][6]["planes"])
    edit(
        path,
        lambda header: header["columns"][6].update(rows=10, planes=list(map(len, short))),
        lambda body: body[:start] + b"".join(short) + body[end:],
    )


BOMB = zstandard.compress(bytes(1 << 28))
DAMAGE = {
    "cut short": (cut, r"blocks: expected \d+ bytes as in the header, found \d+ bytes"),
    "cut in the header": (
        lambda p: p.write_bytes(p.read_bytes()[:60]),
        "header: expected a line of JSON, found the end",
    ),
    "a flipped bit": (flip, r"check: expected \d+ as in the header, found \d+"),
    "another version": (other_version, "version: expected 1, found 2"),
    "another file": (lambda p: p.write_bytes(b"# .PCD v0.7\n"), "first line: expected dsrc compact cloud 1, found no"),
    "nothing": (lambda p: p.write_bytes(b""), "first line: expected dsrc compact cloud 1, found no compact cloud"),
    "a foreign column": (foreign_column, "columns: expected x y z .* cosine, found a foreign column doppler"),
    "a missing column": (
        lambda p: edit(p, lambda h: h["columns"].pop()),
        "columns: expected x y z .* cosine, found none of cosine",
    ),
    "columns in another order": (lambda p: edit(p, lambda h: h["columns"].reverse()), "columns: expected x y z"),
    "another type": (put(0, type="<f8"), "type of x: expected <f4, found <f8"),
    "too few planes": (put(0, planes=[3]), "planes of x: expected 4 for <f4, found 1"),
    "other rows": (put(4, rows=399), "rows of ring: expected 400 points, found 399"),
    "rows of a column": (put(4, per="column"), "per of ring: expected point, found column"),
    "a foreign per": (put(4, per="ring"), r"columns\[4\]\.per: Invalid enum value .ring."),
    "a foreign key": (lambda p: edit(p, lambda h: h.update(author="me")), "content: .*unknown field .author"),
    "no key points": (lambda p: edit(p, lambda h: h.pop("points")), "points: expected a value, found nothing"),
    "negative sizes": (put(0, planes=[-1, 2, 3, 4]), r"columns\[0\]\.planes\[.*\]: "),
    "too many points": (lambda p: edit(p, lambda h: h.update(points=1 << 40)), "points"),
    "no JSON": (lambda p: p.write_bytes(b"dsrc compact cloud 1\n{\n"), "not a readable JSON file"),
    "no block of zstd": (swapped_block(b"junk and more junk"), "block of x: expected a block of zstd"),
    "two blocks in one": (swapped_block(2 * zstandard.compress(bytes(400))), "block of x: expected a block of zstd"),
    "a block cut short": (swapped_block(zstandard.compress(bytes(400))[:-2]), "block of x: expected a block of zstd"),
    "a block of gigabytes": (swapped_block(BOMB), "block of x: expected 400 bytes, found 268435456"),
    "an unknown size": (
        swapped_block(zstandard.ZstdCompressor(write_content_size=False).compress(bytes(400))),
        "block of x: expected 400 bytes, found an unknown number",
    ),
    "a column without time": (many_columns, "column: expected numbers from 0 to 9, found 0 to 49"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_file_gets_one_line_that_names_file_field_expected_and_found(written: Path, name: str) -> None:
    damage, message = DAMAGE[name]
    damage(written)
    with pytest.raises(DataError, match=rf"000000\.compact: {message}") as caught:
        read_compact(written)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"a\.compact: file not found; expected a compact cloud"):
        read_compact(tmp_path / "a.compact")


def test_more_points_than_a_reader_takes_are_not_written(sweep: Sweep, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compact, "MOST_POINTS", 399)
    with pytest.raises(DataError, match="points: expected at most 399 in a compact cloud, found 400"):
        encode_compact(sweep)
