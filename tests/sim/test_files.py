"""Atomic writes: a file is old or new, never half."""

import io
import os
from pathlib import Path

import matplotlib.image as mpimg
import numpy as np
import pytest

import dsrc.outputs  # noqa: F401 - its files stand for those of any floor
from sim.errors import OutputError
from sim.files import (
    check_apart,
    check_folder,
    file_sha256,
    overwriting,
    remove_leftovers,
    replacing,
    signed_picture,
    write_file,
)


def test_text_and_bytes_are_written_in_a_new_folder(tmp_path: Path) -> None:
    write_file(tmp_path / "new/a", "grün")
    write_file(tmp_path / "new/b", b"\0")
    assert (tmp_path / "new/a").read_bytes() == "grün".encode() and (tmp_path / "new/b").read_bytes() == b"\0"
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["a", "b"]
    assert file_sha256(tmp_path / "new/b").startswith("6e340b9c")


def test_a_failure_leaves_the_old_file_and_nothing_beside_it(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("old")
    with overwriting(), pytest.raises(IsADirectoryError), replacing(tmp_path / "a") as temporary:
        (temporary.write_text("half"), tmp_path.read_text())
    assert [path.name for path in tmp_path.iterdir()] == ["a"] and (tmp_path / "a").read_text() == "old"


def test_two_writers_at_once_do_not_mix(tmp_path: Path) -> None:
    with overwriting(), replacing(tmp_path / "a") as first:
        first.write_text("first")
        with replacing(tmp_path / "a") as second:
            second.write_text("second")
        assert (tmp_path / "a").read_text() == "second"
    assert (tmp_path / "a").read_text() == "first"


def test_an_error_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(OSError) as caught:
        write_file(tmp_path / ("a" * 300), "")
    assert caught.value.filename == str(tmp_path / ("a" * 300)) and not list(tmp_path.glob(".*"))


@pytest.mark.skipif(os.name == "nt", reason="modes of POSIX")
def test_the_mode_of_a_file_is_kept_and_a_new_one_has_the_usual(tmp_path: Path) -> None:
    (tmp_path / "plain").touch()
    write_file(tmp_path / "a", "new")
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "plain").stat().st_mode
    (tmp_path / "a").chmod(0o600)
    with overwriting():
        write_file(tmp_path / "a", "newer")
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o600


def test_what_a_killed_process_left_is_removed(tmp_path: Path) -> None:
    (tmp_path / "1000").mkdir()
    (tmp_path / "1000/000000.pcd").touch()
    (tmp_path / "1000/.000001.pcd.0123abcd.tmp").touch()
    (tmp_path / "1000/notes.tmp").touch()  # the user's
    remove_leftovers(tmp_path)
    assert sorted(path.name for path in (tmp_path / "1000").iterdir()) == ["000000.pcd", "notes.tmp"]


def test_another_programs_file_is_not_replaced(tmp_path: Path) -> None:
    for name in ("notes.md", "a.pt", "results.csv", "picture.png", "page.html"):
        (tmp_path / name).write_bytes(b"mine")
        with pytest.raises(OutputError, match=f"{name}.*found another file.*--force"):
            write_file(tmp_path / name, "new")
        assert (tmp_path / name).read_bytes() == b"mine"
        with overwriting():
            write_file(tmp_path / name, "new")
        assert (tmp_path / name).read_bytes() == b"new"
    assert sorted(tmp_path.glob(".*")) == []


def test_the_name_of_a_cached_result_counts_in_a_cache_only(tmp_path: Path) -> None:
    for name in ("1690000000000000.csv", f"{'0a' * 16}.npz"):
        (tmp_path / name).write_bytes(b"mine")
        with pytest.raises(OutputError, match="found another file"):
            write_file(tmp_path / name, "new")
    (tmp_path / "cells").mkdir()
    (tmp_path / "cells" / f"{'0a' * 16}.npz").write_bytes(b"damaged")
    write_file(tmp_path / "cells" / f"{'0a' * 16}.npz", "new")


