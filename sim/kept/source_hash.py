"""Hash of what a Python source computes: its syntax tree, without what changes no result.

Comments, layout, docstrings, blocks for type checkers and annotations of functions and variables do not count.
Annotations in the body of a class do, since they decide its fields, and those of a decorated function's parameters and
result, since its decorator may read them.
"""

import ast
import hashlib
from collections.abc import Iterator
from itertools import groupby

_SILENT = {"annotation", "returns"}
"""Annotations."""
_UNSAID = {"ctx", "kind", "type_comment", "type_ignores"}
"""Fields that follow from others, or that say how a value is written."""


def source_hash(source: bytes) -> str:
    """SHA-256 of what a source computes, the same for every release of Python; of its bytes where it is no Python."""
    try:
        return tree_hash(ast.parse(source))
    except (SyntaxError, ValueError, RecursionError):
        return hashlib.sha256(source).hexdigest()


def tree_hash(tree: ast.Module) -> str:
    """SHA-256 of a syntax tree, see `source_hash`."""
    words: list[str] = []
    _read(tree, words, False, False)
    return hashlib.sha256("\0".join(words).encode("utf-8", "surrogatepass")).hexdigest()


def for_type_checkers(node: ast.AST) -> bool:
    """Whether a statement is an `if TYPE_CHECKING`."""
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def _read(node: ast.AST, words: list[str], in_class: bool, decorated: bool) -> None:
    """Append a node to the words.

    Empty fields are left out and others named, so that a field that a later Python adds changes nothing.

    Args:
        in_class: it lies in the body of a class, not in that of a function.
        decorated: it is the signature of a decorated function.
    """
    if isinstance(node, ast.AnnAssign) and not in_class and node.value is not None:
        node = ast.Assign([node.target], node.value)
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        in_class, decorated = False, bool(node.decorator_list)
    in_class = in_class or isinstance(node, ast.ClassDef)
    words.append(type(node).__name__)
    for name in node._fields:
        value = getattr(node, name, None)
        if value is None or value == [] or name in _UNSAID or (name in _SILENT and not (in_class or decorated)):
            continue
        words.append(name)
        if isinstance(value, ast.AST):
            _read(value, words, in_class, decorated)
        elif isinstance(value, list):
            for one in _joined(value) if isinstance(node, ast.JoinedStr) else value:
                if not isinstance(one, ast.AST):
                    words.append(f"{len(str(one))} {one}")
                elif not _does_nothing(one):
                    _read(one, words, in_class, decorated and name != "body")
        else:
            words.append(f"{len(value)} {value}" if isinstance(value, str) else f"{type(value).__name__} {value!r}")
    words.append(")")


def _does_nothing(node: ast.AST) -> bool:
    """Whether a statement does nothing, as a docstring."""
    constant = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    return constant or isinstance(node, ast.Pass) or (for_type_checkers(node) and not getattr(node, "orelse", ()))


def _joined(parts: list[ast.expr]) -> Iterator[ast.expr]:
    """Yield the parts of an f-string, neighbouring texts as one: releases of Python split them differently."""
    for text, several in groupby(parts, lambda part: isinstance(part, ast.Constant)):
        if not text:
            yield from several
        elif whole := "".join(str(one.value) for one in several if isinstance(one, ast.Constant)):
            yield ast.Constant(whole)
