"""Registry of values by name: built in, registered by a program, or entry points of other packages."""

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar

from sim.errors import SettingsError, complaint

T = TypeVar("T")


class Registry(Mapping[str, T], Generic[T]):
    """Values by name; an entry point is imported when its name is first used.

    Args:
        group: entry point group of other packages, such as `dsrc.sensors`.
        built_in: values by name; they take precedence over entry points.
        read: value of the object that an entry point names; any error of it becomes a `SettingsError`.
    """

    def __init__(self, group: str, built_in: Mapping[str, T], read: Callable[[Any], T]) -> None:
        self.group = group
        self._values = dict(built_in)
        self._read = read

    def __getitem__(self, name: str) -> T:
        if name not in self._values and name in self._installed:
            self._values[name] = self._loaded(self._installed[name])
        return self._values[name]

    def __contains__(self, name: object) -> bool:
        return name in self._values or name in self._installed

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys((*self._values, *self._installed)))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def register(self, name: str, value: T) -> None:
        """Add a value; adding the same one again changes nothing.

        Raises:
            SettingsError: the name is taken by another value.
        """
        if name in self and self[name] != value:
            raise SettingsError(complaint(self.group, "name", "a new one", f"'{name}', which is registered"))
        self._values[name] = value

    @cached_property
    def _installed(self) -> dict[str, EntryPoint]:
        return {point.name: point for point in entry_points(group=self.group)}

    def _loaded(self, point: EntryPoint) -> T:
        try:
            return self._read(point.load())
        except Exception as error:  # another package can fail in any way
            found = f"{type(error).__name__}: {error}"
            where = f"entry point {self.group}"
            raise SettingsError(complaint(where, point.name, f"{point.value} to load", found)) from None
