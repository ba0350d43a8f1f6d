"""Cache folder of generated and fetched files."""

import hashlib
import json
import os
import tempfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path


def cache_folder() -> Path:
    """Return the cache folder: $DSRC_CACHE, else dsrc-testbed in the user's cache."""
    base = os.environ.get("DSRC_CACHE")
    if base:
        return Path(base)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dsrc-testbed"


def cached(kind: str, name: str, ending: str, key: object, make: Callable[[Path], None]) -> Path:
    """Return a cached file or folder, made once per key; safe with other processes.

    Args:
        name: prefix of the file name.
        ending: suffix of the file name.
        key: everything that the content depends on; the version of eclipse-sumo is added.
        make: creates the file or folder at a given path.
    """
    digest = hashlib.sha256(json.dumps([key, version("eclipse-sumo")]).encode()).hexdigest()[:16]
    folder = cache_folder() / kind
    target = folder / f"{name}-{digest}{ending}"
    if target.exists():
        return target
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as work:
        made = Path(work) / f"made{ending}"
        make(made)
        try:
            os.replace(made, target)
        except OSError:
            if not target.is_dir():  # another process was faster
                raise
    return target
