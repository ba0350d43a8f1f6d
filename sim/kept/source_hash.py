"""Hash of what a Python source computes: comments, docstrings and annotations of functions change nothing in it.

The syntax tree is walked by its fields, not dumped: `ast.dump` and `ast.unparse` differ between versions of Python.
"""

import ast
import hashlib
from functools import cache
from pathlib import Path

_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
_SILENT = ("ctx", "returns", "annotation", "simple", "type_comment", "type_ignores")
"""Fields that compute nothing, but for those of a class's own fields."""


def source_hash(source: bytes, name: str = "<source>") -> str:
    """SHA-256 of what a source computes.

    The annotations of a class's fields count: structs and dataclasses are made of them.

    Args:
        source: Python.
        name: file name, for the error.

    Raises:
        SyntaxError: the source is no Python of this version.
    """
    text: list[str] = []
    _write(ast.parse(source, name), text, in_class=False)
    return hashlib.sha256("".join(text).encode("utf-8", "surrogatepass")).hexdigest()


def source_file_hash(path: Path) -> str:
    """`source_hash` of a file, computed once per process and state of the file."""
    state = path.stat()
    return _of_file(path, state.st_mtime_ns, state.st_size)


@cache
def _of_file(path: Path, _changed_ns: int, _size: int) -> str:
    return source_hash(path.read_bytes(), str(path))


def _write(node: object, text: list[str], in_class: bool) -> None:
    """Append a node as text.

    Args:
        node: node of a syntax tree, or a value in one.
        text: what is written so far.
        in_class: the node is a statement of a class's body, not of a function's.
    """
    if not isinstance(node, ast.AST):
        text.append(f"{node!r};")
        return
    if isinstance(node, ast.Constant):
        text.append(f"{type(node.value).__name__} {node.value!r};")
        return
    field = in_class and isinstance(node, ast.AnnAssign)
    # A variable with an annotation is one without.
    kind = "Assign" if isinstance(node, ast.AnnAssign) and not field else type(node).__name__
    text.append(f"{kind}(")
    inside = isinstance(node, ast.ClassDef) or (in_class and not isinstance(node, _FUNCTIONS))
    for name, value in ast.iter_fields(node):
        if value is None or value == [] or (name in _SILENT and not field):
            continue
        text.append(f"{'targets' if kind == 'Assign' and name == 'target' else name}=")
        for part in value if isinstance(value, list) else [value]:
            if not _does_nothing(part, inside):
                _write(part, text, inside)
    text.append(")")


def _does_nothing(node: object, in_class: bool) -> bool:
    """Return whether a node is a docstring, `pass`, a bare annotation, or imports for type checkers alone."""
    if isinstance(node, ast.AnnAssign):
        return node.value is None and not in_class
    if isinstance(node, ast.If):
        return isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING" and not node.orelse
    return isinstance(node, ast.Pass) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))
