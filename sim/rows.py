"""Rows: base of structs of arrays, whose fields are columns of one length."""

from dataclasses import fields
from typing import Any, ClassVar, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

R = TypeVar("R", bound="Rows")


class Rows:
    """Base of frozen dataclasses whose fields are columns: arrays, tuples, or `Rows` themselves.

    Attributes:
        SHARED: fields that hold for all rows, such as an instant, and are no columns.
    """

    __slots__ = ()
    SHARED: ClassVar[tuple[str, ...]] = ()

    def __len__(self) -> int:
        return len(getattr(self, _layout_of(type(self)).first))

    def __getitem__(self, rows: NDArray[np.bool_] | NDArray[np.integer] | slice) -> Self:
        """Select rows by a mask, indices or a slice.

        Raises:
            IndexError: a mask of another length, or an index beyond the last row.
        """
        which = rows if isinstance(rows, slice) else self._numbers(np.asarray(rows))
        fields_of = _layout_of(type(self)).fields
        return type(self)(
            *[getattr(self, name) if shared else _picked(getattr(self, name), which) for name, shared in fields_of]
        )

    def _numbers(self, rows: NDArray) -> NDArray[np.integer]:
        if rows.dtype != bool:
            return rows if rows.size else rows.astype(np.intp)
        if rows.shape != (len(self),):
            raise IndexError(f"a mask for {len(self)} rows must have shape ({len(self)},), got {rows.shape}")
        return np.flatnonzero(rows)  # one search for all columns: a mask for each takes eight times as long


def stacked(first: R, *others: R) -> R:
    """Return the rows of all in their order; what they share is the first one's."""
    values = {
        name: getattr(first, name) if shared else _joined([getattr(part, name) for part in (first, *others)])
        for name, shared in _layout_of(type(first)).fields
    }
    return type(first)(**values)


class _Layout(NamedTuple):
    """First column of a class, and its fields with whether the rows share them."""

    first: str
    fields: tuple[tuple[str, bool], ...]


_LAYOUTS: dict[type[Rows], _Layout] = {}


def _layout_of(kind: type[Rows]) -> _Layout:
    if kind not in _LAYOUTS:
        named = tuple((field.name, field.name in kind.SHARED) for field in fields(kind))  # type: ignore[arg-type]
        _LAYOUTS[kind] = _Layout(next(name for name, shared in named if not shared), named)
    return _LAYOUTS[kind]


def _picked(column: Any, rows: NDArray[np.integer] | slice) -> Any:
    if isinstance(rows, slice) or isinstance(column, Rows):
        return column[rows]
    if isinstance(column, tuple):
        return tuple(column[row] for row in rows.tolist())
    return column.take(rows, axis=0) if column.flags.c_contiguous else column[rows]  # the latter keeps a memory order


def _joined(parts: list[Any]) -> Any:
    if isinstance(parts[0], np.ndarray):
        return np.concatenate(parts)
    return stacked(*parts) if isinstance(parts[0], Rows) else tuple(row for part in parts for row in part)
