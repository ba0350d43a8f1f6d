"""Notices of models that lack what they need and go on without it."""

import logging
from functools import lru_cache

_log = logging.getLogger(__name__)


@lru_cache(maxsize=64)
def notice(text: str) -> None:
    """Log a warning, each text once per process: a drive has thousands of sweeps of one kind."""
    _log.warning("%s", text)
