"""Executors: who makes the work items of a dataset, here, in processes of this machine or on a cluster.

An item is made by a function of a module (it travels by name) from a value that can be pickled, in any order; results
come as they are ready. A user's error ends its item, the others go on. A worker that dies is replaced and its item made
again, a bounded number of times: items are to be made so that a second try goes on where the first was cut.
"""

import multiprocessing
import os
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from types import TracebackType
from typing import Any, Protocol, Self

from sim.errors import DataError, SettingsError, UserError, complaint, did_you_mean

Report = Callable[[int, int], None]
"""Called by a task with (done, wanted) of its item."""

Task = Callable[[Any, Report], Any]
"""A function of a module: (item, report) -> result."""

Progress = Callable[[int, int, int], None]
"""Called with (row of the item, done, wanted)."""

RETRIES = 2
"""How often an item is tried again after its worker has died."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one item.

    Attributes:
        row: of the item.
        value: what the task returned.
        error: of the user, or the death of its workers; None when all went well.
    """

    row: int
    value: Any = None
    error: UserError | None = None


class Executor(Protocol):
    """Makes items; a context manager that holds its workers."""

    def run(self, task: Task, items: Sequence[Any], progress: Progress | None = None) -> Iterator[Outcome]:
        """Make all items and yield what became of each, as they are ready.

        Raises:
            RuntimeError: a task has failed by a bug; the message holds its stack trace.
        """
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class SerialExecutor:
    """Makes one item after the other in this process."""

    def run(self, task: Task, items: Sequence[Any], progress: Progress | None = None) -> Iterator[Outcome]:
        """See `Executor`."""
        for row, item in enumerate(items):
            yield _outcome(row, task, item, _reporter(row, progress))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        pass


class ProcessExecutor:
    """Fresh processes of this machine, which end with this one however it ends.

    Args:
        workers: how many.
        retries: see `RETRIES`.
    """

    def __init__(self, workers: int, retries: int = RETRIES) -> None:
        self._count, self._retries = workers, retries
        self._workers: list[_Worker] = []

    def run(self, task: Task, items: Sequence[Any], progress: Progress | None = None) -> Iterator[Outcome]:
        """See `Executor`."""
        waiting, deaths = deque(range(len(items))), [0] * len(items)
        while waiting or any(worker.row is not None for worker in self._workers):
            busy = sum(worker.row is not None for worker in self._workers)
            while len(self._workers) < min(self._count, busy + len(waiting)):
                self._workers.append(_Worker())
            for worker in self._workers:
                if worker.row is None and waiting:
                    first = waiting.popleft()
                    worker.give(first, task, items[first])
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
                        yield Outcome(row, error=_died(deaths[row]))
                    continue
                if isinstance(message, Outcome):
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
    """A Ray cluster, or Ray's workers on this machine; what tasks write must be on disks that all machines share.

    Args:
        workers: processors of this machine to use, when there is no cluster.
        address: of a cluster, as `ray start` prints it, or `auto`; "" starts Ray here.
        retries: see `RETRIES`.
    """

    def __init__(self, workers: int, address: str = "", retries: int = RETRIES) -> None:
        try:
            import ray
        except ImportError:
            hint = "; run: pip install 'dsrc-testbed[ray]'"
            raise SettingsError(complaint("executor", "ray", "the package ray", "none", hint)) from None
        self._ray, self._workers, self._address, self._retries = ray, workers, address, retries
        self._started = False

    def run(self, task: Task, items: Sequence[Any], progress: Progress | None = None) -> Iterator[Outcome]:
        """See `Executor`; progress is told when an item is done."""
        # Fresh processes for every item, as libsumo wants it; Ray makes an item again whose process has died.
        remote = self._ray.remote(num_cpus=1, max_retries=self._retries, max_calls=1)(_ray_task)
        rows = {remote.remote(row, task, item): row for row, item in enumerate(items)}
        left = list(rows)
        while left:
            done, left = self._ray.wait(left, num_returns=1)
            for one in done:
                try:
                    outcome = self._ray.get(one)
                except self._ray.exceptions.RayTaskError as error:
                    raise RuntimeError(f"in a worker of Ray:\n{error}") from None
                except self._ray.exceptions.RayError:
                    outcome = Outcome(rows[one], error=_died(self._retries + 1))
                if progress is not None and outcome.error is None:
                    progress(outcome.row, 1, 1)
                yield outcome

    def __enter__(self) -> Self:
        if not self._ray.is_initialized():
            quiet: dict[str, Any] = {"log_to_driver": False, "configure_logging": False}
            here = {"num_cpus": self._workers, "include_dashboard": False}
            try:
                self._ray.init(**quiet, **({"address": self._address} if self._address else here))
            except (ConnectionError, RuntimeError, ValueError) as error:
                text = f"{self._address}: {' '.join(str(error).split())}"
                raise SettingsError(complaint("executor", "address", "a Ray cluster", text)) from None
            self._started = True
        return self

    def __exit__(self, *exc: object) -> None:
        if self._started:
            self._ray.shutdown()


def _local(workers: int, address: str) -> Executor:
    if address:
        raise SettingsError(complaint("executor", "address", "none without --executor ray", address))
    return SerialExecutor() if workers == 1 else ProcessExecutor(workers)


EXECUTORS: dict[str, Callable[[int, str], Executor]] = {"local": _local, "ray": RayExecutor}
"""By name: (workers, address) -> executor; `local` with one worker is this process."""


def open_executor(name: str, workers: int | None = None, address: str = "") -> Executor:
    """Return an executor by its name.

    Args:
        name: one of `EXECUTORS`.
        workers: how many; None for one per core.
        address: of a cluster.

    Raises:
        SettingsError: there is no such executor, its package is missing or a setting is out of its range.
    """
    if name not in EXECUTORS:
        raise SettingsError(complaint("executor", "name", "an executor", name, did_you_mean(name, EXECUTORS)))
    workers = cores() if workers is None else workers
    if workers < 1:
        raise SettingsError(complaint("executor", "workers", "at least 1", workers))
    return EXECUTORS[name](workers, address)


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _died(times: int) -> DataError:
    return DataError(f"its worker process has died {times} times, of memory perhaps; start again to go on")


def _reporter(row: int, progress: Progress | None) -> Report:
    return lambda done, wanted: progress(row, done, wanted) if progress is not None else None


def _outcome(row: int, task: Task, item: Any, report: Report) -> Outcome:
    try:
        return Outcome(row, task(item, report))
    except UserError as error:
        return Outcome(row, error=error)


def _ray_task(row: int, task: Task, item: Any) -> Outcome:
    return _outcome(row, task, item, lambda done, wanted: None)


class _Worker:
    """A process and the row of the item that it is making."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.row: int | None = None
        self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()

    def give(self, row: int, task: Task, item: Any) -> None:
        self.row = row
        try:
            self.pipe.send((row, task, item))
        except ConnectionError:
            pass  # it has died while it was idle, which its pipe tells when it is read

    def end(self) -> None:
        self.pipe.close()
        self._process.kill()
        self._process.join()


def _serve(pipe: Connection) -> None:
    """Make items until the pipe ends; leave interrupts to the parent, and end with it however it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow_parent, daemon=True).start()
    while True:
        try:
            row, task, item = pipe.recv()
        except EOFError:
            return
        try:
            outcome = _outcome(row, task, item, lambda done, wanted: pipe.send((done, wanted)))
        except Exception:  # a bug, told with its stack trace where people look
            pipe.send(traceback.format_exc())
            return
        pipe.send(outcome)


def _follow_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
