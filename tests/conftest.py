"""Property tests draw the same examples in every run; `make test-explore` draws new ones."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("steady", derandomize=True, deadline=None)
settings.register_profile("explore", deadline=None, print_blob=True)
settings.load_profile("steady")


@pytest.fixture(scope="session", autouse=True)
def _one_core() -> Iterator[None]:
    """Commands that are not told how many workers to take compute in this process: each worker imports PyTorch anew.

    Tests of workers say how many.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dsrc.runs.executors.core_count", lambda: 1)
        yield


@pytest.fixture
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Cache folder with nothing in it, of which the process remembers nothing else."""
    from tests.cache import forget  # what it imports is heavy, and few tests need it

    monkeypatch.setenv("DSRC_CACHE", str(tmp_path))
    forget()
    yield tmp_path
    forget()
