"""Series: results of many jobs in one folder, under one record of the settings that decide them all.

Results are independent of each other: their bytes are the same for any number of workers, and a run makes those that
are missing. The record stands before the first result, so that a folder of other settings, or of other code, is
refused; results of other code are taken where that is asked for, and `dsrc.runs.study.REUSED` lists these.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

from dsrc.runs.executors import Executor, Pool
from dsrc.runs.jobs import run_jobs
from dsrc.runs.lock import locked
from dsrc.runs.study import CODE, note_reused, reused, without_code
from dsrc.runs.unit import Progress
from sim.errors import DataError, complaint
from sim.files import remove_leftovers, write_file

J = TypeVar("J")
R = TypeVar("R")


@dataclass(frozen=True, slots=True, kw_only=True)
class Series(Generic[J, R]):
    """Results of one folder.

    Attributes:
        folder: of the results and the record.
        what: its content, for messages.
        record: name of the record.
        settings: all that decides the results, of plain values.
        stored: the same of the record in a folder; None without one.
        note: writes the record, given the first result: settings that this refuses are not noted.
        make: result of a job; a function of a module.
        write: writes the result of a job; a function of a module.
        files: of the result of a job in a folder; that of no job but its own.
        fresh: whether the files of a result are there, and none is older than its job.
        chunk: jobs that a worker does in one go.
    """

    folder: Path
    what: str
    record: str
    settings: dict[str, Any]
    stored: Callable[[Path], dict[str, Any] | None]
    note: Callable[[R], None]
    make: Callable[[J], R]
    write: Callable[[J, R], None]
    files: Callable[[Path, J], Sequence[Path]]
    fresh: Callable[[Path, J], bool]
    chunk: int = 1

    def run(
        self,
        jobs: Sequence[J],
        workers: Pool | Executor,
        progress: Progress | None = None,
        done: int = 0,
        total: int | None = None,
        reuse: Sequence[Path] = (),
    ) -> None:
        """Make the results that are missing; what a killed process left in the folder is removed.

        Args:
            jobs: all of the folder.
            progress: called with results done and results in all.
            done: results of other folders before these.
            total: results in all; default: `done` and these.
            reuse: folders of the same results of other code, this one perhaps; those without a record are left out.

        Raises:
            DataError: a folder holds results of other settings, or another process is writing this one.
            UserError: of the first job that failed; the others are done.
        """
        with locked(self.folder, what=self.what):
            found, there = self.stored(self.folder), set[int]()
            if found is not None:
                if self.folder not in reuse:
                    check_same(self.folder / self.record, found, self.settings)
                there = {row for row, job in enumerate(jobs) if self.fresh(self.folder, job)}
            there |= self._take(jobs, there, reuse)
            if found is None or any(_differences(found, self.settings)):
                first = self.make(jobs[0])
                for path in self.files(self.folder, jobs[0]):  # one of other code must not stand under this record
                    path.unlink(missing_ok=True)
                self.note(first)
                self.write(jobs[0], first)
                there.add(0)
            missing = [job for row, job in enumerate(jobs) if row not in there]
            chunks = [missing[k : k + self.chunk] for k in range(0, len(missing), self.chunk)]
            task, sizes = partial(_make_all, self.make, self.write), list(map(len, chunks))
            run_jobs(task, chunks, workers, progress, sizes, done + len(there), total)
            remove_leftovers(self.folder)

    def _take(self, jobs: Sequence[J], there: set[int], reuse: Sequence[Path]) -> set[int]:
        """List the results of other code that are there, copy and list those that are elsewhere, return their rows."""
        taken: set[int] = set()
        for place in reuse:
            found, here = self.stored(place), place == self.folder
            if found is None or (here and not any(_differences(found, self.settings))):
                continue
            check_same(place / self.record, without_code(found), without_code(self.settings))
            rows = there if here else {row for row, job in enumerate(jobs) if self.fresh(place, job)} - there
            rows = rows - taken - {0}  # the first is made anew, and the record with it
            code = ["unknown", *(str(value) for name, value in _leaves(found) if _says_code(name))][-1]
            named = (self.files(self.folder, jobs[row])[-1].relative_to(self.folder) for row in sorted(rows))
            listed = dict.fromkeys((name.as_posix() for name in named), code)
            # Listed before they are copied or get a record of this code: a killed process leaves none unlisted.
            note_reused(self.folder, listed | {name: known for name, known in reused(place).items() if name in listed})
            for row in () if here else rows:
                for old, new in zip(self.files(place, jobs[row]), self.files(self.folder, jobs[row]), strict=True):
                    write_file(new, old.read_bytes())
            taken |= rows
        return taken


def check_same(record: Path, found: Any, wanted: Any, hint: str = "; choose another folder or remove this one") -> None:
    """Compare settings with those in a record; DataError names the first difference."""
    for name, asked, have in _differences(found, wanted):
        more = ", or go on with --reuse and the folder given as --out" if _says_code(name) else ""
        raise DataError(complaint(record, name, asked, have, hint + more))


def _differences(found: Any, wanted: Any) -> Iterator[tuple[str, str, object]]:
    """Yield (dotted name, what is asked for, what is found) of settings that differ."""
    have, want = dict(_leaves(found)), dict(_leaves(wanted))
    for name in [*want, *have]:
        if name not in have or name not in want or have[name] != want[name]:
            asked = f"{want[name]!r} as asked for now" if name in want else "no such setting"
            yield name, asked, have.get(name, "nothing")


def _leaves(value: object, where: str = "") -> Iterator[tuple[str, object]]:
    """Yield (dotted name, plain value) of nested settings; a tuple counts as a list, as it does in a file."""
    if isinstance(value, dict):
        for name, item in value.items():
            yield from _leaves(item, f"{where}.{name}" if where else str(name))
    elif isinstance(value, list | tuple) and any(isinstance(item, dict | list | tuple) for item in value):
        for row, item in enumerate(value):
            yield from _leaves(item, f"{where}[{row}]")
    else:
        yield where, list(value) if isinstance(value, tuple) else value


def _says_code(name: str) -> bool:
    return name.rpartition(".")[2] in CODE


def _make_all(make: Callable[[J], R], write: Callable[[J, R], None], jobs: Sequence[J], progress: Progress) -> None:
    """Make and write some results; a task."""
    for job in jobs:
        write(job, make(job))
