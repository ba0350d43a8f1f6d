"""Background threads that know no page: Worker detects over whole runs and reads, Latest does the newest job."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, NamedTuple

from dsrc.review.frames import FrameStore
from dsrc.review.sources.base import Setup
from dsrc.review.sources.detected import ComputedSet
from dsrc.review.sources.history import DriveHistory
from sensors.corruptions import Condition
from sensors.frame import Frame
from sim.errors import SettingsError, UserError, complaint

log = logging.getLogger(__name__)

JobState = Literal["waiting", "running", "done", "cancelled", "failed"]
_JOBS_KEPT = 50


@dataclass(frozen=True, slots=True)
class JobProgress:
    """Progress of a job.

    Attributes:
        number: of the job.
        method: name of the set that it fills.
        store: frames of the source; names of sources may be equal.
        setup: of the detections.
        state: of the job.
        done: frames that are known or skipped.
        total: frames of the run.
        seconds: time that it has run.
        skipped: frames that cannot be read or detected in, with what is wrong with them.
        error: what ended a failed job, or "".
    """

    number: int
    method: str
    store: FrameStore
    setup: Setup
    state: JobState = "waiting"
    done: int = 0
    total: int = 0
    seconds: float = 0.0
    skipped: tuple[tuple[int, str], ...] = ()
    error: str = ""

    @property
    def ended(self) -> bool:
        """Whether nothing more comes of it."""
        return self.state in ("done", "cancelled", "failed")

    @property
    def left_s(self) -> float | None:
        """Time that it will still take, s; None while unknown."""
        return None if not self.done or self.ended else self.seconds / self.done * (self.total - self.done)


class _Job(NamedTuple):
    store: FrameStore
    own: ComputedSet
    setup: Setup
    start: int


class Worker:
    """Thread that fills sets of detections, one run after another, and reads frames ahead between two of theirs.

    With nothing else to do it reads the objects of all frames of a source.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: deque[int] = deque()
        self._jobs: dict[int, _Job] = {}
        self._progress: dict[int, JobProgress] = {}
        self._cancelled: set[int] = set()
        self._ahead: deque[partial[Frame]] = deque()
        self._over: DriveHistory | None = None
        self._count = 0
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="review-background", daemon=True)
        self._thread.start()

    def detect(self, store: FrameStore, method: str, setup: Setup, start: int = 0) -> int:
        """Fill a computed set over the whole run, from a frame on and then from the first; return the job's number.

        A job that waits or runs for the same detections is returned instead of a second one.

        Raises:
            SettingsError: there is no such set, or it is recorded.
            RuntimeError: the worker is closed.
        """
        own = store.source.sets.get(method)
        if not isinstance(own, ComputedSet):
            found = "none" if own is None else "recorded detections"
            raise SettingsError(complaint(store.source.name, method, "a detector", found))
        with self._changed:
            if self._closed:
                raise RuntimeError("the worker is closed")
            for number, job in self._jobs.items():
                if (job.store, job.own, job.setup) == (store, own, setup) and number not in self._cancelled:
                    return number
            number = self._count = self._count + 1
            self._jobs[number] = _Job(store, own, setup, start)
            total = len(store.source)
            self._progress[number] = JobProgress(number, method, store, setup, total=total)
            self._waiting.append(number)
            self._forget_old()
            self._changed.notify_all()
        return number

    def prefetch(
        self, store: FrameStore, rows: Sequence[int], condition: Condition | None = None, ego_id: int | None = None
    ) -> None:
        """Read frames ahead, in their order, in place of those asked for before."""
        inside = (row for row in rows if 0 <= row < len(store.source))
        with self._changed:
            self._ahead = deque(partial(store.corrupted, row, condition or Condition(), ego_id) for row in inside)
            self._changed.notify_all()

    def read_over(self, history: DriveHistory) -> None:
        """Read what a history lacks, in place of the one asked for before."""
        with self._changed:
            self._over = history
            self._changed.notify_all()

    def cancel(self, number: int) -> None:
        """End a job after the frame that it is at; what it has found stays."""
        with self._changed:
            if number in self._jobs:
                self._cancelled.add(number)
            if number in self._waiting:
                self._waiting.remove(number)
                self._end(number, "cancelled")
            self._changed.notify_all()

    def progress(self, number: int) -> JobProgress:
        """Progress of a job; KeyError for an unknown or long forgotten one."""
        with self._changed:
            return self._progress[number]

    def jobs(self) -> list[JobProgress]:
        """Progress of the latest jobs, in the order of their numbers."""
        with self._changed:
            return [self._progress[number] for number in sorted(self._progress)]

    def wait(self, number: int, timeout_s: float) -> JobProgress:
        """Wait for the end of a job and return its progress, whether it has ended or not."""
        with self._changed:
            self._changed.wait_for(lambda: self._progress[number].ended, timeout_s)
            return self._progress[number]

    def close(self) -> None:
        """End after the frame that the worker is at; jobs that wait or run are cancelled."""
        with self._changed:
            self._closed = True
            self._ahead.clear()
            for number in list(self._waiting):
                self._end(number, "cancelled")
            self._waiting.clear()
            self._cancelled |= set(self._jobs)
            self._changed.notify_all()
        self._thread.join(timeout=60.0)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._waiting or self._ahead or self._over)
                if self._closed:
                    return
                number = self._waiting.popleft() if not self._ahead and self._waiting else None
                over = self._over if not self._ahead else None
            if number is not None:
                self._run(number)
            elif over is not None:
                self._read_over(over)
            else:
                self._read_ahead()

    def _read_over(self, history: DriveHistory) -> None:
        lacking = history.lacking()
        try:
            for row in lacking[:1]:
                history.read(row)
        except Exception:
            log.exception("the objects of frame %d cannot be read", lacking[0])
            lacking = []
        with self._changed:
            if self._over is history and len(lacking) < 2:
                self._over = None

    def _read_ahead(self) -> None:
        with self._changed:
            if not self._ahead:
                return
            read = self._ahead.popleft()
        try:
            read()
        except UserError:
            log.debug("frame %d cannot be read ahead", read.args[0])  # told where it is drawn
        except Exception:
            log.exception("frame %d cannot be read ahead", read.args[0])

    def _run(self, number: int) -> None:
        job = self._jobs[number]
        started, total = time.monotonic(), len(job.store.source)
        skipped: list[tuple[int, str]] = []
        self._tell(number, state="running", total=total)
        start = min(job.start, max(total - 1, 0))
        for done, row in enumerate([*range(start, total), *range(start)]):
            while self._ahead:
                self._read_ahead()
            if number in self._cancelled:
                self._end(number, "cancelled")
                return
            try:
                self._detect(job, row)
            except UserError as error:
                skipped.append((row, str(error)))
            except Exception as error:
                log.exception("frame %d of %s cannot be detected in", row, job.store.source.name)
                self._end(number, "failed", f"frame {row}: {type(error).__name__}: {error}")
                return
            seconds = time.monotonic() - started
            self._tell(number, done=done + 1, seconds=seconds, skipped=tuple(skipped))
        self._end(number, "done")

    def _detect(self, job: _Job, row: int) -> None:
        if job.own.get(row, job.setup) is None:
            clean = job.store.recorded(row)
            job.own.compute(row, clean, job.store.corrupted(row, job.setup.condition, job.setup.ego_id), job.setup)

    def _tell(self, number: int, **changes: object) -> None:
        with self._changed:
            self._progress[number] = replace(self._progress[number], **changes)  # type: ignore[arg-type]
            self._changed.notify_all()

    def _end(self, number: int, state: JobState, error: str = "") -> None:
        with self._changed:
            self._progress[number] = replace(self._progress[number], state=state, error=error)
            self._jobs.pop(number, None)
            self._cancelled.discard(number)
            self._changed.notify_all()

    def _forget_old(self) -> None:
        ended = [number for number, one in sorted(self._progress.items()) if one.ended]
        for number in ended[: max(len(self._progress) - _JOBS_KEPT, 0)]:
            del self._progress[number]


class Latest:
    """Runner of the newest job; its thread lives while there is something to do.

    Attributes:
        running: whether there is.

    Args:
        pause_s: time for which each job waits for a newer one, s.
    """

    def __init__(self, pause_s: float) -> None:
        self._pause_s = pause_s
        self._lock = threading.Lock()
        self._job: Callable[[], None] | None = None
        self.running = False

    def submit(self, job: Callable[[], None]) -> None:
        """Run a job in place of one that has not begun; the job handles its own errors."""
        with self._lock:
            self._job = job
            if not self.running:
                self.running = True
                threading.Thread(target=self._work, name="review-lab", daemon=True).start()

    def cancel(self) -> None:
        """Forget a job that has not begun."""
        with self._lock:
            self._job = None

    def _work(self) -> None:
        while True:
            time.sleep(self._pause_s)
            with self._lock:
                job, self._job = self._job, None
                if job is None:
                    self.running = False
                    return
            job()
