"""Registry of fusion methods by name: built-in ones, entry points of other packages, and those a program adds."""

from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from sim.errors import SettingsError, complaint

GROUP = "dsrc.fusions"
"""Entry point group of packages with fusion methods: `name = "package.module:Class"`."""

_REGISTERED: dict[str, type] = {}


class FusionRegistry(Mapping[str, Any]):
    """Fusion classes by name; one of another package is imported when it is first used."""

    def __getitem__(self, name: str) -> Any:
        if name not in _built_in():
            _REGISTERED[name] = _loaded(_installed()[name])
        return _REGISTERED[name]

    def __contains__(self, name: object) -> bool:
        return name in _built_in() or name in _installed()

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys((*_built_in(), *_installed())))

    def __len__(self) -> int:
        return len(list(iter(self)))


FUSIONS = FusionRegistry()


def register_fusion(name: str, fusion: type) -> None:
    """Add a fusion class, whose name `ModelSettings.fusion` then accepts.

    It holds for this process; other processes and machines need it too: an entry point of the group `dsrc.fusions` is
    found by all of them.

    Args:
        name: in settings, recipes and on the command line.
        fusion: a subclass of `dsrc.models.fusion.Fusion`; `dsrc.models.fusion_check.check_fusion` tests it.

    Raises:
        SettingsError: the name is taken, or the class is not a fusion.
    """
    if not (
        isinstance(fusion, type) and any(_path(base) == "dsrc.models.fusion.base.Fusion" for base in fusion.__mro__)
    ):
        raise SettingsError(complaint("register_fusion", name, "a subclass of dsrc.models.fusion.Fusion", repr(fusion)))
    known = _REGISTERED.get(name)
    if known is not None and _path(known) != _path(fusion):
        raise SettingsError(complaint("register_fusion", "name", "a new one", f"'{name}', which is {_path(known)}"))
    _REGISTERED[name] = fusion


def _built_in() -> dict[str, type]:
    """Return the registered classes, those of `dsrc.models.fusion` among them: it registers them on import."""
    import_module("dsrc.models.fusion")
    return _REGISTERED


@cache
def _installed() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP)}


def _loaded(point: EntryPoint) -> type:
    try:
        fusion = point.load()
    except Exception as error:  # another package's import can fail in any way
        found = f"{type(error).__name__}: {error}"
        raise SettingsError(complaint(f"entry point {GROUP}", point.name, f"to import {point.value}", found)) from None
    register_fusion(point.name, fusion)
    return fusion


def _path(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"
