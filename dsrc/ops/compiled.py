"""Compiled loops: options of numba, whose results are cached on disk where a folder can be written."""

import logging
from typing import Any

from numba import njit

log = logging.getLogger(__name__)


def _is_cached() -> bool:
    """Return whether numba has a folder for its cache: beside this file, the user's cache or NUMBA_CACHE_DIR."""
    try:
        njit(cache=True)(_is_cached)
    except RuntimeError:
        log.warning("no folder to keep compiled loops in: each process compiles them; NUMBA_CACHE_DIR names one")
        return False
    return True


LOOP: dict[str, Any] = {"nogil": True, "cache": _is_cached(), "error_model": "numpy"}
"""Options of a loop."""
PART: dict[str, Any] = {**LOOP, "forceinline": True}
"""Options of a part of a loop, which is inlined."""
