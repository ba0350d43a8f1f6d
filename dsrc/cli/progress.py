"""Progress of a command on standard error, a bar on a terminal, else a line now and then; and what it made."""

import logging
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import monotonic

Report = Callable[[int, int], None]
"""Called with (steps done, steps in all)."""

LINE_EVERY_S = 20.0
"""Time between two lines where there is no terminal, s."""
SHORT_S = 2.0
"""Work that takes less is not reported in lines, s."""


@contextmanager
def progress(label: str) -> Iterator[Report]:
    """Show the progress of one piece of work.

    Args:
        label: the work, a few words.

    Yields:
        The function to call after every step.
    """
    with (_bar if sys.stderr.isatty() else _lines)(label) as report:
        yield report


def log_lines(name: str, on_terminals: bool = False) -> None:
    """Write the log of a package to standard error.

    Args:
        on_terminals: also to a terminal, which may have a bar of its own.
    """
    if on_terminals or not sys.stderr.isatty():
        log = logging.getLogger(name)
        log.setLevel(logging.INFO)
        log.addHandler(logging.StreamHandler())


def made(places: Path | Sequence[Path], what: str, *then: object, new: bool = True) -> None:
    """Print what a command wrote: the places on standard output, which scripts read, the rest on standard error.

    Args:
        places: files or folders, a line each.
        what: the written thing, a few words.
        then: words of the command that one would run next; none where there is no such command.
        new: whether the command made anything that an earlier run had not.
    """
    listed = [places] if isinstance(places, Path) else places
    sys.stdout.writelines(f"{place}\n" for place in listed)
    sys.stdout.flush()
    sys.stderr.write(f"{'wrote' if new else 'already there:'} {what}\n")
    if then:
        sys.stderr.write(f"next: {shlex.join(['dsrc', *map(str, then)])}\n")


@contextmanager
def _lines(label: str) -> Iterator[Report]:
    start = last = monotonic()
    shown = 0

    def report(done: int, total: int) -> None:
        nonlocal last, shown
        now = monotonic()
        ended = done >= total and now - start >= SHORT_S
        if done != shown and (ended or now - last >= LINE_EVERY_S):
            sys.stderr.write(f"{label}: {done} of {total}, {now - start:.0f} s\n")
            sys.stderr.flush()
            last, shown = now, done

    yield report


@contextmanager
def _bar(label: str) -> Iterator[Report]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    bar = Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True))
    task = bar.add_task(label, total=None)
    bar.start()
    try:
        yield lambda done, total: bar.update(task, completed=done, total=total)
    except BaseException:
        bar.live.transient = not bar.tasks[0].completed  # no empty bar above a complaint
        bar.live.stop()
        raise
    bar.stop()
