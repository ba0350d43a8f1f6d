"""What is known of a source is remembered for every process, and nothing that its bytes do not say."""

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from sim.kept import read_sources
from sim.kept.read_sources import Imported, read_source, remember
from sim.kept.source_hash import source_hash

CODE = b"""
from ..near import one, two
if TYPE_CHECKING:
    import never
def f():
    import sim.far
    import_module("sim.named")
"""


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv("DSRC_CACHE", str(tmp_path))
    monkeypatch.setattr(read_sources, "_used", {})
    forget()
    yield tmp_path
    forget()


def forget() -> None:
    """Forget as a new process does."""
    for one in (read_sources._path, read_sources._remembered, read_source):
        one.cache_clear()
    read_sources._used.clear()


def file_of(folder: Path) -> Path:
    (path,) = (folder / "code").iterdir()
    return path


def test_imports_are_those_at_any_depth_but_of_type_checkers() -> None:
    known = read_source(CODE)
    assert known.sha256 == source_hash(CODE)
    assert set(known.imports) == {Imported(2, "near", ("one", "two")), Imported(0, "sim.far"), Imported(0, "sim.named")}
    assert read_source(b"no Python (").imports == ()


def test_a_later_process_parses_only_what_is_new(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = read_source(CODE)
    remember()
    parsed: list[bytes] = []
    parse = ast.parse
    monkeypatch.setattr(read_sources.ast, "parse", lambda source: (parsed.append(source), parse(source))[1])
    forget()
    assert read_source(CODE) == before and not parsed
    changed = read_source(CODE + b"x = 1\n")
    assert parsed == [CODE + b"x = 1\n"] and changed.sha256 != before.sha256 and changed.imports == before.imports
    remember()
    forget()
    assert (read_source(CODE), read_source(CODE + b"x = 1\n")) == (before, changed) and len(parsed) == 1


@pytest.mark.parametrize("damage", [b"", b"{", b"[]", b'{"a": 1}'])
def test_a_damaged_file_is_made_again(cache: Path, damage: bytes) -> None:
    before = read_source(CODE)
    remember()
    whole = file_of(cache).read_bytes()
    file_of(cache).write_bytes(damage)
    forget()
    assert read_source(CODE) == before
    remember()
    assert file_of(cache).read_bytes() == whole


def test_the_file_does_not_grow_for_ever(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(read_sources, "_MOST", 3)
    sizes: list[Any] = []
    for number in range(5):
        read_source(f"x = {number}".encode())
        remember()
        forget()
        sizes.append(len(read_sources._remembered(read_sources._path())))
    assert sizes == [1, 2, 3, 1, 2]


def test_where_nothing_can_be_written_nothing_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("DSRC_CACHE", str(tmp_path / "file"))
    read_sources._path.cache_clear()
    assert read_source(CODE).imports
    remember()
