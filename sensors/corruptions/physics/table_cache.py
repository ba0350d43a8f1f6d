"""Cache of computed tables: npz files in the user's cache folder."""

import logging
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.files import replacing
from sim.roads.cache import cache_folder

log = logging.getLogger(__name__)

Tables = dict[str, NDArray[np.float64]]


def cached_tables(
    name: str, shapes: Mapping[str, tuple[int, ...]], compute: Callable[[], Tables], folder: Path | None = None
) -> Tables:
    """Return tables from the cache, computed where they are missing or the file is damaged.

    The file appears at once or not at all, so processes may share it; where the cache is not writable the
    tables are computed every time.

    Args:
        name: of the file, without its ending; contains all that the tables depend on.
        folder: instead of `tables` in the user's cache (see `sim.roads.cache.cache_folder`).
    """
    path = (cache_folder() / "tables" if folder is None else folder) / f"{name}.npz"
    try:
        return _read(path, shapes)
    except FileNotFoundError:
        pass
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        log.warning("%s: damaged, computed anew: %s", path, error)
    tables = compute()
    try:
        with replacing(path, edited=True) as temporary, temporary.open("wb") as file:
            np.savez(file, **dict[str, Any](tables))
    except OSError as error:
        log.info("%s: not kept: %s", path, error)
    return tables


def _read(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> Tables:
    # Opened here, because numpy leaves a damaged file open.
    with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
        tables = {key: np.asarray(stored[key], np.float64) for key in shapes}
    for key, shape in shapes.items():
        if tables[key].shape != shape or not np.isfinite(tables[key]).all():
            raise ValueError(f"{key}: expected {shape} finite numbers")
    return tables
