"""Columns of a CSV with a header, in bounded memory, with the line of every wrong value."""

import csv
import math
from array import array
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.errors import DataError, complaint
from sim.reading import LARGEST_BYTES, parsing, read_text


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """Columns of R rows by their lower-case names.

    Attributes:
        numbers: (R,) each.
        texts: R each, without blanks around them.
        line: (R,) number of the line in the file, from 1.
    """

    numbers: dict[str, NDArray[np.float64]]
    texts: dict[str, list[str]]
    line: NDArray[np.int64]

    def groups(self, name: str) -> dict[str, NDArray[np.int64]]:
        """Return the rows of each value of a column of text, in the order of the file."""
        return rows_by(self.texts[name])


def rows_by(values: Sequence[str]) -> dict[str, NDArray[np.int64]]:
    """Return the ascending rows of each value, values in the order in which they come."""
    rows: dict[str, list[int]] = {}
    for row, value in enumerate(values):
        rows.setdefault(value, []).append(row)
    return {value: np.array(listed, np.int64) for value, listed in rows.items()}


def header_of(path: Path) -> tuple[str, ...]:
    """Return the lower-case names of the columns of a CSV; DataError for a file that is missing or no text."""
    first = read_text(path, "CSV file", most=LARGEST_BYTES).partition("\n")[0]
    return tuple(name.strip().strip('"').lower() for name in first.split(_delimiter(first)))


def _delimiter(text: str) -> str:
    """Return what separates the names of a header: a comma, a semicolon or a tab."""
    return max(",;\t", key=text.partition("\n")[0].count)


def read_columns(
    path: Path, numbers: Sequence[str], texts: Sequence[str] = (), optional: Collection[str] = ()
) -> Columns:
    """Read some columns of a CSV, separated by commas, semicolons or tabs.

    Args:
        numbers: names of columns of numbers.
        texts: names of columns of text.
        optional: columns that may be missing, as may their values: NaN, or an empty text.

    Raises:
        DataError: a column is missing, or a value is; names the line.
    """
    text = read_text(path, "CSV file", most=LARGEST_BYTES)
    with parsing(path, "CSV file"):
        delimiter = _delimiter(text)
        reader = csv.reader(text.splitlines(), delimiter=delimiter, skipinitialspace=True)
        header = [name.strip().lower() for name in next(reader, [])]
        for name in (*numbers, *texts):
            if name not in header and name not in optional:
                raise DataError(complaint(path, "columns", f"a column '{name}'", ", ".join(header) or "none"))
        places = {name: header.index(name) if name in header else None for name in (*numbers, *texts)}
        read: dict[str, array] = {name: array("d") for name in numbers}
        said: dict[str, list[str]] = {name: [] for name in texts}
        lines = array("q")
        for row in reader:
            if not row:
                continue
            line = reader.line_num
            if len(row) != len(header):
                raise DataError(complaint(path, f"line {line}", f"{len(header)} values, as columns", str(len(row))))
            for name, values in read.items():
                place = places[name]
                cell = "" if place is None else row[place].strip()
                if delimiter == ";":  # as spreadsheets write it where a comma begins the decimals
                    cell = cell.replace(",", ".")
                values.append(_number(path, line, name, cell, name in optional))
            for name, listed in said.items():
                place = places[name]
                listed.append("" if place is None else row[place].strip())
                if not listed[-1] and name not in optional:
                    article = "an" if name[0] in "aeiou" else "a"
                    raise DataError(complaint(path, f"line {line}, {name}", f"{article} {name}", "nothing"))
            lines.append(line)
    return Columns(
        {name: np.frombuffer(values, np.float64) if values else np.zeros(0) for name, values in read.items()},
        said,
        np.array(lines, np.int64),
    )


def _number(path: Path, line: int, column: str, text: str, missing: bool) -> float:
    if missing and text.lower() in ("", "nan"):
        return math.nan
    try:
        value = float(text)
    except ValueError:
        value = math.inf
    if not math.isfinite(value):
        raise DataError(complaint(path, f"line {line}, {column}", "a number", text or "nothing"))
    return value
