"""Tables on disk: computed once, whole or absent, rebuilt when damaged."""

import logging
from pathlib import Path

import numpy as np
import pytest

from sensors.corruptions.physics.table_cache import cached_tables

TABLES = {"a": np.arange(5.0), "b": np.eye(3)}
SHAPES = {"a": (5,), "b": (3, 3)}


class Computing:
    """Makes the tables and counts how often."""

    def __init__(self) -> None:
        self.times = 0

    def __call__(self) -> dict[str, np.ndarray]:
        self.times += 1
        return TABLES


def is_whole(tables: dict[str, np.ndarray]) -> bool:
    return tables.keys() == TABLES.keys() and all((tables[name] == TABLES[name]).all() for name in TABLES)


def test_a_table_is_computed_once(tmp_path: Path) -> None:
    compute = Computing()
    assert all(is_whole(cached_tables("t", SHAPES, compute, tmp_path / "new")) for _ in range(3))
    assert compute.times == 1
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["t.npz"]


@pytest.mark.parametrize("damage", ["empty", "cut", "flipped", "text", "pickle", "others", "nan"])
def test_a_damaged_file_is_made_anew(tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture) -> None:
    compute = Computing()
    cached_tables("t", SHAPES, compute, tmp_path)
    path = tmp_path / "t.npz"
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[150] ^= 0xFF
    written = {
        "pickle": {"a": np.array([{}], object), "b": np.eye(3)},
        "others": {"a": np.arange(4.0), "b": np.eye(3)},
        "nan": {"a": np.arange(5.0), "b": np.full((3, 3), np.nan)},
    }
    if damage in written:
        np.savez(path, **written[damage])
    else:
        path.write_bytes({"empty": b"", "cut": whole[:-40], "flipped": bytes(flipped), "text": b"hello"}[damage])
    with caplog.at_level(logging.WARNING):
        assert is_whole(cached_tables("t", SHAPES, compute, tmp_path))
    assert compute.times == 2 and "damaged" in caplog.text
    assert is_whole(cached_tables("t", SHAPES, compute, tmp_path)) and compute.times == 2


def test_without_a_writable_cache_tables_are_computed(tmp_path: Path) -> None:
    compute = Computing()
    (tmp_path / "file").write_text("in the way")
    assert is_whole(cached_tables("t", SHAPES, compute, tmp_path / "file"))
    assert is_whole(cached_tables("t", SHAPES, compute, tmp_path / "file"))
    assert compute.times == 2


def test_the_environment_sets_the_cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DSRC_CACHE", str(tmp_path))
    cached_tables("t", SHAPES, Computing())
    assert (tmp_path / "tables" / "t.npz").is_file()
