"""The folder of everything that is made or fetched once."""

import hashlib
import json
import os
import tempfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path


def cache_folder() -> Path:
    """Return the folder: $DSRC_CACHE, else dsrc-testbed in the user's cache."""
    base = os.environ.get("DSRC_CACHE")
    if base:
        return Path(base)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dsrc-testbed"


def cached(kind: str, name: str, ending: str, key: object, make: Callable[[Path], None]) -> Path:
    """Return a file or folder of the cache, made once per key; other processes may make it at the same time.

    Args:
        kind: folder of the cache.
        name: begins the name of the file.
        ending: of its name.
        key: everything that its content depends on, but for the version of eclipse-sumo, which is added.
        make: makes it at the path that it is given.
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
