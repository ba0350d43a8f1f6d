"""Atomic writes: a file is old or new, never half."""

import os
from pathlib import Path

import pytest

from sim.files import file_sha256, remove_leftovers, replacing, write_file


def test_text_and_bytes_are_written_in_a_new_folder(tmp_path: Path):
    write_file(tmp_path / "new/a", "grün")
    write_file(tmp_path / "new/b", b"\0")
    assert (tmp_path / "new/a").read_bytes() == "grün".encode() and (tmp_path / "new/b").read_bytes() == b"\0"
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["a", "b"]
    assert file_sha256(tmp_path / "new/b").startswith("6e340b9c")


def test_a_failure_leaves_the_old_file_and_nothing_beside_it(tmp_path: Path):
    write_file(tmp_path / "a", "old")
    with pytest.raises(IsADirectoryError), replacing(tmp_path / "a") as temporary:
        (temporary.write_text("half"), tmp_path.read_text())
    assert [path.name for path in tmp_path.iterdir()] == ["a"] and (tmp_path / "a").read_text() == "old"


def test_two_writers_at_once_do_not_mix(tmp_path: Path):
    with replacing(tmp_path / "a") as first:
        first.write_text("first")
        with replacing(tmp_path / "a") as second:
            second.write_text("second")
        assert (tmp_path / "a").read_text() == "second"
    assert (tmp_path / "a").read_text() == "first"


def test_an_error_names_the_file(tmp_path: Path):
    (tmp_path / "a").mkdir()
    with pytest.raises(OSError) as caught:  # a folder cannot be replaced by a file
        write_file(tmp_path / "a", "")
    assert caught.value.filename == str(tmp_path / "a") and not list(tmp_path.glob(".*"))


@pytest.mark.skipif(os.name == "nt", reason="modes of POSIX")
def test_the_mode_of_a_file_is_kept_and_a_new_one_has_the_usual(tmp_path: Path):
    (tmp_path / "plain").touch()
    write_file(tmp_path / "a", "new")
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "plain").stat().st_mode
    (tmp_path / "a").chmod(0o600)
    write_file(tmp_path / "a", "newer")
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o600


def test_what_a_killed_process_left_is_removed(tmp_path: Path):
    (tmp_path / "1000").mkdir()
    (tmp_path / "1000/000000.pcd").touch()
    (tmp_path / "1000/.000001.pcd.0123abcd.tmp").touch()
    remove_leftovers(tmp_path)
    assert [path.name for path in (tmp_path / "1000").iterdir()] == ["000000.pcd"]
