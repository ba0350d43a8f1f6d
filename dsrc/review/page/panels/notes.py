"""Note: text and tags of the selected error, saved beside the run."""

from typing import Any

from dsrc.review.errors.notes import Note, error_key
from dsrc.review.errors.report import shown_error
from dsrc.review.page.protocol import Page, Shown
from sim.errors import DataError, SettingsError

_PATIENCE_S = 2.0


class NotesPanel:
    """Fields under the card, shown while an error is selected."""

    def __init__(self, page: Page) -> None:
        """Build it, hidden."""
        self._page = page
        self._key = ""
        self.folder = page.gui.add_folder("Note", visible=False, expand_by_default=False)
        with self.folder:
            self.text: Any = page.gui.add_text("Note", "", multiline=True)
            self.tags: Any = page.gui.add_text("Tags", "", hint="words between blanks")
            self.save = page.gui.add_button("Save note")
        self.save.on_click(lambda _: self._save())

    def show(self, shown: Shown) -> None:
        """Write the note on the selected error; what is being written stays."""
        key = self._selected(shown)
        if key == self._key:
            return
        self._key = key
        self.folder.visible = bool(key)
        if key and self._page.notes is not None:
            note = self._page.notes.get(key) or Note()
            self.text.value, self.tags.value = note.text, " ".join(note.tags)

    def _selected(self, shown: Shown) -> str:
        """Key of the selected error, "" without one."""
        state = shown.state
        chosen = state.object_id is not None or state.detection is not None
        if self._page.notes is None or not chosen or not shown.model.methods(state.drive):
            return ""
        if not shown.model.labelled(state.drive):
            return ""
        try:
            errors = self._page.report(state, _PATIENCE_S).errors
        except SettingsError:
            return ""
        row = shown_error(errors, state)
        return error_key(shown.model.names[state.drive], errors, row) if row >= 0 else ""

    def _save(self) -> None:
        if self._page.notes is None or not self._key:
            return
        try:
            self._page.notes.put(self._key, self.text.value.strip(), self.tags.value.split())
        except (DataError, OSError) as error:
            self._page.tell(f"The note is not saved: {error}")
            return
        self._page.tell("")
