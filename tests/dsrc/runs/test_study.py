"""A study computes what is missing, cleans up after a killed run, and takes results of earlier code when asked to."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import pytest

from dsrc.runs.executors import SERIAL, Progress
from dsrc.runs.study import REUSED, Study, Unit, key_of, reuse_entry, reused
from sim.errors import DataError


@dataclass(frozen=True)
class Root:
    """Square root to compute, by a release of the code."""

    number: float
    code: str = "new"
    versions: str = "1"


def compute(unit: Unit[Root], progress: Progress) -> None:
    for done, (key, job) in enumerate(unit.jobs.items(), 1):
        unit.folder.mkdir(parents=True, exist_ok=True)
        (unit.folder / f"{key}.json").write_text(json.dumps({"settings": asdict(job), "root": job.number**0.5}))
        progress(done, len(unit.jobs))


def read(folder: Path, key: str) -> float:
    try:
        return json.loads((folder / f"{key}.json").read_text())["root"]
    except (OSError, ValueError, KeyError):
        raise DataError(f"{key}: expected a root") from None


ROOTS: Study[Root, float] = Study(
    task=compute,
    alike=lambda job: job.number < 5,
    steps=lambda job: 1,
    endings=(".json",),
    read=read,
    settings=asdict,
    stored=lambda folder, key: json.loads((folder / f"{key}.json").read_text())["settings"],
)


def jobs(*numbers: float, **release: str) -> dict[str, Root]:
    return {key_of(asdict(job)): job for job in (Root(number, **release) for number in numbers)}


def test_an_interrupted_run_costs_what_is_missing_or_damaged(tmp_path: Path) -> None:
    folder, told = tmp_path / "roots", list[tuple[int, int]]()
    assert ROOTS.run(folder, jobs(1, 4, 9), SERIAL) == 3
    lost, damaged, *_ = [folder / f"{key}.json" for key in jobs(1, 4)]
    lost.unlink()
    damaged.write_text("{")
    (folder / f".{damaged.name}.0123abcd.tmp").write_text("half a fi")
    (folder / ".notes").write_text("of somebody")
    assert ROOTS.run(folder, jobs(1, 4, 9, 16), SERIAL, lambda *steps: told.append(steps)) == 3
    assert told[0] == (0, 3) and told[-1] == (3, 3)
    assert [ROOTS.find(folder, key) for key in jobs(1, 4, 9, 16)] == [1.0, 2.0, 3.0, 4.0]
    assert [path.name for path in folder.iterdir() if path.name.startswith(".")] == [".notes"]


def test_results_of_earlier_code_are_taken_where_all_else_agrees(tmp_path: Path) -> None:
    ROOTS.run(tmp_path / "old/roots", jobs(1, 4, code="old", versions="0"), SERIAL)
    folder = tmp_path / "new/roots"
    assert ROOTS.run(folder, jobs(1, 9), SERIAL) == 2, "nothing is taken without being asked for"
    assert reuse_entry(folder) == {}
    assert ROOTS.run(folder, jobs(1, 4, 9, 16), SERIAL, reuse=[tmp_path / "old"]) == 1
    (new,), (old,) = jobs(4), jobs(4, code="old", versions="0")
    assert reused(folder) == {new: old}
    assert (folder / f"{new}.json").read_bytes() == (tmp_path / f"old/roots/{old}.json").read_bytes()
    assert ROOTS.run(folder, jobs(1, 4, 9, 16), SERIAL) == 0, "what was taken stays"
    assert reuse_entry(folder, jobs(4, 9)) == {"reused": {"results": 1, "listed_in": f"roots/{REUSED}"}}
    assert reuse_entry(folder, jobs(1, 9)) == {}


def test_a_folder_resumes_its_own_results_of_earlier_code(tmp_path: Path) -> None:
    ROOTS.run(tmp_path / "roots", jobs(1, 4, code="old"), SERIAL)
    assert ROOTS.run(tmp_path / "roots", jobs(1, 4, 9), SERIAL, reuse=[tmp_path]) == 1


def test_damaged_results_are_not_taken_and_a_folder_without_any_is_named(tmp_path: Path) -> None:
    ROOTS.run(tmp_path / "old/roots", jobs(1, code="old"), SERIAL)
    (path,) = (tmp_path / "old/roots").iterdir()
    path.write_text(path.read_text().replace('"root"', '"tree"'))
    assert ROOTS.run(tmp_path / "new/roots", jobs(1), SERIAL, reuse=[tmp_path / "old"]) == 1
    assert reused(tmp_path / "new/roots") == {}
    with pytest.raises(DataError, match=r"none: reuse: expected a folder of results, with \*.json in its roots/"):
        ROOTS.run(tmp_path / "new/roots", jobs(4), SERIAL, reuse=[tmp_path / "none"])
