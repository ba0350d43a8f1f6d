"""Hash of the code that decides a result: a module, all that it imports at any depth, and the data beside these.

Imports are read from the source, also those inside functions: nothing is imported, nothing is listed by hand. A source
counts as its `source_hash`, a data file as its bytes.
"""

import hashlib
import inspect
import sys
import textwrap
import uuid
from collections.abc import Iterable, Iterator
from functools import cache, partial
from importlib import metadata
from importlib.metadata import entry_points, version
from pathlib import Path
from typing import Any

from sim.files import file_sha256
from sim.kept.read_sources import read_source, remember
from sim.kept.source_hash import source_hash

_REPOSITORY = Path(__file__).resolve().parents[2]
_PACKAGES = ("sim", "sensors", "dsrc")
"""Ours; where they are installed, their folder holds everybody's."""
_BEHIND = {"sim.roads.tools": "eclipse-sumo", "trimesh": "mapbox_earcut"}
"""Packages behind modules that call them without an import: programs and roads of SUMO, and triangles of surfaces."""
_EXTENSIONS = ("dsrc.corruptions", "dsrc.fusions", "dsrc.sensors")
"""Entry point groups of packages whose code ours can call."""
packages_distributions = cache(metadata.packages_distributions)


@cache
def code_hash(entry: str, root: Path = _REPOSITORY) -> str:
    """SHA-256 of the `code_files` of a module, their paths included, in a tree."""
    total = hashlib.sha256()
    for path in code_files(entry, root):
        total.update(f"{path.relative_to(root).as_posix()} {_code_sha256(path)}\n".encode())
    remember()
    return total.hexdigest()


@cache
def package_versions(entry: str, root: Path = _REPOSITORY) -> dict[str, str]:
    """Versions by distribution of other packages that `code_files` import, and of those with extensions."""
    found, known = imported_modules(entry, root), packages_distributions()
    every = (name for module, path in found.items() for name in _imports(path, module))
    imported = {name.partition(".")[0] for name in every} - set(sys.stdlib_module_names)
    others = imported - set(_PACKAGES)
    names = {distribution for name in others for distribution in known.get(name, ())}
    # A machine that replays recorded traffic has no SUMO.
    installed = {distribution for several in known.values() for distribution in several}
    names |= {_BEHIND[name] for name in [*found, *others] if name in _BEHIND} & installed
    names |= {point.dist.name for group in _EXTENSIONS for point in entry_points(group=group) if point.dist}
    return {name: version(name) for name in sorted(names)}


@cache
def own_code_hash(thing: Any) -> str:
    """SHA-256 of the source behind a function or class that a user has registered; "" for one of ours.

    It is that of all modules of its package, or of its file, or of itself in a notebook. Where there is no source it
    is of this process alone, so that nothing is served from before.
    """
    total = hashlib.sha256()
    while isinstance(thing, partial):
        total.update(f"{thing.args} {thing.keywords}\n".encode())
        thing = thing.func
    module = sys.modules.get(getattr(thing, "__module__", ""))
    package = sys.modules.get("" if module is None else module.__name__.partition(".")[0])
    if package is not None and package.__name__ in _PACKAGES:
        return ""
    file = getattr(module, "__file__", None)
    code = sources_hash(getattr(package, "__path__", ()), None if file is None else Path(file))
    if not code:
        try:
            code = source_hash(textwrap.dedent(inspect.getsource(thing)).encode())
        except (OSError, TypeError):
            code = uuid.uuid4().hex
    total.update(code.encode())
    return total.hexdigest()


def sources_hash(folders: Iterable[str], file: Path | None) -> str:
    """SHA-256 of the modules of a package, by its folders, else of a module's file; "" where neither is there."""
    files = [path for folder in folders for path in _python_files(Path(folder))]
    if files:
        return hashlib.sha256("".join(f"{path.name} {_code_sha256(path)}\n" for path in files).encode()).hexdigest()
    return _code_sha256(file) if file is not None and file.is_file() else ""


def _code_sha256(path: Path) -> str:
    return read_source(path.read_bytes()).sha256 if path.suffix == ".py" else file_sha256(path)


def _python_files(folder: Path) -> list[Path]:
    """Return the Python files at any depth of a folder, sorted, without those in hidden folders."""
    return sorted(
        path
        for path in folder.rglob("*.py")
        if not any(part.startswith(".") for part in path.relative_to(folder).parts)
    )


def versions_with(entry: str, *things: Any) -> dict[str, str]:
    """`package_versions` of a module, and the `own_code_hash` of functions and classes that a user has registered."""
    own = {f"{thing.__module__}.{thing.__qualname__}": own_code_hash(thing) for thing in things}
    return {**package_versions(entry), **{name: code for name, code in own.items() if code}}


def code_files(entry: str, root: Path = _REPOSITORY) -> list[Path]:
    """Sources of `imported_modules` and their data, sorted.

    Data are files in the folders of these modules, and below in folders without modules: tables of LiDAR presets.
    """
    sources = set(imported_modules(entry, root).values())
    return sorted(sources | {path for folder in {path.parent for path in sources} for path in _data(folder)})


@cache
def imported_modules(entry: str, root: Path) -> dict[str, Path]:
    """Files by name of a module and of all modules that it imports at any depth.

    The `__init__` of a package counts too, but for those of the outermost packages, which no module inside imports.

    Args:
        root: folder of the packages; modules elsewhere are left out.
    """
    found: dict[str, Path] = {}
    waiting = [entry]
    while waiting:
        name = waiting.pop()
        path = _source(root, name)
        if name in found or path is None:
            continue
        found[name] = path
        waiting += [name.rpartition(".")[0], *_imports(path, name)]
    return found


def _source(root: Path, name: str) -> Path | None:
    """File of a module; None for another package's, for an outermost package and for names in a module."""
    if not name.startswith(tuple(f"{package}." for package in _PACKAGES)):
        return None
    place = root.joinpath(*name.split("."))
    return next((path for path in (place.with_suffix(".py"), place / "__init__.py") if path.is_file()), None)


def _imports(path: Path, name: str) -> tuple[str, ...]:
    """Return the names that a module imports: modules, and names that may be modules of a package."""
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    found: list[str] = []
    for level, module, names in read_source(path.read_bytes()).imports:
        parts = package.split(".")[: len(package.split(".")) - level + 1] if level else []
        base = ".".join([*parts, *([module] if module else [])])
        found += [base, *(f"{base}.{one}" for one in names)]
    return tuple(found)


def _data(folder: Path) -> Iterator[Path]:
    for path in folder.iterdir():
        if path.name.startswith((".", "__pycache__")):
            continue
        if path.is_file() and path.suffix not in (".py", ".pyc", ".md"):
            yield path
        elif path.is_dir() and not any(path.rglob("*.py")):
            yield from (below for below in path.rglob("*") if below.is_file() and not below.name.startswith("."))
