"""Background threads that know no page: Worker detects over whole runs and reads, Latest does the newest job."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

from dsrc.review.frames import FrameStore
from dsrc.review.sources.base import Setup
from dsrc.review.sources.detected import ComputedSet
from dsrc.review.sources.history import DriveHistory
from sensors.corruptions import Condition
from sensors.frame import Frame
from sim.errors import SettingsError, UserError, complaint

log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class Job:
    """Detections over a whole run; its worker changes it.

    Attributes:
        store: frames of the source.
        own: set that it fills.
        setup: of the detections.
        rows: frames that are left, in their order.
        total: frames of the run.
        state: of the job.
        seconds: time for which it has detected.
        skipped: frames that cannot be read or detected in, with what is wrong with them.
        error: what ended a failed job, or "".
        stops: whether it is cancelled once the frame that it is at is done.
    """

    store: FrameStore
    own: ComputedSet
    setup: Setup
    rows: deque[int]
    total: int
    state: Literal["waiting", "running", "done", "cancelled", "failed"] = "waiting"
    seconds: float = 0.0
    skipped: list[tuple[int, str]] = field(default_factory=list)
    error: str = ""
    stops: bool = False

    @property
    def ended(self) -> bool:
        """Whether nothing more comes of it."""
        return self.state in ("done", "cancelled", "failed")

    @property
    def done(self) -> int:
        """Number of frames that are known or skipped."""
        return self.total - len(self.rows)

    @property
    def left_s(self) -> float | None:
        """Time that it will still take, s; None while unknown."""
        return self.seconds / self.done * len(self.rows) if self.done and not self.ended else None


class Worker:
    """Thread that does one frame after another: reads ahead, else detects in the oldest job, else reads a history."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._jobs: deque[Job] = deque()
        self._ahead: deque[partial[Frame]] = deque()
        self._over: DriveHistory | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="review-background", daemon=True)
        self._thread.start()

    def detect(self, store: FrameStore, method: str, setup: Setup, start: int = 0) -> Job:
        """Fill a computed set over the whole run, from a frame on and then from the first.

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
            for job in self._jobs:
                if (job.store, job.own, job.setup, job.stops) == (store, own, setup, False):
                    return job
            rows = deque(range(len(store.source)))
            rows.rotate(-start)
            self._jobs.append(job := Job(store, own, setup, rows, len(rows)))
            self._changed.notify_all()
        return job

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

    def jobs(self) -> list[Job]:
        """Jobs that wait or run, in their order."""
        with self._changed:
            return list(self._jobs)

    def cancel(self, job: Job) -> None:
        """End a job after the frame that it is at; what it has found stays."""
        with self._changed:
            job.stops = True
            if job.state == "waiting":
                self._end(job, "cancelled")

    def wait(self, job: Job, timeout_s: float) -> Job:
        """Wait for the end of a job and return it, whether it has ended or not."""
        with self._changed:
            self._changed.wait_for(lambda: job.ended, timeout_s)
        return job

    def close(self, patience_s: float = 60.0) -> bool:
        """End after the frame that the worker is at, whose end is waited for; return whether it came in this time.

        Jobs that wait or run are cancelled.
        """
        with self._changed:
            self._closed = True
            for job in list(self._jobs):
                self._end(job, "cancelled")
            self._changed.notify_all()
        self._thread.join(timeout=patience_s)
        return not self._thread.is_alive()

    def _work(self) -> None:
        while (work := self._next()) is not None:
            work()

    def _next(self) -> Callable[[], object] | None:
        """Work on one frame, once there is some; None when the worker is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._ahead or self._jobs or self._over is not None)
            if self._closed:
                return None
            if self._ahead:
                return partial(self._read_ahead, self._ahead.popleft())
            if self._jobs:
                self._jobs[0].state = "running"
                return partial(self._detect, self._jobs[0])
            return None if self._over is None else partial(self._read_over, self._over)

    def _read_ahead(self, read: partial[Frame]) -> None:
        try:
            read()
        except UserError:
            log.debug("frame %d cannot be read ahead", read.args[0])  # told where it is drawn
        except Exception:
            log.exception("frame %d cannot be read ahead", read.args[0])

    def _detect(self, job: Job) -> None:
        """Detect in the next frame of a job, and end it after its last."""
        row, started, failed = job.rows[0] if job.rows and not job.stops else -1, time.monotonic(), ""
        try:
            if row >= 0 and job.own.get(row, job.setup) is None:
                corrupted = job.store.corrupted(row, job.setup.condition, job.setup.ego_id)
                job.own.compute(row, job.store.recorded(row), corrupted, job.setup)
        except UserError as error:
            job.skipped.append((row, str(error)))
        except Exception as error:
            log.exception("frame %d of %s cannot be detected in", row, job.store.source.name)
            failed = f"frame {row}: {type(error).__name__}: {error}"
        with self._changed:
            job.seconds += time.monotonic() - started
            if row >= 0 and not failed:
                job.rows.popleft()
            if not job.ended and (failed or job.stops or not job.rows):
                job.error = failed
                self._end(job, "failed" if failed else "cancelled" if job.rows else "done")

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

    def _end(self, job: Job, state: Literal["done", "cancelled", "failed"]) -> None:
        """End a job; the lock is held."""
        job.state = state
        self._jobs.remove(job)
        self._changed.notify_all()


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
