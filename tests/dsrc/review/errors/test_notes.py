"""Notes stay with their errors, on disk at once, and leave as CSV."""

import csv
import io
import json
import subprocess
import sys
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from dsrc.review.errors.filters import FP
from dsrc.review.errors.index import ErrorIndex, ErrorTable
from dsrc.review.errors.judged import JudgedRun
from dsrc.review.errors.notes import Note, NoteBook, NoteChanged, error_key, errors_csv, former_key
from dsrc.review.sources.base import Setup
from sim.errors import DataError
from tests.dsrc.review.errors.runs import draw_run, draw_table


@pytest.fixture
def errors() -> ErrorTable:
    return ErrorIndex([draw_run(0, "A"), draw_run(0, "B", skill=0.5)]).errors(0.3, 0.5)


def test_a_note_is_there_when_the_book_is_opened_again(tmp_path: Path) -> None:
    book = NoteBook(tmp_path)
    book.put("a", "Hidden behind the bus.", ["occlusion", "bus", "occlusion"])
    book.put("b", tags=["label"])
    again = NoteBook(tmp_path / "notes.json")
    assert again.get("a").text == "Hidden behind the bus." and again.get("a").tags == ("occlusion", "bus")
    assert again.tags == ["bus", "label", "occlusion"] and len(again) == 2 and again.get("c") is None
    again.put("a")
    assert len(NoteBook(tmp_path)) == 1 and not list(tmp_path.glob(".*"))


def test_two_books_on_one_file_keep_each_others_notes(tmp_path: Path) -> None:
    first, second = NoteBook(tmp_path), NoteBook(tmp_path)
    first.put("a", "from one")
    second.put("b", "from two")
    assert (second.get("a").text, NoteBook(tmp_path).tags, len(NoteBook(tmp_path))) == ("from one", [], 2)
    first.put("a")
    assert first.get("b").text == "from two" and len(NoteBook(tmp_path)) == 1
    (tmp_path / "notes.json").write_text("{")
    with pytest.raises(DataError, match="content: expected notes on errors"):
        first.put("a", "again")
    assert (tmp_path / "notes.json").read_text() == "{"


def test_no_note_is_lost_while_processes_write_at_once(tmp_path: Path) -> None:
    script = "import sys; from pathlib import Path; from dsrc.review.errors.notes import NoteBook\n"
    script += "book = NoteBook(Path(sys.argv[1]))\nfor i in range(20): book.put(f'{sys.argv[2]} {i}', 'text')"
    commands = [[sys.executable, "-c", script, str(tmp_path), name] for name in "abc"]
    assert [process.wait(60) for process in [subprocess.Popen(command) for command in commands]] == [0, 0, 0]
    assert len(NoteBook(tmp_path)) == 60


def test_what_others_have_changed_since_a_note_was_seen_stays(tmp_path: Path) -> None:
    book = NoteBook(tmp_path)
    seen = book.put("a", "old", ["far", "bus"])
    book.put("a", "old", ["far", "seen"])
    # Another text, one tag taken away and one added by each.
    assert book.put("a", "new", ["bus", "late"], seen=seen) == Note(text="new", tags=("seen", "late"))
    assert book.put("a", "old", ["far", "bus", "dark"], seen=seen) == Note(text="new", tags=("seen", "late", "dark"))
    with pytest.raises(NoteChanged, match="note: expected 'old' as shown, found 'new'; another page"):
        book.put("a", "mine", seen=seen)
    assert book.get("a").text == "new"
    assert book.put("a", "", seen=book.get("a")) == Note() and len(book) == 0


def test_damaged_books_and_long_notes_are_one_line(tmp_path: Path) -> None:
    path = tmp_path / "notes.json"
    for content, message in (
        ("{", "content: expected notes on errors"),
        ('{"notes": {"a": {"text": 3}}}', "content: expected notes on errors"),
        (json.dumps({"version": 9, "notes": {}}), "version: expected 1, found 9"),
    ):
        path.write_text(content)
        with pytest.raises(DataError, match=message):
            NoteBook(path)
    book = NoteBook(tmp_path / "new.json")
    for wrong in ({"text": "x" * 5000}, {"tags": [""]}):
        with pytest.raises(DataError, match=r"new\.json: note"):
            book.put("a", **wrong)
    assert len(book) == 0 and not book.path.exists()


