"""Table of texts and numbers: for a terminal, as Markdown, as CSV and as records of JSON types."""

import io
import math
import statistics
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Literal, NamedTuple, Self

from dsrc.tables.files import Scalar, csv_text

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType
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


class Strong(str):
    """Text in bold."""

    __slots__ = ()


Cell = str | float | None | tuple[Stat, ...]
"""Text, number, nothing, or one statistic for each part of the column."""


@dataclass(frozen=True, slots=True)
class Column:
    """Column of a table.

    Attributes:
        title: head of the column.
        parts: names of the statistics in a cell, ("",) for a single one; empty for texts and plain numbers.
        unit: of the shown numbers, in the head.
        scale: factor of the shown numbers; 100 for percent.
        digits: decimals.
        better: which end is the best of the statistics, in bold; "" for neither.
        align: "left" for texts.
        terminal: whether a terminal shows the column.
    """

    title: str
    parts: tuple[str, ...] = ()
    unit: str = ""
    scale: float = 1.0
    digits: int = 0
    better: Literal["high", "low", ""] = ""
    align: Literal["left", "right"] = "right"
    terminal: bool = True

    @property
    def head(self) -> str:
        """Title with its unit."""
        return f"{self.title}, {self.unit}" if self.unit else self.title

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the values of a cell in CSV: each statistic has a mean and a spread."""
        if not self.parts:
            return (self.title,)
        means = [f"{self.title} {part}".strip() for part in self.parts]
        return tuple(name for mean in means for name in (mean, f"{mean} spread"))


@dataclass(frozen=True, slots=True)
class TableRow:
    """Row of a table.

    Attributes:
        label: first text of the row; its key in CSV and in figures.
        cells: one per column.
        mark: footnote marks, shown after the label.
    """

    label: str
    cells: tuple[Cell, ...]
    mark: str = ""

    @property
    def title(self) -> str:
        """Label with its footnote marks."""
        return f"{self.label} {self.mark}" if self.mark else self.label

    def stat(self, column: int, part: int) -> Stat:
        """Statistic of a cell; NaN where it has none."""
        cell = self.cells[column]
        return cell[part] if isinstance(cell, tuple) else Stat(math.nan)


@dataclass(frozen=True, slots=True)
class Table:
    """Table of a report; rich prints it, in several blocks where a terminal is too narrow.

    Attributes:
        name: of its files and of its section in a document.
        title: one line; "" for none.
        head: of the labels.
        columns: one per cell of a row.
        rows: from top to bottom.
        note: Markdown below the table.
        caption: text below it in a terminal, instead of the note.
        footnotes: one for each mark in the table, the mark first.
        grouped: rows of one label are a group, whose label a terminal shows once, above them.
    """

    name: str
    title: str
    head: str
    columns: tuple[Column, ...]
    rows: tuple[TableRow, ...]
    note: str = ""
    caption: str = ""
    footnotes: tuple[str, ...] = ()
    grouped: bool = False

    @classmethod
    def of(
        cls, head: Sequence[str], rows: Iterable[Sequence[object]], texts: int = 1, *, name: str = "", title: str = ""
    ) -> Self:
        """Table of values that are shown as they are.

        Args:
            head: of all columns, that of the labels first.
            rows: a value per column, the label first.
            texts: number of columns on the left that hold texts; numbers are on the right.
        """
        columns = tuple(Column(about, align="left" if i < texts else "right") for i, about in enumerate(head) if i)
        shown = ([f"{value:g}" if isinstance(value, float) else str(value) for value in row] for row in rows)
        return cls(name, title, head[0], columns, tuple(TableRow(label, tuple(cells)) for label, *cells in shown))

    def markdown(self) -> str:
        """Markdown: title, table with the best of each column in bold, footnotes and note."""
        rules = ["---", *("---" if column.align == "left" else "---:" for column in self.columns)]
        rows = [[self.head, *(column.head for column in self.columns)], rules]
        for row in self.rows:
            pieces = [self._pieces(row, i) for i in range(len(self.columns))]
            rows.append([_marked(row.title), *(" / ".join(map(_marked, of_cell)) for of_cell in pieces)])
        texts = ("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows)
        lines = "\n".join(texts) if self.rows else ""
        title = f"**{self.title}**" if self.title else ""
        return "\n\n".join(part for part in (title, lines, *self.footnotes, self.note) if part) + "\n"

    _repr_markdown_ = markdown

    def html(self) -> str:
        """HTML of the rows alone, all texts escaped; numbers have the class `n`."""
        if not self.rows:
            return ""
        kinds = ["", *("" if column.align == "left" else " class=n" for column in self.columns)]

        def line(tag: str, cells: Iterable[str]) -> str:
            made = (f"<{tag}{kind}>{cell}</{tag}>" for kind, cell in zip(kinds, cells, strict=True))
            return f"<tr>{''.join(made)}</tr>"

        lines = [line("th", [escape(head) for head in (self.head, *(column.head for column in self.columns))])]
        for row in self.rows:
            pieces = [self._pieces(row, i) for i in range(len(self.columns))]
            lines.append(line("td", [escape(row.title), *(" / ".join(map(_tagged, of_cell)) for of_cell in pieces)]))
        return f"<table>{''.join(lines)}</table>"

    def records(self) -> list[dict[str, Scalar]]:
        """Rows as JSON types by the names of their columns: numbers unscaled, unknown ones None."""
        listed = []
        for row in self.rows:
            record: dict[str, Scalar] = {self.head: row.label}
            for column, cell in zip(self.columns, row.cells, strict=True):
                values = [number for stat in cell for number in stat] if isinstance(cell, tuple) else [cell]
                record |= zip(column.names, map(_known, values), strict=True)
            listed.append(record)
        return listed

    def csv(self) -> str:
        """CSV of the records."""
        return csv_text(self.records(), [self.head, *(name for column in self.columns for name in column.names)])

    def text(self, width: int = 80) -> str:
        """Text for a terminal of so many columns."""
        from rich.console import Console

        file = io.StringIO()
        Console(width=width, file=file, color_system=None, highlight=False).print(self)
        return "\n".join(line.rstrip() for line in file.getvalue().splitlines()).strip("\n")

    __str__ = text

    def __rich_console__(self, console: "Console", options: "ConsoleOptions") -> "Iterator[RenderableType]":
        """Yield title, blocks, footnotes and caption; statistics without spreads, one below the other."""
        from rich.text import Text

        if self.title:
            yield Text(self.title, style="bold")
        yield from self._blocks(options.max_width)
        yield from map(Text, (*self.footnotes, *filter(None, [self.caption])))

    def _blocks(self, width: int) -> "Iterator[RenderableType]":
        """Yield tables of rich that are at most so wide; each of them has the columns of text on the left."""
        from rich.box import SIMPLE_HEAD
        from rich.padding import Padding
        from rich.table import Table as RichTable
        from rich.text import Text

        shown = [i for i, column in enumerate(self.columns) if column.terminal]
        heads = {i: _narrow(self.columns[i]) for i in shown}
        cells = [{i: _text(self._pieces(row, i, spread=False)) for i in shown} for row in self.rows]
        first = next((k for k, i in enumerate(shown) if self.columns[i].align == "right"), len(shown))
        words, numbers = shown[:first], shown[first:]
        widths = {i: max(map(len, "\n".join([heads[i], *(str(row[i]) for row in cells)]).split("\n"))) for i in shown}
        longest = max(len(text) for text in (self.head, *(row.title for row in self.rows)))
        wanted = [longest, *(widths[i] for i in words)]
        if self.grouped:  # labels stand above the first words
            wanted[:2] = [max(wanted[:2])]
        fitted = _fitted(wanted, max(width - sum(1 + widths[i] for i in numbers), width // 4))
        left = sum(fitted) + len(fitted) - 1
        named = [] if self.grouped else [self.head]
        for block in _split([widths[i] for i in numbers], width - left):
            table = RichTable(box=SIMPLE_HEAD, padding=0, show_edge=False, header_style="bold")
            for head, one in zip([*named, *(heads[i] for i in words)], fitted, strict=True):
                table.add_column(head, width=one, overflow="fold")
            for i in (numbers[k] for k in block):
                table.add_column(heads[i], justify=self.columns[i].align, width=widths[i], no_wrap=True)
            for number, (row, of_row) in enumerate(zip(self.rows, cells, strict=True)):
                if self.grouped and (number == 0 or row.label != self.rows[number - 1].label):
                    table.add_section()
                    table.add_row(Text(row.title, style="bold"))
                label = [] if self.grouped else [_text([row.title])]
                table.add_row(*label, *(of_row[i] for i in (*words, *(numbers[k] for k in block))))
            yield Padding(table, (1, 0, 1, 0))

    def _pieces(self, row: TableRow, column: int, *, spread: bool = True) -> list[str]:
        """Texts of a cell, one for each part, the best of the column in bold."""
        about, cell = self.columns[column], row.cells[column]
        if isinstance(cell, tuple):
            stats = cell if spread else [Stat(stat.mean) for stat in cell]
            texts = [stat.text(about.scale, about.digits) for stat in stats]
            return [Strong(t) if self._is_best(column, part, cell[part]) else t for part, t in enumerate(texts)]
        if cell is None or isinstance(cell, str):
            return [cell or ""]
        return [Stat(cell).text(about.scale, about.digits)]

    def _is_best(self, column: int, part: int, stat: Stat) -> bool:
        """Whether a number is the best of several in its column, to the shown digits."""
        about = self.columns[column]
        known = [mean for row in self.rows if not math.isnan(mean := row.stat(column, part).mean)]
        if not about.better or len(known) < 2 or math.isnan(stat.mean):
            return False
        best = max(known) if about.better == "high" else min(known)
        return Stat(best).text(about.scale, about.digits) == Stat(stat.mean).text(about.scale, about.digits)


def _known(value: str | float | None) -> Scalar:
    """Value in a file, NaN as None."""
    return None if isinstance(value, float) and math.isnan(value) else value


def _marked(text: str) -> str:
    """Text in Markdown."""
    return f"**{text}**" if isinstance(text, Strong) and text else text


def _tagged(text: str) -> str:
    """Text in HTML."""
    return f"<b>{escape(text)}</b>" if isinstance(text, Strong) and text else escape(text)


def _text(pieces: Sequence[str]) -> "Text":
    """Texts for a terminal, one below the other."""
    from rich.text import Text

    return Text("\n").join(Text(piece, style="bold" if isinstance(piece, Strong) else "") for piece in pieces)


def _narrow(column: Column) -> str:
    """Head of a column in a terminal: one word below the other above numbers."""
    return column.head if column.align == "left" else column.head.replace(" ", "\n")


def _fitted(widths: Sequence[int], room: int) -> list[int]:
    """Widths of texts that share some room with a space between them: the widest are broken."""
    fitted = list(widths)
    while sum(fitted) + len(fitted) - 1 > room and max(fitted, default=0) > 1:
        fitted[fitted.index(max(fitted))] -= 1
    return fitted


def _split(widths: Sequence[int], room: int) -> list[list[int]]:
    """Places of columns in blocks that fit some room, at least one column in each."""
    blocks: list[list[int]] = [[]]
    for place, width in enumerate(widths):
        if blocks[-1] and sum(1 + widths[k] for k in blocks[-1]) + 1 + width > room:
            blocks.append([])
        blocks[-1].append(place)
    return blocks
