"""Executors: run work items in this process, in processes of this machine or on a Ray cluster.

A task is a function of a module (it travels by name), an item a value that can be pickled. Items run in any order, and
results come as they are ready. Items with the same attribute `group` have parts in common that a process keeps in
memory: a process of this machine goes on with the group of its last item. A user's error ends its item only. A worker
that dies is replaced and its item run again, a bounded number of times: tasks are written so that a second try resumes
the first.
"""

import multiprocessing
import os
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from types import TracebackType
from typing import Any, Literal, Protocol, Self

import msgspec

from dsrc.runs.unit import Progress
from sim.errors import DataError, SettingsError, UserError, complaint, did_you_mean
from sim.machine import core_count, single_thread_products

Task = Callable[[Any, Progress], Any]
"""Task: (item, progress) -> value; a function of a module."""

ItemProgress = Callable[[int, int, int], None]
"""Progress callback of many items: (row of the item, its steps done, its steps in all)."""

RETRIES = 2
"""Further tries of an item whose worker has died."""


@dataclass(frozen=True, slots=True)
class TaskResult:
    """Result of one item.

    Attributes:
        row: of the item.
        value: returned by the task.
        error: a user's error or the death of its workers; None for a success.
    """

    row: int
    value: Any = None
    error: UserError | None = None


class Executor(Protocol):
    """Runner of tasks; a context manager that holds its workers.

    Attributes:
        threads: threads that a task may use; None for one per core.
        chunk: frames to put into one item where they are independent; more than 1 where an item starts slowly.
    """

    threads: int | None
    chunk: int

    def run(self, task: Task, items: Sequence[object], progress: ItemProgress | None = None) -> Iterator[TaskResult]:
        """Run a task for all items and yield the results as they are ready.

        Raises:
            RuntimeError: a bug in a task; the message holds its stack trace.
        """
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class SerialExecutor:
    """One item after the other in this process."""

    threads: int | None = None
    chunk = 1

    def run(self, task: Task, items: Sequence[object], progress: ItemProgress | None = None) -> Iterator[TaskResult]:
        """See `Executor`."""
        for row, item in enumerate(items):
            yield _result_of(row, task, item, _reporter(row, progress))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        pass


class ProcessExecutor:
    """Spawned processes of this machine, which end with this one however it ends.

    Args:
        retries: see `RETRIES`.
    """

    threads: int | None = 1
    chunk = 1

    def __init__(self, workers: int, retries: int = RETRIES) -> None:
        self._count, self._retries = workers, retries
        self._workers: list[_Worker] = []

    def run(self, task: Task, items: Sequence[object], progress: ItemProgress | None = None) -> Iterator[TaskResult]:
        """See `Executor`."""
        waiting, deaths = deque(range(len(items))), [0] * len(items)
        while waiting or any(worker.row is not None for worker in self._workers):
            busy = sum(worker.row is not None for worker in self._workers)
            while len(self._workers) < min(self._count, busy + len(waiting)):
                self._workers.append(_Worker())
            for worker in self._workers:
                if worker.row is None and waiting:
                    row = _next(waiting, items, worker.group, {other.group for other in self._workers})
                    waiting.remove(row)
                    worker.give(row, task, items[row])
            ready = wait([worker.pipe for worker in self._workers if worker.row is not None])
            for worker in [worker for worker in self._workers if worker.pipe in ready]:
                row = -1 if worker.row is None else worker.row
                try:
                    message = worker.pipe.recv()
                except (EOFError, ConnectionError):
                    self._workers.remove(worker)
                    worker.end()
                    deaths[row] += 1
                    if deaths[row] <= self._retries:
                        waiting.append(row)
                    else:
                        yield TaskResult(row, error=_died(deaths[row]))
                    continue
                if isinstance(message, TaskResult):
                    worker.row = None
                    yield message
                elif isinstance(message, str):
                    raise RuntimeError(f"in a worker process:\n{message}")
                elif progress is not None:
                    progress(row, *message)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        for worker in self._workers:
            worker.end()
        self._workers.clear()


class RayExecutor:
    """Ray cluster, or Ray on this machine; tasks write to disks that all machines share.

    Args:
        workers: processors of this machine to use when there is no cluster.
        address: of a cluster, as `ray start` prints it, or `auto`; "" starts Ray here.
        retries: see `RETRIES`.
    """

    threads: int | None = 1
    chunk = 16

    def __init__(self, workers: int, address: str = "", retries: int = RETRIES) -> None:
        try:
            import ray
        except ImportError:
            hint = "; run: pip install ray"
            raise SettingsError(complaint("pool", "executor ray", "the package ray", "none", hint)) from None
        self._ray, self._workers, self._address, self._retries = ray, workers, address, retries
        self._started = False

    def run(self, task: Task, items: Sequence[object], progress: ItemProgress | None = None) -> Iterator[TaskResult]:
        """See `Executor`; progress is reported per item."""
        # A fresh process for every item, as libsumo wants it; Ray runs an item again whose process has died.
        remote = self._ray.remote(num_cpus=1, max_retries=self._retries, max_calls=1)(_ray_task)
        rows = {remote.remote(row, task, item, os.getcwd()): row for row, item in enumerate(items)}
        left = list(rows)
        while left:
            done, left = self._ray.wait(left, num_returns=1)
            for one in done:
                try:
                    result = self._ray.get(one)
                except self._ray.exceptions.RayTaskError as error:
                    raise RuntimeError(f"in a worker of Ray:\n{error}") from None
                except self._ray.exceptions.RayError:
                    result = TaskResult(rows[one], error=_died(self._retries + 1))
                if progress is not None and result.error is None:
                    progress(result.row, 1, 1)
                yield result

    def __enter__(self) -> Self:
        if not self._ray.is_initialized():
            quiet: dict[str, Any] = {"log_to_driver": False, "configure_logging": False}
            here = {"num_cpus": self._workers, "include_dashboard": False}
            try:
                self._ray.init(**quiet, **({"address": self._address} if self._address else here))
            except (ConnectionError, RuntimeError, ValueError) as error:
                text = f"{self._address}: {' '.join(str(error).split())}"
                raise SettingsError(complaint("pool", "address", "a Ray cluster", text)) from None
            self._started = True
        return self

    def __exit__(self, *exc: object) -> None:
        if self._started:
            self._ray.shutdown()


