"""Tables of means and spreads: Markdown, CSV and for the terminal."""

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
    """Mean and spread of a number over trainings.

    Attributes:
        mean: NaN for no training.
        spread: standard deviation between the trainings; NaN for fewer than two.
    """

    mean: float
    spread: float = math.nan

    @classmethod
    def of(cls, values: Sequence[float]) -> Self:
        """Mean and spread of values; NaN among them makes both NaN."""
        if not values:
            return cls(math.nan)
        spread = statistics.stdev(values) if len(values) > 1 and all(map(math.isfinite, values)) else math.nan
        return cls(sum(values) / len(values), spread)

    def text(self, scale: float, digits: int) -> str:
        """Text of the mean and its spread; "-" for NaN."""
        if math.isnan(self.mean):
            return "-"
        spread = "" if math.isnan(self.spread) else f" ± {scale * self.spread:.{digits}f}"
        return f"{scale * self.mean:.{digits}f}{spread}"


@dataclass(frozen=True, slots=True)
class Column:
    """Column of a table.

    Attributes:
        title: head of the column.
        parts: names of the numbers in a cell: average precisions at these IoU, or "" for a single number.
        better: which end is the best of a column; "" for neither.
        scale: factor of the text; 100 for percent.
        digits: decimals.
    """

    title: str
    parts: tuple[str, ...] = ("0.5", "0.7")
    better: Literal["high", "low", ""] = "high"
    scale: float = 100.0
    digits: int = 1


@dataclass(frozen=True, slots=True)
class TableRow:
    """Line of a table.

    Attributes:
        label: of the line; its key in CSV and in figures.
        cells: one per column, a number for each of the column's parts.
        mark: footnote marks, shown after the label.
        words: texts in the table's text columns.
    """

    label: str
    cells: tuple[tuple[Stat, ...], ...]
    mark: str = ""
    words: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """Label with its footnote marks."""
        return f"{self.label} {self.mark}" if self.mark else self.label


@dataclass(frozen=True, slots=True)
class ResultTable:
    """Table of results, with text columns left of the numbers.

    Attributes:
        name: of its files and of its section in a document.
        title: one line.
        note: explanation below the table.
        head: head of the labels.
        columns: one per cell of a line.
        lines: from top to bottom.
        words: heads of the text columns.
        footnotes: one for each mark in the table, the mark first.
    """

    name: str
    title: str
    note: str
    head: str
    columns: tuple[Column, ...]
    lines: tuple[TableRow, ...]
    words: tuple[str, ...] = ()
    footnotes: tuple[str, ...] = ()

    def markdown(self) -> str:
        """Markdown: title, table with the best of each column in bold, footnotes and note."""
        rows = [
            [self.head, *self.words, *(column.title for column in self.columns)],
            ["---", *("---" for _ in self.words), *("---:" for _ in self.columns)],
            *([line.title, *line.words, *self._texts(line, "**", "**")] for line in self.lines),
        ]
        parts = [f"**{self.title}**", markdown_table(rows), *self.footnotes, self.note]
        return "\n\n".join(parts) + "\n"

    def csv(self) -> str:
        """CSV with a column for each number and one for its spread, unscaled."""
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
        """Table for a terminal: the first columns, split into several tables one below the other where too wide.

        Only means, the parts of a cell one below the other; long labels are broken.
        """
        lines = [
            TableRow(line.title, tuple(tuple(Stat(stat.mean) for stat in cell) for cell in line.cells))
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

    def _texts(self, line: TableRow, before: str, after: str, between: str = " / ") -> list[str]:
        """Texts of the cells of a line, the best numbers between two marks."""
        texts = []
        for number, (column, cell) in enumerate(zip(self.columns, line.cells, strict=True)):
            shown = [stat.text(column.scale, column.digits) for stat in cell]
            best = [self._is_best(number, part, stat) for part, stat in enumerate(cell)]
            texts.append(between.join(f"{before}{t}{after}" if b else t for t, b in zip(shown, best, strict=True)))
        return texts

    def _is_best(self, column: int, part: int, stat: Stat) -> bool:
        """Whether a number is the best of several in its column, to the shown digits."""
        about = self.columns[column]
        means = [line.cells[column][part].mean for line in self.lines]
        known = [mean for mean in means if not math.isnan(mean)]
        if not about.better or len(known) < 2 or math.isnan(stat.mean):
            return False
        best = max(known) if about.better == "high" else min(known)
        return Stat(best).text(about.scale, about.digits) == Stat(stat.mean).text(about.scale, about.digits)


def markdown_table(rows: Sequence[Sequence[str]]) -> str:
    """Markdown table of rows of texts, heads and rule first."""
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows)