def test_a_note_that_cannot_be_saved_leaves_the_book_as_it_was(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    book = NoteBook(tmp_path / "file/notes.json")
    with pytest.raises(OSError):
        book.put("a", "text")
    assert book.get("a") is None


def test_keys_are_those_of_the_errors_whatever_the_threshold(errors: ErrorTable) -> None:
    keys = [error_key("drive", errors, row) for row in range(len(errors))]
    assert len(set(keys)) == len(keys)
    stricter = ErrorIndex([draw_run(0, "A"), draw_run(0, "B", skill=0.5)]).errors(0.6, 0.5)
    false = [error_key("drive", stricter, row) for row in np.flatnonzero(stricter.kind == FP)]
    assert set(false) <= set(keys) and false


def test_each_ego_has_notes_of_its_own_alone_and_with_its_helpers(errors: ErrorTable) -> None:
    def other(ego_id: int | None, cooperative: bool) -> ErrorTable:
        table = replace(draw_table(0), ego_id=np.full(6, 7 if ego_id is None else ego_id))
        run = JudgedRun("A", Setup(ego_id=ego_id, cooperative=cooperative), table)
        return ErrorIndex([run]).errors(0.3, 0.5)

    setups = [(None, True), (None, False), (8, True), (8, False)]
    keys = [{error_key("drive", one, row) for row in range(len(one))} for one in (other(*setup) for setup in setups)]
    assert all(not a & b for a, b in combinations(keys, 2))
    # The first vehicle is the same ego, whether or not it is named.
    named = other(7, True)
    assert {error_key("drive", named, row) for row in range(len(named))} == keys[0]


def test_notes_of_files_that_do_not_say_who_detects_are_those_of_the_first_vehicle(
    errors: ErrorTable, tmp_path: Path
) -> None:
    key, former = error_key("drive", errors, 0), former_key("drive", errors, 0)
    assert " / ego 7 / " in key and former == key.replace(" / ego 7 / ", " / ")
    book = NoteBook(tmp_path)
    book.put(former, "of an earlier version")
    assert book.get(key, former).text == "of an earlier version"
    assert errors_csv("drive", errors, book).splitlines()[1].endswith("of an earlier version")
    book.put(key, "of an earlier version", ["new"], former=former, seen=book.get(key, former))
    assert list(json.loads(book.path.read_text())["notes"]) == [key]
    for setup in (Setup(ego_id=8), Setup(cooperative=False)):
        other = ErrorIndex([JudgedRun("A", setup, draw_table(0))]).errors(0.3, 0.5)
        assert former_key("drive", other, 0) == ""


def test_errors_leave_as_csv_with_their_notes(errors: ErrorTable, tmp_path: Path) -> None:
    book = NoteBook(tmp_path)
    book.put(error_key("drive", errors, 3), 'a "quoted",\nnote', ["x", "y"])
    lines = list(csv.DictReader(io.StringIO(errors_csv("drive", errors, book))))
    assert len(lines) == len(errors)
    assert (lines[3]["note"], lines[3]["tags"]) == ('a "quoted",\nnote', "x y")
    assert sum(bool(line["note"]) for line in lines) == 1
    for row, line in enumerate(lines):
        assert int(line["frame"]) == errors.frame[row] and line["method"] in "AB" and line["condition"] == "clean"
        assert float(line["distance_m"]) == pytest.approx(errors.distance_m[row], abs=0.01)
        assert (line["score"] == "") == bool(np.isnan(errors.score[row]))
        assert (line["class"] == "") == bool(errors.label[row] < 0)


def test_views_are_kept_by_name_beside_the_notes(tmp_path: Path) -> None:
    book, other = NoteBook(tmp_path), NoteBook(tmp_path)
    book.put_view("the worst", "frame=3&object=1")
    other.put("key", "a note")
    other.put_view("snow", "corruption=snow")
    assert NoteBook(tmp_path).views == {"the worst": "frame=3&object=1", "snow": "corruption=snow"}
    book.put_view("snow", "corruption=snow&severity=5")
    book.put_view("the worst", "")
    again = NoteBook(tmp_path)
    assert again.views == {"snow": "corruption=snow&severity=5"} and again.get("key").text == "a note"
    with pytest.raises(DataError, match="views: expected short names"):
        book.put_view("x" * 61, "frame=1")
    assert NoteBook(tmp_path).views == again.views
