"""Latest: one thread that does the newest of what is asked and skips what is outdated."""

import threading
import time
from collections.abc import Callable


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

    def ask(self, job: Callable[[], None]) -> None:
        """Run a job in place of one that has not begun; the job handles its own errors."""
        with self._lock:
            self._job = job
            if not self.running:
                self.running = True
                threading.Thread(target=self._work, name="review-lab", daemon=True).start()

    def drop(self) -> None:
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
