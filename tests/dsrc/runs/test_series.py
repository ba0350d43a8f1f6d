"""A series makes what is missing under one record, refuses another one, and takes results of other code when asked."""

import json
from pathlib import Path
from typing import Any

import pytest

from dsrc.runs.executors import SERIAL
from dsrc.runs.series import Series, check_same
from dsrc.runs.study import reused
from sim.errors import DataError

MADE: list[int] = []


def square(job: int) -> int:
    if job < 0:
        raise DataError(f"{job}: expected a number of at least 0")
    MADE.append(job)
    return job * job


def squares(folder: Path, **settings: Any) -> Series[int, int]:
    wanted = {"name": "squares", "code": "new", **settings}
    record = folder / "corruption.json"  # a name that marks a folder as ours

    def write(job: int, value: int) -> None:
        (folder / f"{job}.txt").write_text(str(value))

    return Series(
        folder=folder,
        what="list of squares",
        record=record.name,
        settings=wanted,
        stored=lambda place: (
            json.loads(file.read_text())["corruption"] if (file := place / record.name).exists() else None
        ),
        note=lambda first: record.write_text(json.dumps({"corruption": wanted})) and None,
        make=square,
        write=write,
        files=lambda place, job: [place / f"{job}.txt"],
        fresh=lambda place, job: (place / f"{job}.txt").exists(),
        chunk=2,
    )


@pytest.fixture(autouse=True)
def _nothing_made() -> None:
    MADE.clear()


def test_what_is_missing_is_made_and_leftovers_are_removed(tmp_path: Path) -> None:
    told = list[tuple[int, int]]()
    squares(tmp_path).run([1, 2, 3, 4], SERIAL)
    (tmp_path / "3.txt").unlink()
    (tmp_path / ".2.txt.0123abcd.tmp").write_text("ha")
    squares(tmp_path).run([1, 2, 3, 4], SERIAL, lambda *steps: told.append(steps), done=10, total=20)
    assert MADE == [1, 2, 3, 4, 3] and told == [(13, 20), (14, 20)]
    record = squares(tmp_path).record
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1.txt", "2.txt", "3.txt", "4.txt", record]


def test_what_the_first_job_refuses_is_not_noted(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="-1: expected"):
        squares(tmp_path).run([-1, 2], SERIAL)
    assert not [path for path in tmp_path.iterdir() if not path.name.startswith(".")]


def test_other_settings_and_other_code_are_refused_by_name(tmp_path: Path) -> None:
    squares(tmp_path).run([1, 2], SERIAL)
    with pytest.raises(DataError, match=r"json: name: expected 'cubes' as asked for now, found squares; choose"):
        squares(tmp_path, name="cubes").run([1, 2], SERIAL)
    refused = r"code: expected 'newer' as asked for now, found .*, or go on with --reuse and the folder given as --out$"
    with pytest.raises(DataError, match=refused):
        squares(tmp_path, code="newer").run([1, 2], SERIAL)
    with pytest.raises(DataError, match=r"json: name: expected 'cubes'"):
        squares(tmp_path, name="cubes", code="newer").run([1, 2], SERIAL, reuse=[tmp_path])


def test_a_folder_goes_on_with_results_of_other_code(tmp_path: Path) -> None:
    squares(tmp_path, code="old").run([1, 2, 3, 4], SERIAL)
    (tmp_path / "3.txt").unlink()
    MADE.clear()
    squares(tmp_path).run([1, 2, 3, 4], SERIAL, reuse=[tmp_path])
    assert MADE == [1, 3], "the first is made anew, and the record with it"
    assert reused(tmp_path) == {"2.txt": "old", "4.txt": "old"}
    squares(tmp_path).run([1, 2, 3, 4], SERIAL)
    squares(tmp_path).run([1, 2, 3, 4], SERIAL, reuse=[tmp_path])
    assert MADE == [1, 3] and reused(tmp_path) == {"2.txt": "old", "4.txt": "old"}


def test_results_of_other_code_are_taken_from_another_folder(tmp_path: Path) -> None:
    squares(tmp_path / "old", code="old").run([1, 2, 3], SERIAL)
    squares(tmp_path / "new").run([1], SERIAL)
    MADE.clear()
    earlier = [tmp_path / "none", tmp_path / "old"]
    for folder, made in (("new", [4]), ("newer", [4, 1, 4])):
        squares(tmp_path / folder).run([1, 2, 3, 4], SERIAL, reuse=earlier)
        assert MADE == made and reused(tmp_path / folder) == {"2.txt": "old", "3.txt": "old"}
        assert (tmp_path / folder / "3.txt").read_text() == "9"


def test_settings_are_compared_as_a_file_has_them(tmp_path: Path) -> None:
    check_same(tmp_path, {"a": [1, 2], "b": [{"c": 1}]}, {"a": (1, 2), "b": ({"c": 1},)})
    for found in ({"a": [1, 2]}, {"a": [1, 2], "b": [{"c": 2}]}, {"a": [1, 2], "b": [{"c": 1, "d": 1}]}):
        with pytest.raises(DataError, match=r"b\[0\].(c: expected 1 as asked|d: expected no such setting)"):
            check_same(tmp_path, found, {"a": (1, 2), "b": ({"c": 1},)})
