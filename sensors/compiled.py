"""Compiled loops: numba, whose results are cached on disk where a folder can be written."""

import hashlib
import inspect
import logging
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from numba import njit
from numba.core import event

log = logging.getLogger(__name__)


def compiled(*parts: ModuleType, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a loop.

    The files of the cache are named after the hash of the source. numba compares sources only after it has read the
    index, which names the types of the arguments: a renamed type made an old index unreadable, an error for good.

    Args:
        parts: other modules whose code is compiled in.
    """
    options = {"nogil": True, "error_model": "numpy", **options}

    def decorate(function: Callable[..., Any]) -> Any:
        files = [inspect.getfile(function), *(inspect.getfile(part) for part in parts)]
        source = b"".join(Path(file).read_bytes() for file in files)
        function.__qualname__ += f"_{hashlib.sha256(source).hexdigest()[:8]}"
        try:
            return njit(cache=True, **options)(function)
        except RuntimeError:  # no such folder
            _warn()
            return njit(**options)(function)

    return decorate


class _Compiling(event.Listener):
    """Says once that loops are compiled, which takes up to minutes in silence."""

    _said = False

    def on_start(self, begun: event.Event) -> None:
        """Compilation of a loop that no file holds begins."""
        if not self._said:
            log.info("compiling loops for this processor, once; a minute or so")
            self._said = True

    def on_end(self, done: event.Event) -> None:
        """Compilation of a loop is over."""


event.register("numba:compile", _Compiling())


@cache
def _warn() -> None:
    log.warning("no folder to keep compiled loops in: each process compiles them anew; NUMBA_CACHE_DIR names one")
