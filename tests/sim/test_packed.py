"""Packed integer files: what was packed comes back, and a file that lies about its size costs no memory."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from sim import packed as packed_files
from sim.errors import DataError
from sim.packed import differences, packed, read_arrays, sums, unpacked, write_arrays


def test_integers_of_any_size_come_back() -> None:
    values = np.array([0, -1, 1, 255, -256, 2**40, -(2**62)])
    assert unpacked(packed(values)).tolist() == values.tolist()


def test_differences_are_those_within_a_run_and_sums_undo_them() -> None:
    values, length = np.array([5, 7, 4, 100, 103]), np.array([3, 2])
    assert differences(values, length).tolist() == [0, 2, -3, 0, 3]
    kept = differences(values, length, keep=True)
    assert kept.tolist() == [5, 2, -3, 100, 3]
    assert sums(kept, length).tolist() == values.tolist()


def header_of(shape: tuple[int, ...]) -> bytes:
    """Return a .npy that claims a shape and holds three numbers."""
    content = io.BytesIO()
    np.lib.format.write_array_header_1_0(content, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return content.getvalue() + np.zeros(3).tobytes()


def test_a_header_that_asks_for_more_than_the_file_holds_is_refused_before_memory_is_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "huge.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("row.npy", header_of((10**13,)))
    with pytest.raises(DataError, match=r"row\.npy: an array of") as caught:
        read_arrays(path, "log")
    assert "\n" not in str(caught.value)


def test_an_archive_that_unpacks_to_more_than_the_limit_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "zeros.npz"
    write_arrays(path, {"a": np.zeros(1000), "b": np.zeros(1000)})
    assert set(read_arrays(path, "log")) == {"a", "b"}
    monkeypatch.setattr(packed_files, "LARGEST_BYTES", 10_000)
    with pytest.raises(DataError, match="more than 10000 bytes"):
        read_arrays(path, "log")


def test_a_single_array_is_no_archive(tmp_path: Path) -> None:
    np.save(tmp_path / "one.npy", np.zeros(3))
    with pytest.raises(DataError, match="not a zip file"):
        read_arrays(tmp_path / "one.npy", "log")


def test_an_empty_array_that_stands_for_gigabytes_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "empty.npz", "w") as archive:
        archive.writestr("planes.npy", header_of((0, 10**9)))
    with pytest.raises(DataError, match=r"planes\.npy: an array of"):
        read_arrays(tmp_path / "empty.npz", "world")
    write_arrays(tmp_path / "small.npz", {"planes": np.zeros((0, 300), np.uint8)})
    assert read_arrays(tmp_path / "small.npz", "world")["planes"].shape == (0, 300)


def test_planes_that_unpack_to_more_than_an_archive_may_hold_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_arrays(tmp_path / "a.npz", {"x": np.zeros((1, 1000), np.uint8), "y": np.zeros((1, 1000), np.uint8)})
    monkeypatch.setattr(packed_files, "LARGEST_BYTES", 16_000)
    assert read_arrays(tmp_path / "a.npz", "world")["x"].shape == (1, 1000)
    monkeypatch.setattr(packed_files, "LARGEST_BYTES", 15_999)
    with pytest.raises(DataError, match="more than 15999 bytes when unpacked"):
        read_arrays(tmp_path / "a.npz", "world")
