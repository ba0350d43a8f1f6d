"""Registry of values by name: built in, registered by a program, or entry points of other packages."""

from collections.abc import Callable, Hashable, Iterator, Mapping
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
        key: values of equal keys are the same: the later one replaces the earlier one. None compares the values.
    """

    def __init__(
        self,
        group: str,
        built_in: Mapping[str, T],
        read: Callable[[Any], T],
        key: Callable[[T], Hashable] | None = None,
    ) -> None:
        self.group = group
        self._values = dict(built_in)
        self._read = read
        self._key = key or (lambda value: value)
        self._loading: set[str] = set()

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
        """Add a value; the same one again, from a module or notebook cell that runs twice, is no error.

        Raises:
            SettingsError: the name is taken by another value.
        """
        known = self._values.get(name) if name in self._loading else self.get(name)  # its own package may register it
        if known is not None and self._key(known) != self._key(value):
            raise SettingsError(complaint(self.group, "name", "a new one", f"'{name}', which is registered"))
        self._values[name] = value

    def remove(self, name: str) -> None:
        """Forget a registered value."""
        del self._values[name]

    @cached_property
    def _installed(self) -> dict[str, EntryPoint]:
        return {point.name: point for point in entry_points(group=self.group)}

    def _loaded(self, point: EntryPoint) -> T:
        self._loading.add(point.name)
        try:
            return self._read(point.load())
        except Exception as error:  # another package can fail in any way
            found = f"{type(error).__name__}: {error}"
            where = f"entry point {self.group}"
            raise SettingsError(complaint(where, point.name, f"{point.value} to load", found)) from None
        finally:
            self._loading.discard(point.name)


def instance_of(wanted: type[T]) -> Callable[[Any], T]:
    """Return a function that gives back an instance of a class; TypeError for anything else."""

    def checked(value: object) -> T:
        if not isinstance(value, wanted):
            raise TypeError(f"expected a {wanted.__name__}, found {type(value).__name__}")
        return value

    return checked


def import_path(thing: object) -> str:
    """Return module and name of a class or function, which stay when a module or notebook cell runs again."""
    return f"{getattr(thing, '__module__', '')}.{getattr(thing, '__qualname__', repr(thing))}"
