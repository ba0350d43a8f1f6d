"""Property tests draw the same few examples in every run; `make test-explore` draws more, and new ones."""

import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

AT_IMPORT = re.compile(r"^\S.*\bimportorskip\(", re.MULTILINE)
"""An optional package that all tests of a file need."""

settings.register_profile("steady", derandomize=True, deadline=None, max_examples=40)
settings.register_profile("explore", deadline=None, print_blob=True)
settings.load_profile("steady")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark as `extra` the tests that call `importorskip`, or whose fixtures or files do."""
    whole = {path: bool(AT_IMPORT.search(path.read_text())) for path in {item.path for item in items}}
    for item in items:
        if not isinstance(item, pytest.Function):
            continue
        fixtures = [one.func for name in item.fixturenames for one in item._fixtureinfo.name2fixturedefs.get(name, ())]
        codes = [inspect.unwrap(made).__code__ for made in (item.function, *fixtures) if inspect.isfunction(made)]
        if whole[item.path] or any("importorskip" in code.co_names for code in codes):
            item.add_marker("extra")


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
