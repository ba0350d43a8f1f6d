"""Tables that take a moment to compute, kept as npz files in the user's cache."""

import logging
import os
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.networks import cache_folder

log = logging.getLogger(__name__)


def cached_tables(
    name: str, compute: Callable[[], Mapping[str, NDArray[np.float64]]], folder: Path | None = None
) -> dict[str, NDArray[np.float64]]:
    """Return tables from the cache, computing them when they are not there or the file is damaged.

    The file appears at once or not at all, so processes may share it; where nothing can be written the tables are
    computed every time.

    Args:
        name: of the file, without its ending; whatever the tables depend on is part of it.
        compute: makes the tables.
        folder: instead of `tables` in the user's cache (see `sim.networks.cache_folder`).
    """
    path = (cache_folder() / "tables" if folder is None else folder) / f"{name}.npz"
    tables = _read(path)
    if tables is None:
        tables = dict(compute())
        _write(path, tables)
    return tables


def _read(path: Path) -> dict[str, NDArray[np.float64]] | None:
    """Return the tables of a file, None when it is not there or damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return {key: np.asarray(file[key], np.float64) for key in file.files}
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, EOFError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        log.warning("%s: damaged, computed anew: %s", path, error)
        return None


def _write(path: Path, tables: Mapping[str, NDArray[np.float64]]) -> None:
    temporary = path.with_name(f"{path.stem}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, **tables)
        temporary.replace(path)
    except OSError as error:
        log.info("%s: not kept: %s", path, error)
        temporary.unlink(missing_ok=True)
