"""A search over a made world, in which weak brakes crash, and over true episodes."""

import csv
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

from dsrc.closed_loop.campaign.episode import EpisodeJob, decisive
from dsrc.closed_loop.falsification import run as running
from dsrc.closed_loop.falsification.report import failure_table, optimizer_table, write_search
from dsrc.closed_loop.falsification.run import Falsification, search_failures
from dsrc.options.search import SearchOptions
from dsrc.runs.unit import Progress, Unit
from sim.errors import SettingsError
from sim.files import write_file
from tests.commands import dsrc
from tests.dsrc.closed_loop.causes.test_cause import crash
from tests.dsrc.closed_loop.results import one

GAIN = "brake_gain:0..1 from 0..4 s for 1..5 s"
DRIVEN: list[str] = []
CRASH: list[bytes] = []


def made_world(unit: Unit[EpisodeJob], progress: Progress) -> None:
    """Episodes that crash where the brakes have less than half their gain at 3 s."""
    for key, job in unit.jobs.items():
        DRIVEN.append(key)
        weak = [fault.value for fault in job.faults if fault.kind == "brake_gain" and fault.at(3.0)]
        crashed = bool(weak) and weak[0] < 0.5
        write_file(unit.folder / f"{key}.npz", CRASH[0])
        result = one(job.perception, job.seed, "crashed" if crashed else "arrived", min_ttc_s=10.0 * min([1.0, *weak]))
        result = msgspec.structs.replace(result, key=key, scenario=job.scenario)
        content = msgspec.to_builtins(result) | {"settings": decisive(job)}
        write_file(unit.folder / f"{key}.json", msgspec.json.encode(content))