def test_a_file_of_another_kind_is_not_replaced_even_if_it_is_ours(tmp_path: Path) -> None:
    detector = b"PK\x03\x04 archive/data.pkl dsrc-detector-1"
    (tmp_path / "settings.json").write_text('{"recipe": 1}')
    write_file(tmp_path / "detector.pt", detector)
    with pytest.raises(OutputError, match=r"detector.pt.*same kind \(web page\).*another kind \(archive\)"):
        write_file(tmp_path / "detector.pt", "<!doctype html>__REVIEW__")
    assert (tmp_path / "detector.pt").read_bytes() == detector
    write_file(tmp_path / "detector.pt", detector + b"2")


def test_files_of_a_folder_with_our_manifest_and_empty_files_are_replaced(tmp_path: Path) -> None:
    (tmp_path / "drive/1000").mkdir(parents=True)
    (tmp_path / "drive/data_protocol.yaml").write_text("testbed:\n  seed: 1\n")
    for name in ("drive/1000/000000.pcd", "drive/SHA256SUMS"):
        for content in ("# .PCD a", "# .PCD b"):
            write_file(tmp_path / name, content)
    (tmp_path / "empty.md").touch()
    write_file(tmp_path / "empty.md", "new")
    (tmp_path / "other").mkdir()
    (tmp_path / "other/data_protocol.yaml").write_text("world:\n  seed: 1\n")  # of OpenCDA
    (tmp_path / "other/000000.pcd").write_text("# .PCD")
    with pytest.raises(OutputError):
        write_file(tmp_path / "other/000000.pcd", "# .PCD")


@pytest.mark.skipif(os.name == "nt", reason="pipes and devices of POSIX")
def test_what_is_no_regular_file_is_never_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "device").symlink_to("/dev/null")
    (tmp_path / "folder").mkdir()
    with overwriting():
        for name in ("pipe", "device", "folder"):
            with pytest.raises(OutputError, match=f"{name}: output: expected a file, or a new name, found a "):
                write_file(tmp_path / name, "new")
    assert (tmp_path / "pipe").is_fifo() and (tmp_path / "device").is_symlink()


def test_an_edited_document_stays_whosever_it_is(tmp_path: Path) -> None:
    (tmp_path / "thesis.md").write_text("mine")
    write_file(tmp_path / "thesis.md", "mine and more", edited=True)
    assert (tmp_path / "thesis.md").read_text() == "mine and more"


def test_an_output_folder_is_new_or_empty_or_ours(tmp_path: Path) -> None:
    check_folder(tmp_path / "new")
    (tmp_path / ".hidden").touch()
    (tmp_path / "cells").mkdir()
    check_folder(tmp_path)
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(OutputError, match=r"a new folder, or one that dsrc wrote, found thesis.tex"):
        check_folder(tmp_path)
    with overwriting():
        check_folder(tmp_path)
    (tmp_path / "results.json").write_text('{"provenance": {}}')
    check_folder(tmp_path)
    with pytest.raises(OutputError, match="a folder, found a file"):
        check_folder(tmp_path / "thesis.tex")


def test_an_output_is_apart_from_its_input(tmp_path: Path) -> None:
    check_apart(tmp_path / "b", tmp_path / "a")
    for inside in ("a", "a/b", "a/../a/b/c"):
        with pytest.raises(OutputError, match="one inside it"):
            check_apart(tmp_path / inside, tmp_path / "a")


def test_a_signed_picture_is_a_picture(tmp_path: Path) -> None:
    blank = io.BytesIO()
    unsigned = {"Software": None}
    mpimg.imsave(blank, np.zeros((2, 3, 3)), format="png", metadata=unsigned)  # type: ignore[arg-type]
    write_file(tmp_path / "a.png", signed_picture(blank.getvalue()))
    assert mpimg.imread(tmp_path / "a.png").shape[:2] == (2, 3)
    write_file(tmp_path / "a.png", signed_picture(blank.getvalue()))
