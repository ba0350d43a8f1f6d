"""Study: results of many jobs in one folder, each under the key of all that decides it.

A run computes the results that are missing or damaged, so an interrupted one resumes, and a longer one costs what is
new. Results of earlier code can be reused, where all else that decides them agrees: `REUSED` lists these.
"""

from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec

from dsrc.runs.executors import Executor, Pool
from dsrc.runs.jobs import run_jobs
from dsrc.runs.unit import Progress, Unit, key_of
from sim.errors import DataError, complaint
from sim.files import remove_leftovers, write_file

REUSED = "reused.json"
"""File in a folder of results: keys of results of earlier code, by the keys under which they are found now."""
CODE = ("code", "versions", "reused")
"""Settings that say by which code a result was computed."""

J = TypeVar("J")
R = TypeVar("R")


@dataclass(frozen=True, slots=True, kw_only=True)
class Study(Generic[J, R]):
    """Kind of study: what its jobs and its results are.

    Attributes:
        task: computes and writes the results of a unit; called with a unit and a progress callback.
        alike: jobs of equal values are one unit, since they share work.
        steps: of a job, for the progress.
        endings: of the files of a result, in the order in which they are written.
        read: result by folder and key; raises DataError where it is missing or damaged.
        settings: what decides the result of a job, of plain values; None where a stored result cannot tell.
        stored: the same of a stored result, by folder and key; raises DataError.
    """

    task: Callable[[Unit[J], Progress], None]
    alike: Callable[[J], Hashable]
    steps: Callable[[J], int]
    endings: tuple[str, ...]
    read: Callable[[Path, str], R]
    settings: Callable[[J], Any]
    stored: Callable[[Path, str], Any]

    def find(self, folder: Path, key: str) -> R | None:
        """Return a result; None where it is missing or damaged."""
        try:
            return self.read(folder, key)
        except DataError:
            return None

    def missing(self, folder: Path, jobs: Mapping[str, J]) -> dict[str, J]:
        """Return the jobs whose results are missing or damaged."""
        return {key: job for key, job in jobs.items() if self.find(folder, key) is None}

    def run(
        self,
        folder: Path,
        jobs: Mapping[str, J],
        pool: Pool | Executor,
        progress: Progress | None = None,
        reuse: Iterable[Path] = (),
    ) -> int:
        """Compute the results that are missing in a folder, which this process has locked, and return their number.

        Args:
            folder: of the results; what a killed process left in it is removed.
            pool: workers; the results are the same for any.
            progress: called with steps done and steps missing at the start.
            reuse: folders of earlier results, see `reuse`.

        Raises:
            UserError: of the first job that failed; the others are done.
        """
        remove_leftovers(folder)
        self.reuse(folder, jobs, reuse)
        missing, units = self.missing(folder, jobs), dict[Hashable, dict[str, J]]()
        for key, job in missing.items():
            units.setdefault(self.alike(job), {})[key] = job
        steps = [sum(map(self.steps, unit.values())) for unit in units.values()]
        run_jobs(self.task, [Unit(folder, unit) for unit in units.values()], pool, progress, steps)
        return len(missing)

    def reuse(self, folder: Path, jobs: Mapping[str, J], earlier: Iterable[Path]) -> None:
        """Copy missing results from folders of earlier ones whose settings agree in all but code and versions.

        Raises:
            DataError: a folder has no results of this kind.
        """
        known = {
            signature(settings): (place, key)
            for place in _places(folder, earlier, self.endings[-1])
            for key in sorted(path.stem for path in place.glob(f"*{self.endings[-1]}"))
            if (settings := self._stored(place, key)) is not None
        }
        wanted = {key: self.settings(job) for key, job in self.missing(folder, jobs).items()} if known else {}
        taken = {}
        for key, settings in wanted.items():
            place, former = known.get(signature(settings), (None, ""))
            if settings is None or place is None or self.find(place, former) is None:
                continue
            for ending in self.endings:
                if (path := place / f"{former}{ending}").is_file():
                    write_file(folder / f"{key}{ending}", path.read_bytes())
            taken[key] = former
        if taken:
            note_reused(folder, taken)

    def _stored(self, folder: Path, key: str) -> Any:
        try:
            return self.stored(folder, key)
        except DataError:
            return None


def signature(settings: Any) -> str:
    """Key of settings without those that say by which code a result was computed."""
    return key_of(without_code(msgspec.to_builtins(settings)))


def without_code(settings: Any) -> Any:
    """Return settings, plain values, without those that say by which code a result was computed, at any depth."""
    if isinstance(settings, dict):
        return {name: without_code(value) for name, value in settings.items() if name not in CODE}
    return [without_code(value) for value in settings] if isinstance(settings, list | tuple) else settings


def reused(folder: Path) -> dict[str, str]:
    """Return the keys of a folder's results of earlier code, by their keys of today.

    Raises:
        DataError: the list is damaged.
    """
    path = folder / REUSED
    if not path.is_file():
        return {}
    try:
        return msgspec.json.decode(path.read_bytes(), type=dict[str, str])
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise DataError(complaint(path, "content", "keys of results", str(error))) from None


def reuse_entry(folder: Path, keys: Iterable[str] | None = None) -> dict[str, Any]:
    """Entry of provenance on the results of earlier code among some, or all in a folder; empty where there are none."""
    listed = reused(folder).keys()
    count = len(listed if keys is None else listed & set(keys))
    return {"reused": {"results": count, "listed_in": f"{folder.name}/{REUSED}"}} if count else {}


def note_reused(folder: Path, taken: Mapping[str, str]) -> None:
    """Add results of earlier code to the list of a folder."""
    listed = {**reused(folder), **taken}
    write_file(folder / REUSED, msgspec.json.encode(listed, order="sorted") + b"\n", edited=True)


def _places(folder: Path, earlier: Iterable[Path], ending: str) -> list[Path]:
    """Return where the results of earlier folders are: in a folder of the same name, or in the folder itself."""
    found = []
    for given in earlier:
        places = [place for place in (given / folder.name, given) if any(place.glob(f"*{ending}"))]
        if not places:
            expected = f"a folder of results, with *{ending} in its {folder.name}/"
            shown = "none" if given.is_dir() else "a file" if given.exists() else "no such folder"
            raise DataError(complaint(given, "reuse", expected, shown))
        found.append(places[0])
    return found
