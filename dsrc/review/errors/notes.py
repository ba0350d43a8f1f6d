"""NoteBook: notes and tags of errors and saved views, a JSON beside the run, and errors with their notes as CSV."""

import os
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from dsrc.review.errors.filters import FP, KINDS, SEERS
from dsrc.review.errors.index import ErrorTable
from dsrc.tables.files import csv_text
from sim.boxes import CLASSES
from sim.errors import DataError, complaint
from sim.files import write_file

try:
    import fcntl
except ImportError:  # Windows has no such locks: there one page at a time keeps the notes of a run
    fcntl = None  # type: ignore[assignment]

FILE = "notes.json"
VERSION = 1
_LARGEST_BYTES = 1 << 26
_Text = Annotated[str, Meta(max_length=4000)]
_Tag = Annotated[str, Meta(min_length=1, max_length=60)]


class Note(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Note on an error.

    Attributes:
        text: what a reviewer wrote.
        tags: words to find it by.
    """

    text: _Text = ""
    tags: tuple[_Tag, ...] = ()


class _Book(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    version: int = VERSION
    notes: dict[str, Note] = {}
    views: dict[_Tag, _Text] = {}


class NoteChanged(DataError):
    """The text of a note is no longer the one that its writer saw."""


class NoteBook:
    """Notes of a run; every change is saved at once, atomically. Threads may share it, and processes the file.

    Attributes:
        path: of the JSON.

    Args:
        path: of the JSON, which need not exist; or a folder, for its `notes.json`.

    Raises:
        DataError: the file is damaged, too large or of another version.
    """

    def __init__(self, path: Path) -> None:
        self.path = path / FILE if path.is_dir() else path
        self._lock = threading.Lock()
        self._book = _read(self.path)

    def __len__(self) -> int:
        return len(self._book.notes)

    @property
    def views(self) -> dict[str, str]:
        """Links of the saved views by their names."""
        return self._book.views

    def put_view(self, name: str, link: str) -> None:
        """Save a view under a name, in place of an earlier one; an empty link removes that.

        Raises:
            DataError: the name is longer than 60 letters, or the file is damaged by now.
            OSError: the file cannot be written.
        """
        with self._lock, _alone(self.path.parent):
            book = _read(self.path)
            views = {known: one for known, one in book.views.items() if known != name} | ({name: link} if link else {})
            self._write(msgspec.structs.replace(book, views=views))

    def get(self, key: str, former: str = "") -> Note | None:
        """Note on an error by its key, see `error_key` and `former_key`; None without one."""
        return self._book.notes.get(key) or self._book.notes.get(former)

    def put(
        self, key: str, text: str = "", tags: Iterable[str] = (), *, former: str = "", seen: Note | None = None
    ) -> Note:
        """Write the note on an error, in place of an earlier one, and return it; without text and tags it is removed.

        Args:
            former: key of the error in earlier files, "" for none; its note is replaced too.
            seen: note that the writer changes: what others have changed since stays; None for whatever is there.

        Raises:
            NoteChanged: others have changed the text since, and so does the writer.
            DataError: the text or a tag is too long, a tag is empty, or the file is damaged by now.
            OSError: the file cannot be written; the note is as before.
        """
        note = Note(text=text, tags=tuple(dict.fromkeys(tags)))
        try:
            msgspec.convert(msgspec.to_builtins(note), Note)
        except msgspec.ValidationError as error:
            raise DataError(complaint(self.path, "note", "a short text and short tags", str(error))) from None
        with self._lock, _alone(self.path.parent):
            self._book = _read(self.path)
            if seen is not None:
                note = self._merged(note, seen, self.get(key, former) or Note())
            changed = {name: one for name, one in self._book.notes.items() if name not in (key, former)}
            if note != Note():
                changed[key] = note
            self._write(msgspec.structs.replace(self._book, notes=changed))
        return note

    def _write(self, book: _Book) -> None:
        try:
            content = msgspec.json.encode(msgspec.convert(msgspec.to_builtins(book), _Book), order="deterministic")
        except msgspec.ValidationError as error:
            raise DataError(complaint(self.path, "views", "short names", str(error))) from None
        write_file(self.path, msgspec.json.format(content, indent=1) + b"\n", edited=True)
        self._book = book

    def _merged(self, note: Note, seen: Note, there: Note) -> Note:
        """Note with what its writer has changed in the one seen, and what others have."""
        text = there.text if note.text == seen.text else note.text
        if there.text not in (seen.text, text):
            hint = "; another page saved it meanwhile"
            raise NoteChanged(complaint(self.path, "note", f"{seen.text!r} as shown", repr(there.text), hint))
        kept = [tag for tag in there.tags if tag in note.tags or tag not in seen.tags]
        return Note(text=text, tags=tuple(dict.fromkeys([*kept, *(tag for tag in note.tags if tag not in seen.tags)])))

    @property
    def tags(self) -> list[str]:
        """All tags, sorted."""
        return sorted({tag for note in self._book.notes.values() for tag in note.tags})


def _read(path: Path) -> _Book:
    """Content of a file, empty where there is none."""
    if not path.is_file():
        return _Book()
    if path.stat().st_size > _LARGEST_BYTES:
        raise DataError(complaint(path, "size", f"at most {_LARGEST_BYTES} bytes", path.stat().st_size))
    try:
        book = msgspec.json.decode(path.read_bytes(), type=_Book)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise DataError(complaint(path, "content", "notes on errors", str(error))) from None
    if book.version != VERSION:
        raise DataError(complaint(path, "version", str(VERSION), book.version))
    return book


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Let no other process write notes in a folder, which is made; some file systems have no locks."""
    folder.mkdir(parents=True, exist_ok=True)
    if fcntl is None:
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def error_key(drive: str, errors: ErrorTable, row: int) -> str:
    """Key of an error, the same whenever the same run is judged again.

    A missed or poor object is known by its id; a false detection by the decimetre where it is.

    Args:
        drive: name of the source, another one for each source of a page.
    """
    alone = "" if errors.setups[errors.method[row]].cooperative else " alone"
    return _key(drive, errors, row, f"ego {errors.ego_id[row]}{alone}")


def former_key(drive: str, errors: ErrorTable, row: int) -> str:
    """Key of an error in files that do not say who detects; "" unless that is the first vehicle with its helpers."""
    setup = errors.setups[errors.method[row]]
    return _key(drive, errors, row) if setup.ego_id is None and setup.cooperative else ""


def _key(drive: str, errors: ErrorTable, row: int, *who: str) -> str:
    method, kind = int(errors.method[row]), int(errors.kind[row])
    if kind == FP or errors.object_id[row] < 0:
        what = "at {:.1f} {:.1f}".format(*(errors.box[row, :2] + 0.0).tolist())
    else:
        what = f"object {errors.object_id[row]}"
    run = (drive, f"frame {errors.frame[row]}", errors.methods[method], errors.conditions[method])
    return " / ".join((*run, *who, KINDS[kind], what))


def errors_csv(drive: str, errors: ErrorTable, notes: NoteBook | None = None) -> str:
    """CSV of errors in their order, with notes and tags.

    Args:
        drive: name of the source, as in the keys of the notes.
    """
    seers = {value: name for name, value in SEERS.items()}
    boxes = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad")
    points = ("points_ego", "points_all", "points_left_ego", "points_left_all")
    head = ("drive", "frame", "method", "condition", "kind", "class", "object_id", "score", "iou", "distance_m")
    names = (*head, *boxes, *points, "seen_by", "loss", "tags", "note")
    records = []
    for row in range(len(errors)):
        keys = error_key(drive, errors, row), former_key(drive, errors, row)
        note = (notes.get(*keys) if notes is not None else None) or Note()
        method, label, score = int(errors.method[row]), int(errors.label[row]), float(errors.score[row])
        values = (
            *(drive, int(errors.frame[row]), errors.methods[method], errors.conditions[method]),
            *(KINDS[errors.kind[row]], "" if label < 0 else CLASSES[label]),
            *("" if errors.object_id[row] < 0 else int(errors.object_id[row]), _shown(score, 4)),
            *(_shown(float(errors.iou[row]), 4), _shown(float(errors.distance_m[row]), 2)),
            *(_shown(value, 3) for value in errors.box[row].tolist()),
            *("" if value < 0 else value for value in errors.points[row].tolist()),
            *(seers.get(int(errors.seen_by[row]), ""), _shown(float(errors.loss[row]), 4)),
            *(" ".join(note.tags), note.text),
        )
        records.append(dict(zip(names, values, strict=True)))
    return csv_text(records, names)


def _shown(value: float, digits: int) -> str:
    return "" if value != value else f"{value:.{digits}f}"