@pytest.fixture(autouse=True)
def world(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    DRIVEN.clear()
    CRASH[:] = CRASH or [crash().save(tmp_path / "made" / "crash.npz").read_bytes()]
    if "true" not in request.node.name:
        monkeypatch.setattr(running, "_ALONE", replace(running._ALONE, task=made_world))
        monkeypatch.setattr("dsrc.closed_loop.causes.episodes.crash_cause", lambda log, _: running_cause(log))


def running_cause(log: Any) -> Any:
    from dsrc.closed_loop.causes.cause import cause_of

    return cause_of(log, lambda now, object_id: True)


def options(**changes: Any) -> SearchOptions:
    given = {"scenario": ("ima_building",), "fault": (GAIN,), "optimizer": ("random",), "budget": 16}
    return SearchOptions(**(given | changes))


def test_a_failure_is_found_made_small_and_told(tmp_path: Path) -> None:
    found = search_failures(options(), tmp_path)
    assert len(found.trials["random"]) == 16 and 0 < sum(trial.crashed for trial in found.trials["random"]) < 16
    (failure,) = found.failures
    (small,) = running.Candidate("ima_building", 0, failure.fault or "").faults
    assert 0.45 <= small.value < 0.5 and 2.7 <= small.from_s <= 3.0 < small.to_s <= 3.4
    assert 0 < failure.still < failure.near
    assert failure.first.size == min(trial.size for trial in failure.trials)
    write_search(found, tmp_path)
    (line,) = csv.DictReader((tmp_path / "failures.csv").read_text().splitlines()[1:])
    assert line["smallest_fault"] == failure.fault and (tmp_path / line["log"]).is_file()
    assert len((tmp_path / "tried.csv").read_text().splitlines()) == 18
    assert str(len(failure.trials)) in failure_table(found).markdown() and (tmp_path / "search.png").is_file()


def test_a_search_that_was_interrupted_drives_what_is_missing(tmp_path: Path) -> None:
    def told(found: Falsification) -> Any:
        return found.trials, found.failures

    first = search_failures(options(failures=0), tmp_path)
    driven = set(DRIVEN)
    assert first.made == len(driven)
    for gone in sorted((tmp_path / "episodes").glob("*.json"))[:3]:
        gone.unlink()
    DRIVEN.clear()
    again = search_failures(options(failures=0), tmp_path)
    assert again.made == len(DRIVEN) == 3 and set(DRIVEN) <= driven and told(again) == told(first)


def test_every_optimiser_has_the_budget_and_a_line(tmp_path: Path) -> None:
    found = search_failures(options(optimizer=("random", "grid"), budget=10, failures=0), tmp_path)
    assert [len(own) for own in found.trials.values()] == [10, 10]
    assert [row.label for row in optimizer_table(found).rows] == ["random", "grid"]
    assert all(failure.fault is None for failure in found.failures)


def test_what_a_fast_perception_proposes_is_judged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def lenient(unit: Unit[EpisodeJob], progress: Progress) -> None:
        if next(iter(unit.jobs.values())).uses == "truth":
            made_world(unit, progress)
            return
        for key, job in unit.jobs.items():  # the judge crashes where nobody brakes at all
            weak = [fault for fault in job.faults if fault.value < 0.25 and fault.at(3.0)]
            made_world(Unit(unit.folder, {key: msgspec.structs.replace(job, faults=tuple(weak))}), progress)

    monkeypatch.setattr(running, "_ALONE", replace(running._ALONE, task=lenient))
    found = search_failures(options(perception="sight", fast="truth", judge=6, failures=0), tmp_path)
    assert len(found.judged) == 6
    proposed = sorted(found.trials["random"], key=lambda trial: trial.value)[:6]
    assert [trial.candidate for trial in found.judged] == [trial.candidate for trial in proposed]
    told = {trial.candidate.fault for failure in found.failures for trial in failure.trials}
    assert told == {trial.candidate.fault for trial in found.judged if trial.crashed}
    assert all(running.Candidate("", 0, text).faults[0].value < 0.25 for text in told)


def test_a_true_encounter_without_brakes_is_a_failure_whose_log_is_whole(tmp_path: Path) -> None:
    found = search_failures(options(fault=("brake_gain:0..0.1",), budget=1, failures=0, duration_s=15.0), tmp_path)
    (failure,) = found.failures
    assert failure.cause == "braked too little"
    assert running.EpisodeLog.load(tmp_path / "episodes" / f"{failure.first.key}.npz").contact is not None


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ((), "expected a fault or a parameter with a range LOW..HIGH, or several seeds, found none"),
        (
            ("--fault", "brake_gain:0.5", "--optimizer", "tpe"),
            "--fault: expected a fault or a parameter with a range LOW..HIGH, or several seeds, found brake_gain:0.5",
        ),
        (("--fault", "loss:0..1"), "expected a perception that 'loss:0' acts on, such as team, found truth"),
        (("--fault", "brake_gain:0..99"), "fault 'brake_gain:99', factor: expected 0 to 10, found 99"),
        (("--parameter", "speed"), "expected a parameter of the encounter 'ima_building', found speed"),
        (("--fault", "brake_gain:0..1", "--budget", "0"), "--budget: expected at least 1, found 0"),
        (("--fault", ""), "expected a fault or a parameter with a range LOW..HIGH, or several seeds, found none"),
        (("--seed", "0", "1", "--optimizer", "grid", "grid"), "--optimizer: expected names that differ, found grid"),
    ],
)
def test_a_search_that_cannot_be_is_refused_in_a_line(words: tuple[str, ...], complaint: str, tmp_path: Path) -> None:
    done = dsrc("search", "ima_building", *words, "--out", str(tmp_path / "out"))
    assert done.returncode == 2 and complaint in done.stderr and len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "out").exists() and not DRIVEN


def test_a_search_without_its_package_makes_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(SettingsError, match=r"optimizer tpe needs the package optuna: pip install"):
        search_failures(options(optimizer=("random", "tpe")), tmp_path / "out")
    assert not (tmp_path / "out").exists() and not DRIVEN
