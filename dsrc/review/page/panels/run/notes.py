"""Note: text and tags of the selected error, saved beside the run."""

import threading
from typing import Any

from dsrc.review.errors.notes import Note, NoteChanged, error_key, former_key
from dsrc.review.errors.report import shown_error
from dsrc.review.page.page import Shown
from dsrc.review.page.panels.panel import Panel, set_fields
from sim.errors import DataError, SettingsError

_NO_KEYS = ("", "")


class NotesPanel(Panel):
    """Folder under the card, shown while an error is selected."""

    title = "Note"

    def build(self) -> None:
        """Add the fields, hidden."""
        # Drawing and saving are done by different threads; the fields are of these keys, and were this note.
        self._lock = threading.Lock()
        self._keys, self._note = _NO_KEYS, Note()
        self._drafts: dict[tuple[str, str], tuple[Note, str, str]] = {}
        self.folder.visible = False
        self.text: Any = self._page.gui.add_text("Note", "", multiline=True)
        self.tags: Any = self._page.gui.add_text("Tags", "", hint="words between blanks")
        self.save = self._page.gui.add_button("Save note")
        self.save.on_click(lambda _: self._save())

    def show(self, shown: Shown) -> None:
        """Write the note on the selected error; what is being written stays, also while another error is selected."""
        keys, notes = self._selected(shown), self._page.notes
        if notes is None:
            return
        with self._lock:
            if keys != self._keys:
                if self._edited():
                    self._drafts[self._keys] = self._note, self.text.value, self.tags.value
                self._keys = keys
                self.folder.visible = keys != _NO_KEYS
                self._write(notes.get(*keys) or Note())
                if keys in self._drafts:
                    self._note, self.text.value, self.tags.value = self._drafts.pop(keys)
            elif not self._edited():
                self._write(notes.get(*keys) or Note())

    def _edited(self) -> bool:
        """Whether the fields are no longer as they were written."""
        return (self.text.value, self.tags.value) != _fields(self._note)

    def _write(self, note: Note) -> None:
        self._note = note
        for field, value in zip((self.text, self.tags), _fields(note), strict=True):
            set_fields(field, value=value)

    def _selected(self, shown: Shown) -> tuple[str, str]:
        """Key and former key of the selected error, "" without one."""
        state = shown.state
        if self._page.notes is None or not state.selects or not shown.judged:
            return _NO_KEYS
        try:
            errors = self._page.report(state).errors
        except SettingsError:
            return _NO_KEYS
        row, drive = shown_error(errors, state), shown.model.title(state.drive)
        return (error_key(drive, errors, row), former_key(drive, errors, row)) if row >= 0 else _NO_KEYS

    def _save(self) -> None:
        with self._lock:
            told = self._saved()
        self._page.tell(told)

    def _saved(self) -> str:
        """Save the fields and return why that cannot be, "" where they are saved."""
        (key, former), notes = self._keys, self._page.notes
        if notes is None or not key:
            return ""
        text, tags = self.text.value.strip(), self.tags.value.split()
        try:
            self._write(notes.put(key, text, tags, former=former, seen=self._note))
        except NoteChanged as error:
            # Now that the other text was told, the next try is to replace it.
            self._note = Note(text=(notes.get(key, former) or Note()).text, tags=self._note.tags)
            return f"The note is not saved: {error}. Saved again, this one replaces it."
        except (DataError, OSError) as error:
            return f"The note is not saved: {error}"
        return ""


def _fields(note: Note) -> tuple[str, str]:
    return note.text, " ".join(note.tags)
