"""Interrupts: Ctrl-C and SIGTERM end a command, at a moment when nobody takes the exception for an error of their own.

Packages try imports with `except BaseException`, and Python drops an exception out of `__del__`: an interrupt there
would be lost. It stays pending until the stack is clear of both.
"""

import atexit
import signal
from collections.abc import Mapping
from types import FrameType
from typing import Any, Self

RETRY_S = 0.02
"""Time until a pending interrupt looks again, s."""
_FINALISERS = ("__del__",)


class Interrupted(KeyboardInterrupt):
    """Signal that ends a command.

    A class of its own: CPython kills a process at its end, whatever its exit code, once a plain KeyboardInterrupt has
    left code that is compiled from text, as that of dataclasses is, although it was caught later.
    """


class Interrupts:
    """Context in which SIGINT and SIGTERM raise `Interrupted`, once nobody would swallow it.

    Args:
        ending: the process ends with the context. A first signal after a finished command changes nothing; one more,
            or one after an interrupt, ends the process at once, without a stack trace.

    Attributes:
        received: number of the last signal; 0 for none. It tells a swallowed interrupt from a finished command.
    """

    def __init__(self, ending: bool = False) -> None:
        self.received = 0
        self._ending = ending
        self._settled = False
        self._before: Mapping[int, Any] = {}

    def __enter__(self) -> Self:
        try:
            self._before = {number: signal.signal(number, self._take) for number in (signal.SIGINT, signal.SIGTERM)}
            if hasattr(signal, "SIGALRM"):
                self._before = {**self._before, signal.SIGALRM: signal.signal(signal.SIGALRM, self._raise_when_safe)}
        except ValueError:  # not in the main thread, which alone has signals
            pass
        if self._ending and self._before:
            atexit.register(self._leave)
        return self

    def __exit__(self, *exc: object) -> None:
        if hasattr(signal, "setitimer") and self._before:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in self._before.items():
            if not self._ending:
                signal.signal(number, handler)
            elif self.received:
                signal.signal(number, signal.SIG_DFL)

    def settle(self) -> None:
        """Raise no more: the command has ended, and what is left to do takes a moment."""
        self._settled = True

    def _leave(self) -> None:
        # From here on Python would let a first signal kill the process of a finished command. Registered before all
        # packages, this runs after their exits, which may wait and are to be interrupted.
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) == self._take:
                signal.signal(number, signal.SIG_IGN)

    def _take(self, number: int, frame: FrameType | None) -> None:
        if self._settled:
            signal.signal(number, signal.SIG_DFL)
            return
        self.received = number
        self._raise_when_safe(number, frame)

    def _raise_when_safe(self, number: int, frame: FrameType | None) -> None:
        if self._settled or not self.received:
            return
        if hasattr(signal, "setitimer") and _would_be_lost(frame):
            signal.setitimer(signal.ITIMER_REAL, RETRY_S)
        else:
            raise Interrupted


def _would_be_lost(frame: FrameType | None) -> bool:
    """Return whether an import or a finaliser runs, in any frame of the stack."""
    while frame is not None:
        code = frame.f_code
        if code.co_filename.startswith("<frozen importlib") or code.co_name in _FINALISERS:
            return True
        frame = frame.f_back
    return False
