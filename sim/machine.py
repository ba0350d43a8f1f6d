"""Machine: cores and memory of this process, and versions of installed packages."""

import ctypes
import os
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version


def core_count() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def keep_memory(limit: int = 1 << 30) -> None:
    """Keep freed memory for the next allocation, up to a limit in bytes, with the GNU C library; nothing with others.

    By default it gives blocks of 32 MB and more back at once: the maps of a network then come anew in every pass, as
    pages that the kernel clears one by one.
    """
    trim_threshold, mmap_threshold = -1, -3
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return
    # Versions that refuse so much take 32 MB at most; then nothing is changed.
    if mallopt(mmap_threshold, limit):
        mallopt(trim_threshold, limit)


def single_thread_products() -> None:
    """Leave matrix products of NumPy to one thread; call it before NumPy is imported, processes started later follow.

    Those of a cloud's points are too small to be shared, and the other threads of OpenBLAS wait for them by spinning:
    a sample of a training takes twice the CPU time. `OPENBLAS_NUM_THREADS` stays where the user has set it.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def installed_versions(names: Sequence[str]) -> dict[str, str]:
    """Return the versions of those distributions that are installed, by name."""
    found = {}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
