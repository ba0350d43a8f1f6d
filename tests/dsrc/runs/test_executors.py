"""Executors: results of any number of workers are the same, and a dead worker loses no item."""

import os
import signal
import time
from pathlib import Path
from typing import NamedTuple

import pytest

from dsrc.runs.executors import EXECUTORS, Pool, ProcessExecutor, Progress, SerialExecutor
from sim.errors import DataError, SettingsError


def square(item: int, report: Progress) -> int:
    report(1, 2)
    report(2, 2)
    return item * item


def picky(item: int, report: Progress) -> int:
    if item == 1:
        raise DataError("item 1: no such thing")
    return item


def buggy(item: int, report: Progress) -> int:
    return 1 // item


def dies_once(item: tuple[Path, int], report: Progress) -> int:
    """Die without a word, the way a process does that the system kills, the first time that the item is made."""
    mark = item[0] / str(item[1])
    if item[1] % 2 == 0 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return item[1]


def dies(item: int, report: Progress) -> int:
    if item == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return item


def process_id(item: int, report: Progress) -> int:
    time.sleep(0.3)
    return os.getpid()


class Grouped(NamedTuple):
    group: str
    wait_s: float


def process_of(item: Grouped, report: Progress) -> int:
    time.sleep(item.wait_s)
    return os.getpid()


def products(item: int, report: Progress) -> str | None:
    return os.environ.get("OPENBLAS_NUM_THREADS")


@pytest.mark.parametrize("executor", [SerialExecutor(), ProcessExecutor(1), ProcessExecutor(3)])
def test_all_items_are_made_by_any_executor(executor: SerialExecutor | ProcessExecutor) -> None:
    told: list[tuple[int, int, int]] = []
    with executor as pool:
        made = {outcome.row: outcome.value for outcome in pool.run(square, range(5), lambda *p: told.append(p))}
        assert made == {row: row * row for row in range(5)}
        assert sorted(told) == [(row, done, 2) for row in range(5) for done in (1, 2)]
        assert [outcome.value for outcome in pool.run(square, [7])] == [49]


@pytest.mark.parametrize("workers", [1, 2])
def test_a_users_error_ends_its_item_and_no_other(workers: int) -> None:
    with Pool(workers).open() as pool:
        outcomes = {outcome.row: outcome for outcome in pool.run(picky, range(4))}
    assert [outcomes[row].value for row in (0, 2, 3)] == [0, 2, 3]
    assert isinstance(outcomes[1].error, DataError) and str(outcomes[1].error) == "item 1: no such thing"


def test_a_bug_keeps_its_stack_trace() -> None:
    with ProcessExecutor(2) as pool, pytest.raises(RuntimeError, match=r"(?s)in buggy.*ZeroDivisionError"):
        list(pool.run(buggy, [0]))


def test_items_whose_workers_are_killed_are_made_again(tmp_path: Path) -> None:
    with ProcessExecutor(2) as pool:
        made = [outcome.value for outcome in pool.run(dies_once, [(tmp_path, row) for row in range(5)])]
    assert sorted(made) == list(range(5)) and len(list(tmp_path.iterdir())) == 3


def test_an_item_that_kills_every_worker_is_given_up_and_the_others_are_made() -> None:
    with ProcessExecutor(2, retries=1) as pool:
        outcomes = {outcome.row: outcome for outcome in pool.run(dies, range(4))}
    assert [outcomes[row].value for row in (0, 2, 3)] == [0, 2, 3]
    assert "its worker process has died 2 times" in str(outcomes[1].error)


def test_workers_work_at_the_same_time_and_end_with_their_executor() -> None:
    with ProcessExecutor(2) as pool:
        workers = {outcome.value for outcome in pool.run(process_id, range(4))}
        assert len(workers) == 2 and os.getpid() not in workers
    for worker in workers:
        with pytest.raises(ProcessLookupError):
            os.kill(worker, 0)


def test_a_worker_goes_on_with_its_group() -> None:
    items = [Grouped(name, 0.05 if name == "a" else 0.4) for name in "aabbacb"]
    with ProcessExecutor(2) as pool:
        process = {outcome.row: outcome.value for outcome in pool.run(process_of, items)}
    assert process[0] == process[1] == process[4] != process[2]
    assert process[5] == process[0] and process[3] == process[2]


def test_workers_leave_matrix_products_to_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    with ProcessExecutor(1) as pool:
        assert [outcome.value for outcome in pool.run(products, [0])] == ["1"]
    assert "OPENBLAS_NUM_THREADS" not in os.environ


def test_wrong_settings_are_named() -> None:
    assert set(EXECUTORS) == {"local", "ray"}
    with pytest.raises(SettingsError, match="pool: executor: expected an executor, found rai; did you mean 'ray'"):
        Pool(executor="rai").open()  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match="workers: expected at least 1, found 0"):
        Pool(0).open()
    with pytest.raises(SettingsError, match="is that of a Ray cluster; add --executor ray"):
        Pool(1, address="auto").open()


def test_a_pool_starts_no_more_workers_than_there_are_items() -> None:
    assert isinstance(Pool(8).open(1), SerialExecutor) and isinstance(Pool(8).open(2), ProcessExecutor)
    assert Pool(1).open().threads is None and Pool(2).open().threads == 1


@pytest.mark.parametrize(("cores", "executor"), [(1, SerialExecutor), (2, ProcessExecutor)])
def test_a_pool_has_a_worker_for_each_core_unless_told(
    cores: int, executor: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dsrc.runs.executors.core_count", lambda: cores)
    assert isinstance(Pool().open(), executor)
