"""Notes stay with their errors, on disk at once, and leave as CSV."""

import csv
import io
import json

import numpy as np
import pytest

from dsrc.review.errors.filters import FP
from dsrc.review.errors.index import ErrorIndex
from dsrc.review.errors.notes import NoteBook, error_key, errors_csv
from sim.errors import DataError
from tests.dsrc.review.errors.runs import draw_run


@pytest.fixture
def errors():
    return ErrorIndex([draw_run(0, "A"), draw_run(0, "B", skill=0.5)]).errors(0.3, 0.5)


def test_a_note_is_there_when_the_book_is_opened_again(tmp_path):
    book = NoteBook(tmp_path)
    book.put("a", "Hidden behind the bus.", ["occlusion", "bus", "occlusion"])
    book.put("b", tags=["label"])
    again = NoteBook(tmp_path / "notes.json")
    assert again.get("a").text == "Hidden behind the bus." and again.get("a").tags == ("occlusion", "bus")
    assert again.tags == ["bus", "label", "occlusion"] and len(again) == 2 and again.get("c") is None
    again.put("a")
    assert len(NoteBook(tmp_path)) == 1 and not list(tmp_path.glob(".*"))


def test_damaged_books_and_long_notes_are_one_line(tmp_path):
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


def test_a_note_that_cannot_be_saved_leaves_the_book_as_it_was(tmp_path):
    (tmp_path / "file").write_text("")
    book = NoteBook(tmp_path / "file/notes.json")
    with pytest.raises(OSError):
        book.put("a", "text")
    assert book.get("a") is None


def test_keys_are_those_of_the_errors_whatever_the_threshold(errors):
    keys = [error_key("drive", errors, row) for row in range(len(errors))]
    assert len(set(keys)) == len(keys)
    stricter = ErrorIndex([draw_run(0, "A"), draw_run(0, "B", skill=0.5)]).errors(0.6, 0.5)
    false = [error_key("drive", stricter, row) for row in np.flatnonzero(stricter.kind == FP)]
    assert set(false) <= set(keys) and false


def test_errors_leave_as_csv_with_their_notes(errors, tmp_path):
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