def _local(workers: int, address: str) -> Executor:
    if address:
        raise SettingsError(f"pool: --address {address} is that of a Ray cluster; add --executor ray")
    return SerialExecutor() if workers == 1 else ProcessExecutor(workers)


EXECUTORS: dict[str, Callable[[int, str], Executor]] = {"local": _local, "ray": RayExecutor}
"""Executors by name: (workers, address) -> executor; `local` with one worker is this process."""


class Pool(msgspec.Struct, frozen=True):
    """Worker pool of a command; the results are the same bytes for any.

    Attributes:
        workers: worker processes, or CPUs of Ray; default: one per core.
        executor: local, or ray for a cluster whose machines share the folder of the results.
        address: address of a Ray cluster, as `ray start` prints it, or auto; default: Ray on this machine.
    """

    workers: int | None = None
    executor: Literal["local", "ray"] = "local"
    address: str = ""

    def open(self, items: int | None = None) -> Executor:
        """Return the executor, a context manager that holds the workers.

        Args:
            items: work items; no more workers than these are started.

        Raises:
            SettingsError: the executor is unknown, its package is missing or a setting is out of its range.
        """
        if self.executor not in EXECUTORS:
            hint = did_you_mean(self.executor, EXECUTORS)
            raise SettingsError(complaint("pool", "executor", "an executor", self.executor, hint))
        workers = core_count() if self.workers is None else self.workers
        if workers < 1:
            raise SettingsError(complaint("pool", "workers", "at least 1", workers))
        return EXECUTORS[self.executor](workers if items is None else max(1, min(workers, items)), self.address)


SERIAL = Pool(workers=1)
"""This process alone."""


def _next(waiting: deque[int], items: Sequence[object], own: Hashable, all_held: set[Hashable]) -> int:
    """Return the row for a worker: of its own group, else the first of a group that no worker holds, else the first."""

    def rank(row: int) -> int:
        group = _group(items[row])
        return 1 if group is None else 0 if group == own else 2 if group in all_held else 1

    return min(waiting, key=rank)


def _group(item: object) -> Hashable:
    return getattr(item, "group", None)


def _died(times: int) -> DataError:
    return DataError(f"its worker process has died {times} times, of memory perhaps; start again to resume")


def _reporter(row: int, progress: ItemProgress | None) -> Progress:
    return lambda done, wanted: progress(row, done, wanted) if progress is not None else None


def _result_of(row: int, task: Task, item: object, report: Progress) -> TaskResult:
    try:
        return TaskResult(row, task(item, report))
    except UserError as error:
        return TaskResult(row, error=error)


def _ray_task(row: int, task: Task, item: object, folder: str) -> TaskResult:
    if os.path.isdir(folder):  # relative paths are those of this process
        os.chdir(folder)
    return _result_of(row, task, item, lambda done, wanted: None)


class _Worker:
    """Worker process, the row of its item, and the group of its last one."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.row: int | None = None
        self.group: Hashable = None
        self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
        with _without_interrupts(), _single_thread_products():
            self._process.start()
        theirs.close()

    def give(self, row: int, task: Task, item: object) -> None:
        self.row, self.group = row, _group(item)
        try:
            self.pipe.send((row, task, item))
        except ConnectionError:
            pass  # died while idle: noticed when its pipe is read

    def end(self) -> None:
        self.pipe.close()
        self._process.kill()
        self._process.join()


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Block SIGINT and SIGTERM, also for processes that start within the block, from their first moment on.

    A process whose parent is interrupted while it starts would end with a stack trace.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _single_thread_products() -> Iterator[None]:
    """Leave matrix products to one thread in processes that start within the block, and in no others."""
    told = "OPENBLAS_NUM_THREADS" in os.environ
    single_thread_products()
    try:
        yield
    finally:
        if not told:
            del os.environ["OPENBLAS_NUM_THREADS"]


def _serve(pipe: Connection) -> None:
    """Run items until the pipe closes; interrupts are left to the parent, whose end is the worker's too."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    threading.Thread(target=_follow_parent, daemon=True).start()
    while True:
        try:
            row, task, item = pipe.recv()
        except EOFError:
            return
        try:
            result = _result_of(row, task, item, lambda done, wanted: pipe.send((done, wanted)))
        except Exception:  # a bug: the parent shows its stack trace
            pipe.send(traceback.format_exc())
            return
        pipe.send(result)


def _follow_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
