"""Documents with results: sections between markers, and their files in a folder beside the document."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from sim.errors import DataError, complaint
from sim.files import write_file


@dataclass(frozen=True, slots=True)
class Section:
    """Section of a document: text, a picture, or both.

    Attributes:
        name: of its markers in the document.
        text: Markdown.
        picture: file of the picture; "" for none.
        about: caption of the picture.
        tables: files of the text's numbers.
    """

    name: str
    text: str = ""
    picture: str = ""
    about: str = ""
    tables: tuple[str, ...] = ()

    @property
    def files(self) -> tuple[str, ...]:
        """Files of the section."""
        return (*self.tables, self.picture) if self.picture else self.tables

    def below(self, folder: str) -> "Section":
        """Section with its name and files in a folder."""
        picture = f"{folder}/{self.picture}" if self.picture else ""
        tables = tuple(f"{folder}/{table}" for table in self.tables)
        return replace(self, name=f"{folder}/{self.name}", picture=picture, tables=tables)

    def markdown(self, pictures: Path) -> str:
        """Text with the picture, whose path is below the folder `pictures`."""
        picture = f"\n![{self.about}]({(pictures / self.picture).as_posix()})\n" if self.picture else ""
        return f"{self.text}{picture}"


def slug(name: str) -> str:
    """Name in paths: lower case, words joined by hyphens."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-") or "dataset"


def publish(sections: Sequence[Section], out: Path, document: Path, name: str, results: Sequence[str] = ()) -> Path:
    """Write sections between their markers in a document, and their files beside it in a folder `name`.

    A section `x/y` goes between the lines `<!-- begin NAME/x/y -->` and `<!-- end NAME/x/y -->`. A document with such
    lines of this name gets the sections that it has a place for, any other all of them at its end. The rest of the
    document stays. `out` may be that folder.

    Args:
        sections: of the document.
        out: folder of their files.
        document: Markdown; it is made if there is none.
        name: of the run.
        results: files of `out` that are no section's and are copied too.

    Returns:
        The folder of result files, tables and pictures; cells stay in `out`.

    Raises:
        DataError: a begin marker without its end.
    """
    folder = document.parent / document.stem / slug(name)
    text = document.read_text(encoding="utf-8") if document.is_file() else f"# {document.stem.capitalize()}\n"
    places = {section.name: f"<!-- begin {slug(name)}/{section.name} -->" for section in sections}
    if f"<!-- begin {slug(name)}/" in text:
        sections = [section for section in sections if places[section.name] in text]
    for file in (*results, *(path for section in sections for path in section.files)):
        write_file(folder / file, (out / file).read_bytes())
    for section in sections:
        begin, end = places[section.name], f"<!-- end {slug(name)}/{section.name} -->"
        content = f"{begin}\n{section.markdown(folder.relative_to(document.parent))}\n{end}"
        if begin not in text:
            text = f"{text.rstrip()}\n\n{content}\n"
            continue
        before, _, rest = text.partition(begin)
        _, ended, after = rest.partition(end)
        if not ended:
            raise DataError(complaint(document, begin, f"a line {end} after it", "none"))
        text = f"{before}{content}{after}"
    write_file(document, text, edited=True)
    return folder
