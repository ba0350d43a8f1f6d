"""Document with results: sections between markers, and their files in a folder beside the document."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from dsrc.tables.table import Table
from sim.errors import DataError, complaint
from sim.files import check_output, overwriting, write_file
from sim.reading import read_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True)
class Section:
    """Section of a document: text, a picture, or both.

    Attributes:
        name: of its markers in the document.
        text: Markdown.
        picture: file of the picture; "" for none.
        about: caption of the picture; of text the title that it gets in a document without a place for it, "" for none.
        tables: files of the text's numbers.
        whole: the one of them that the text sums up; "" if it is all in the text.
    """

    name: str
    text: str = ""
    picture: str = ""
    about: str = ""
    tables: tuple[str, ...] = ()
    whole: str = ""

    @property
    def files(self) -> tuple[str, ...]:
        """Files of the section."""
        return (*self.tables, self.picture) if self.picture else self.tables

    def below(self, folder: str) -> "Section":
        """Section with its name and files in a folder."""
        picture = f"{folder}/{self.picture}" if self.picture else ""
        tables = tuple(f"{folder}/{table}" for table in self.tables)
        whole = f"{folder}/{self.whole}" if self.whole else ""
        return replace(self, name=f"{folder}/{self.name}", picture=picture, tables=tables, whole=whole)

    def markdown(self, files: Path) -> str:
        """Text with a link to the whole table and the picture, whose paths are below the folder `files`."""
        whole = f"\n[The whole table]({(files / self.whole).as_posix()})\n" if self.whole else ""
        picture = f"\n![{self.about}]({(files / self.picture).as_posix()})\n" if self.picture else ""
        return f"{self.text}{whole}{picture}"


class SectionWriter:
    """Writer of tables and figures into a folder; keeps their sections."""

    def __init__(self, folder: Path, made_by: Mapping[str, object]) -> None:
        self.sections: list[Section] = []
        self._folder, self._made_by = folder, made_by

    def table(self, table: Table, figure: "Figure | None" = None, suffix: str = "", below: str = "") -> None:
        """Write a table as Markdown and CSV, and its figure.

        Args:
            table: its name begins the names of the files.
            below: Markdown that the section has below the table.
        """
        name, text = f"{table.name}{suffix}", table.markdown()
        files = {f"{name}.md": text, f"{name}.csv": table.csv()}
        self.section(name, f"{text}{below}", files, figure, table.title)

    def figure(self, name: str, figure: "Figure", about: str) -> None:
        """Write a figure alone, with its caption."""
        self.section(name, figure=figure, about=about)

    def section(
        self,
        name: str,
        text: str = "",
        files: Mapping[str, str] | None = None,
        figure: "Figure | None" = None,
        about: str = "",
        whole: str = "",
    ) -> None:
        """Write the files of a section, by name, and its figure; see `Section`."""
        from dsrc.tables.figure import write_figure

        for file, content in (files or {}).items():
            write_file(self._folder / file, content)
        picture = "" if figure is None else f"{name}.png"
        if figure is not None:
            write_figure(self._folder / picture, figure, self._made_by)
        self.sections.append(Section(name, text, picture, about if picture else "", tuple(files or ()), whole))


def slug(name: str) -> str:
    """Name in paths: lower case, words joined by hyphens."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-") or "dataset"


def publish(
    sections: Sequence[Section],
    out: Path,
    document: Path,
    name: str,
    results: Sequence[str] = (),
    absent: Sequence[str] = (),
) -> Path:
    """Write sections between their markers in a document, and their files beside it in a folder `name`.

    A section `x/y` goes between the lines `<!-- begin NAME/x/y -->` and `<!-- end NAME/x/y -->`. A document with such
    lines of this name gets the sections that it has a place for, any other all of them at its end. The rest of the
    document stays. `out` may be that folder.

    Args:
        document: Markdown; it is made if there is none.
        results: files of `out` that are no section's and are copied too.
        absent: names of sections that this run has nothing for; their places are emptied.

    Returns:
        The folder of result files, tables and pictures; cells stay in `out`.

    Raises:
        DataError: the document is no text, or a begin marker has no end; nothing is written then.
    """
    folder = document.parent / document.stem / slug(name)
    text = _text_of(document)
    begins = {section.name: _begin(f"{slug(name)}/{section.name}") for section in sections}
    if f"<!-- begin {slug(name)}/" in text:
        sections = [section for section in sections if begins[section.name] in text]
    for section in sections:
        title = f"## {section.about}\n\n" if section.about and not section.picture else ""
        place = f"{begins[section.name]}\n{_end(f'{slug(name)}/{section.name}')}"
        if begins[section.name] not in text:
            text = f"{text.rstrip()}\n\n{title}{place}\n"
        content = section.markdown(folder.relative_to(document.parent))
        text = _filled(document, text, f"{slug(name)}/{section.name}", content)
    for one in absent:
        if _begin(f"{slug(name)}/{one}") in text:
            text = _filled(document, text, f"{slug(name)}/{one}", "Nothing.\n")
    for file in (*results, *(path for section in sections for path in section.files)):
        write_file(folder / file, (out / file).read_bytes())
    _write(document, text)
    return folder


def replace_block(document: Path, place: str, content: str) -> None:
    """Write a text between the lines `<!-- begin PLACE -->` and `<!-- end PLACE -->` of a document.

    Raises:
        DataError: there is no such document, it is no text, or it lacks one of the lines.
    """
    if not document.is_file():
        raise DataError(f"{document}: no such file")
    text = _text_of(document)
    if _begin(place) not in text:
        raise DataError(complaint(document, place, f"the lines {_begin(place)} and {_end(place)}", "none"))
    _write(document, _filled(document, text, place, content))


def check_document(document: Path, name: str, names: Sequence[str]) -> None:
    """Check before the work that `publish` can write into a document.

    Args:
        document: Markdown, or where it will be.
        names: of the sections that it may have.

    Raises:
        UserError: the document cannot be written to or is no text; a marker has no end, or is of no section.
    """
    if document.suffix != ".md":
        raise DataError(complaint(document, "name", "a Markdown document, PAGE.md", document.name))
    if not re.search("[a-z0-9]", name.lower()):
        raise DataError(complaint(document, "name of the run", "a letter from a to z or a digit in it", repr(name)))
    with overwriting():
        check_output(document)
    text = _text_of(document)
    for one in re.findall(rf"<!-- begin {re.escape(slug(name))}/(\S+) -->", text):
        place = f"{slug(name)}/{one}"
        if one not in names:
            raise DataError(complaint(document, _begin(place), f"one of {', '.join(names)}", one))
        _filled(document, text, place, "")


def _text_of(document: Path) -> str:
    if document.exists():
        return read_text(document, "document")
    return f"# {document.stem.capitalize()}\n"


def _filled(document: Path, text: str, place: str, content: str) -> str:
    """Text with other content in a place that it has."""
    begin, end = _begin(place), _end(place)
    before, _, rest = text.partition(begin)
    _, ended, after = rest.partition(end)
    if not ended:
        raise DataError(complaint(document, begin, f"a line {end} after it", "none"))
    return f"{before}{begin}\n{content}\n{end}{after}"


def _write(document: Path, text: str) -> None:
    # An editor on Windows may have ended the lines by two characters; `_text_of` reads them as one.
    before = document.read_bytes() if document.exists() else b""
    if 2 * before.count(b"\r\n") > before.count(b"\n"):
        text = text.replace("\n", "\r\n")
    write_file(document, text, edited=True)


def _begin(place: str) -> str:
    return f"<!-- begin {place} -->"


def _end(place: str) -> str:
    return f"<!-- end {place} -->"
