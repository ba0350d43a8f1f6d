"""What a Python source computes and imports, remembered in the cache folder by the hash of its bytes.

Reading all sources behind an evaluation takes two seconds of CPU, in every process that names a kept file.
"""

import ast
import hashlib
import threading
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple

import msgspec

from sim.files import write_file
from sim.kept.source_hash import for_type_checkers, source_hash, tree_hash
from sim.roads.cache import cache_folder

_IMPORTS = (ast.Import, ast.ImportFrom, ast.Call)
_MOST = 5000
"""Sources in the file; beyond it, those are left that the writing process has read."""
_lock = threading.Lock()
"""Two threads that parse at once confuse Python 3.11's count of the depth (python/cpython#106905)."""


class Imported(NamedTuple):
    """Import in a source.

    Attributes:
        level: dots before the module.
        module: its name; "" where there are dots alone.
        names: what is taken from it, modules perhaps.
    """

    level: int
    module: str
    names: tuple[str, ...] = ()


class Source(NamedTuple):
    """What is known of a source.

    Attributes:
        sha256: of what it computes, see `source_hash`.
        imports: at any depth, without those for type checkers; none of one that is no Python.
    """

    sha256: str
    imports: tuple[Imported, ...]


@cache
def read_source(content: bytes) -> Source:
    """Return what a source computes and imports."""
    key = hashlib.sha256(content).hexdigest()
    known = _remembered(_path()).get(key)
    if known is None:
        with _lock:
            known = _parsed(content)
    _used[key] = known
    return known


_used: dict[str, Source] = {}


def remember() -> None:
    """Write what this process has read to the cache folder, if that is new; nothing where it cannot be written."""
    path = _path()
    known = _remembered(path)
    if _used.keys() - known.keys():
        known |= _used
        kept = known if len(known) <= _MOST else dict(_used)
        with suppress(OSError):
            write_file(path, msgspec.json.encode(kept))


@cache
def _path() -> Path:
    """File of the cache folder, by the code that reads sources."""
    sources = (Path(__file__), Path(__file__).with_name("source_hash.py"))
    return (
        cache_folder() / "code" / f"{hashlib.sha256(b''.join(p.read_bytes() for p in sources)).hexdigest()[:32]}.json"
    )


@cache
def _remembered(path: Path) -> dict[str, Source]:
    """Return the sources by the hash of their bytes; none of a file that is absent or damaged."""
    with suppress(OSError, msgspec.DecodeError):
        return msgspec.json.decode(path.read_bytes(), type=dict[str, Source])
    return {}


def _parsed(content: bytes) -> Source:
    try:
        tree = ast.parse(content)
    except (SyntaxError, ValueError):
        return Source(source_hash(content), ())
    nodes = _run(tree, b"import_module" in content)
    return Source(tree_hash(tree), tuple(one for node in nodes if isinstance(node, _IMPORTS) for one in _imports(node)))


def _imports(node: ast.Import | ast.ImportFrom | ast.Call) -> Iterator[Imported]:
    if isinstance(node, ast.ImportFrom):
        yield Imported(node.level, node.module or "", tuple(alias.name for alias in node.names))
    elif isinstance(node, ast.Import):
        yield from (Imported(0, alias.name) for alias in node.names)
    elif isinstance(node.func, ast.Name) and node.func.id == "import_module":
        said = (arg.value for arg in node.args if isinstance(arg, ast.Constant))
        yield from (Imported(0, name) for name in said if isinstance(name, str))


def _run(tree: ast.AST, expressions: bool) -> Iterator[ast.AST]:
    """Yield the nodes of a tree without those for type checkers alone.

    Args:
        expressions: yield those inside expressions too, where no statement can be.
    """
    waiting = [tree]
    while waiting:
        for node in ast.iter_child_nodes(waiting.pop()):
            if for_type_checkers(node):
                continue
            yield node
            if expressions or not isinstance(node, ast.expr):
                waiting.append(node)
