"""Reading of files that anyone may have made: bounds before memory is taken, and messages of one short line."""

import os
from pathlib import Path

import numpy as np
import pytest

from dsrc.data.formats.yaml import read_yaml
from sim.errors import DataError, complaint, unreadable
from sim.packed import read_arrays
from sim.reading import LARGEST_TEXT_BYTES, check_regular, parsing, read_text
from tests.fuzz.mutations import alias_bomb


@pytest.mark.skipif(os.name == "nt", reason="pipes and devices of POSIX")
def test_only_regular_files_are_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    for name, found in (("pipe", "a device or a pipe"), ("zero", "a device or a pipe"), (".", "a folder")):
        with pytest.raises(DataError, match=f"YAML file: expected a file, found {found}"):
            check_regular(tmp_path / name, "YAML file")
    for name in ("none", "a\0b", "n" * 300):
        with pytest.raises(DataError) as caught:
            check_regular(tmp_path / name, "YAML file")
        assert "\n" not in str(caught.value) and "\0" not in str(caught.value)


def test_a_limit_is_named_before_the_file_is_read(tmp_path: Path) -> None:
    (tmp_path / "a").touch()
    os.truncate(tmp_path / "a", 1 << 40)  # a hole, which takes no disk
    with pytest.raises(DataError, match=f"at most {LARGEST_TEXT_BYTES} bytes, found {1 << 40} bytes"):
        read_text(tmp_path / "a", "YAML file")


def test_whatever_a_parser_raises_is_one_line_and_a_users_error_stays() -> None:
    for error in (
        MemoryError(),
        RecursionError("deep\ndeeper"),
        OverflowError("x" * 9000),
        KeyError("x"),
        ValueError(""),
    ):
        with pytest.raises(DataError, match=r"^a\.b: not a readable thing: .") as caught, parsing("a.b", "thing"):
            raise error
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 300
    with pytest.raises(DataError, match=r"^mine$"), parsing("a.b", "thing"):
        raise DataError("mine")


@pytest.mark.parametrize(
    ("text", "limit"),
    [
        ("a: " + "[" * 100_000, "nesting: expected at most 64 levels"),
        ("- " * 100_000, "nesting: expected at most 64 levels"),
        (alias_bomb(9, 9), "values: expected at most 2000000 with aliases written out"),
        ("a: &a [*a]", "aliases"),
        ("a: !!bool x", "not a readable YAML file"),
        (f"a: [{'9' * 5000}]", "not a readable YAML file"),
    ],
)
def test_a_small_yaml_that_would_kill_is_refused(tmp_path: Path, text: str, limit: str) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(DataError, match=limit):
        read_yaml(tmp_path / "a.yaml")


def test_an_array_of_text_that_is_none_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", names=np.array(["ok", "\ud800"]))
    with pytest.raises(DataError, match="not a readable log"):
        read_arrays(tmp_path / "a.npz", "log")


def test_a_complaint_is_one_short_line_whatever_was_found() -> None:
    bomb: list = ["x"]
    for _ in range(40):
        bomb = [bomb] * 10  # written out it would fill the disk
    for found in (bomb, 10**5000, "y" * 10**6, "a\nb\tc\x1b[31m", {"a": bomb}, np.zeros(10**6), "\ud800"):
        line = complaint("file", "field", "something", found)
        assert len(line) < 150 and line.isprintable(), line
    assert complaint("f", "a", "b", "c" * 81).endswith("found " + "c" * 77 + "...")
    assert unreadable("f", "x", ValueError()) == "f: not a readable x: ValueError"
