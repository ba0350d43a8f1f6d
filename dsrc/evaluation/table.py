"""Sheet: a table of means and spreads, as Markdown, CSV and for the terminal."""

import csv
import io
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, Self

from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.markup import escape
from rich.padding import Padding
from rich.table import Table
from rich.text import Text


class Stat(NamedTuple):
    """A number that may come from several trainings.

    Attributes:
        mean: NaN for none.
        spread: standard deviation between the trainings; NaN for fewer than two.
    """

    mean: float
    spread: float = math.nan

    @classmethod
    def of(cls, values: Sequence[float]) -> Self:
        """Return the mean and the spread of values; NaN among them makes both NaN."""
        if not values:
            return cls(math.nan)
        spread = statistics.stdev(values) if len(values) > 1 and all(map(math.isfinite, values)) else math.nan
        return cls(sum(values) / len(values), spread)

    def text(self, scale: float, digits: int) -> str:
        """Return it as people read it."""
        if math.isnan(self.mean):
            return "-"
        spread = "" if math.isnan(self.spread) else f" ± {scale * self.spread:.{digits}f}"
        return f"{scale * self.mean:.{digits}f}{spread}"


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a sheet.

    Attributes:
        title: above it.
        parts: what its cells hold: average precisions at these IoU, or one number without a name.
        better: which is the best of a column; none of a column of other facts.
        scale: factor for the reader; 100 for percent.
        digits: behind the point.
    """

    title: str
    parts: tuple[str, ...] = ("0.5", "0.7")
    better: Literal["high", "low", ""] = "high"
    scale: float = 100.0
    digits: int = 1


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a sheet.

    Attributes:
        label: what it is of; a key in CSV and in figures.
        cells: one per column, a number for each of the column's parts.
        mark: of footnotes, shown behind the label.
        words: in the sheet's columns of words.
    """

    label: str
    cells: tuple[tuple[Stat, ...], ...]
    mark: str = ""
    words: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """The label with its mark."""
        return f"{self.label} {self.mark}" if self.mark else self.label


@dataclass(frozen=True, slots=True)
class Sheet:
    """A table.

    Attributes:
        name: of its files and of its place in a document.
        title: one line.
        note: what a reader has to know.
        head: title of the labels.
        columns: as many as each line has cells.
        lines: from top to bottom.
        words: titles of columns of words, left of the numbers.
        footnotes: one for each mark that the sheet shows, the mark first.
    """

    name: str
    title: str
    note: str
    head: str
    columns: tuple[Column, ...]
    lines: tuple[Line, ...]
    words: tuple[str, ...] = ()
    footnotes: tuple[str, ...] = ()

    def markdown(self) -> str:
        """Return the title, the table with the best of each column in bold, the note and the footnotes."""
        rows = [
            [self.head, *self.words, *(column.title for column in self.columns)],
            ["---", *("---" for _ in self.words), *("---:" for _ in self.columns)],
            *([line.title, *line.words, *self._texts(line, "**", "**")] for line in self.lines),
        ]
        parts = [f"**{self.title}**", markdown_table(rows), *self.footnotes, self.note]
        return "\n\n".join(parts) + "\n"

    def csv(self) -> str:
        """Return CSV with a column for each number and one for its spread, unscaled."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        names = [f"{column.title} {part}".strip() for column in self.columns for part in column.parts]
        writer.writerow([self.head, *self.words, *(name for part in names for name in (part, f"{part} spread"))])
        for line in self.lines:
            numbers = [number for cell in line.cells for stat in cell for number in stat]
            values = ["" if math.isnan(number) else repr(float(number)) for number in numbers]
            writer.writerow([line.label, *line.words, *values])
        return text.getvalue()

    def terminal(self, columns: int, width: int = 80) -> Group:
        """Return the first columns for a terminal of a width, in as many tables one below the other as it needs.

        Means alone are shown, the parts of a cell one below the other; long labels are broken.
        """
        lines = [
            Line(line.title, tuple(tuple(Stat(stat.mean) for stat in cell) for cell in line.cells))
            for line in self.lines
        ]
        plain = [self._texts(line, "", "", "\n") for line in lines]
        marked = [self._texts(line, "[bold]", "[/bold]", "\n") for line in lines]
        heads = [column.title.replace(" ", "\n") for column in self.columns]
        widths = [
            max(len(t) for cell in (heads[i], *(row[i] for row in plain)) for t in cell.split("\n"))
            for i in range(columns)
        ]
        room = max(width - sum(1 + w for w in widths), width // 4)
        label = min(max(len(text) for text in (self.head, *(line.label for line in lines))), room)
        blocks: list[list[int]] = [[]]
        for i in range(columns):
            if blocks[-1] and label + sum(1 + widths[k] for k in (*blocks[-1], i)) > width:
                blocks.append([])
            blocks[-1].append(i)
        tables = []
        for block in blocks:
            table = Table(box=SIMPLE_HEAD, padding=0, show_edge=False)
            table.add_column(self.head, width=label, overflow="fold")
            for i in block:
                table.add_column(heads[i], justify="right", width=widths[i], no_wrap=True)
            for line, cells in zip(lines, marked, strict=True):
                table.add_row(escape(line.label), *(cells[i] for i in block))
            tables.append(Padding(table, (1, 0, 0, 0)))
        parts = self.columns[0].parts
        above = (Text(self.title, style="bold"), Text(f"In a cell, from above: IoU {', '.join(parts)}; %."))
        return Group(*above, *tables, *map(Text, self.footnotes))

    def _texts(self, line: Line, before: str, after: str, between: str = " / ") -> list[str]:
        """Return the cells of a line as people read them, what is best between two marks."""
        texts = []
        for number, (column, cell) in enumerate(zip(self.columns, line.cells, strict=True)):
            shown = [stat.text(column.scale, column.digits) for stat in cell]
            best = [self._is_best(number, part, stat) for part, stat in enumerate(cell)]
            texts.append(between.join(f"{before}{t}{after}" if b else t for t, b in zip(shown, best, strict=True)))
        return texts

    def _is_best(self, column: int, part: int, stat: Stat) -> bool:
        """Return whether a number is the best of several in its column, as far as its digits are shown."""
        about = self.columns[column]
        means = [line.cells[column][part].mean for line in self.lines]
        known = [mean for mean in means if not math.isnan(mean)]
        if not about.better or len(known) < 2 or math.isnan(stat.mean):
            return False
        best = max(known) if about.better == "high" else min(known)
        return Stat(best).text(about.scale, about.digits) == Stat(stat.mean).text(about.scale, about.digits)


def markdown_table(rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table of rows of texts, the heads and their rule first."""
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows)
