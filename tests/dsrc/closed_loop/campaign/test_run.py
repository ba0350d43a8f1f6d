"""Campaigns: cells that resume, failures that are rows, controls that guard them."""

import csv
import dataclasses
import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from rich.console import Console

from dsrc.cli.drive import Drive
from dsrc.closed_loop.campaign import jobs
from dsrc.closed_loop.campaign import run as runner
from dsrc.closed_loop.campaign.episode import decisive, episode_key
from dsrc.closed_loop.campaign.plan import PerceptionSpec
from dsrc.closed_loop.campaign.read import read_campaign
from dsrc.closed_loop.campaign.run import (
    drive_episodes,
    engines_there,
    read_results,
    replay_at,
    results_csv,
    reused,
    run_campaign,
    take_episodes,
)
from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.loop import LoopSettings
from dsrc.closed_loop.report.report import markdown, write_report
from dsrc.closed_loop.report.terminal import comparison_table, summary_table
from dsrc.detectors.texts import SHIPPED_DETECTOR
from dsrc.models.storage.deploy import engine_for
from dsrc.options.driving import DriveOptions
from dsrc.runs.executors import Pool
from sim.errors import DataError, SettingsError
from sim.files import file_sha256
from tests.dsrc.closed_loop.campaign.blind import EYES, PLAN


def rows(out: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((out / "results.csv").read_text(encoding="utf-8").splitlines()))


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("campaign")
    run_campaign(PLAN, out)
    return out


def test_truth_arrives_and_the_blind_crash(driven: Path) -> None:
    found = {(row["perception"], row["seed"]): row["outcome"] for row in rows(driven)}
    assert found == {("truth", "0"): "arrived", ("truth", "1"): "arrived"} | {
        ("nothing", "0"): "crashed",
        ("nothing", "1"): "crashed",
    }


def test_a_campaign_that_was_driven_drives_nothing_again(driven: Path) -> None:
    before = (driven / "results.csv").read_bytes()
    again = run_campaign(PLAN, driven)
    assert again.made == 0
    assert (driven / "results.csv").read_bytes() == before
    assert read_results([driven / "results.csv"]) == {one.key: one for one in again.results}, "to the last digit"


@pytest.mark.slow
def test_a_lost_episode_comes_back_with_the_same_bytes(driven: Path) -> None:
    key = rows(driven)[0]["key"]
    files = [driven / "episodes" / f"{key}{suffix}" for suffix in (".json", ".npz")]
    before = [path.read_bytes() for path in files]
    files[0].unlink()
    assert run_campaign(PLAN, driven).made == 1
    assert [path.read_bytes() for path in files] == before


def test_what_a_killed_run_left_is_removed_by_the_next_one(driven: Path) -> None:
    left = driven / "episodes" / f".{rows(driven)[0]['key']}.npz.0123abcd.tmp"
    left.write_bytes(b"half a log")
    assert run_campaign(PLAN, driven).made == 0
    assert not left.exists()


def test_results_of_another_folder_are_not_driven_again(driven: Path, tmp_path: Path) -> None:
    known = read_results([driven / "results.csv"])
    assert reused(PLAN, known) == 4
    again = run_campaign(PLAN, tmp_path / "same", known=known)
    assert again.made == 0 and (tmp_path / "same/results.csv").read_bytes() == (driven / "results.csv").read_bytes()
    more = run_campaign(replace(PLAN, clean_seeds=3), tmp_path / "same")
    assert more.made == 2 and len(more.results) == 6, "the folder keeps what it was given"
    fewer = run_campaign(replace(PLAN, clean_seeds=1), tmp_path / "same", known=known)
    assert fewer.made == 0 and run_campaign(PLAN, tmp_path / "same").made == 0
    other = replace(PLAN, clean_seeds=1, loop=LoopSettings(duration_s=14.0))
    assert reused(other, known) == 0, "other settings are other episodes"


def test_episodes_of_other_code_are_taken_from_an_earlier_folder(
    driven: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jobs, "code_hash", lambda name: "another")
    out = tmp_path / "new code"
    assert take_episodes(PLAN, out, [driven]) == 4
    again = run_campaign(PLAN, out)
    assert again.made == 0 and len(list((out / "episodes").glob("*.npz"))) == 4, "with their logs"
    assert len(json.loads((out / "episodes" / "reused.json").read_bytes())) == 4
    assert take_episodes(replace(PLAN, driver="careful"), tmp_path / "other driver", [driven]) == 0
    with pytest.raises(DataError, match="reuse: expected a folder of results"):
        take_episodes(PLAN, out, [tmp_path])
    with pytest.raises(DataError, match=r"none: reuse: expected a folder of a campaign, or its results\.csv"):
        read_results([tmp_path / "none"])


def test_episodes_of_another_engine_are_counted(driven: Path, tmp_path: Path) -> None:
    other = replace(PLAN, engine="plain")
    assert engines_there(other, [tmp_path, driven]) == {"fused": 2}, "the truth has no engine"
    assert not engines_there(PLAN, [driven]) and not engines_there(PLAN, [tmp_path, driven])
    assert not engines_there(replace(other, driver="careful"), [driven])


def changed(text: str, column: str, value: str) -> str:
    """Results with another value in the first line."""
    heads, first, *others = (line.split(",") for line in text.splitlines())
    first[heads.index(column)] = value
    return "\n".join(",".join(row) for row in (heads, first, *others))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        pytest.param(lambda text: changed(text, "detectable", "maybe"), "result 1", id="flag"),
        pytest.param(lambda text: changed(text, "outcome", "flew"), "'flew'", id="outcome"),
        pytest.param(lambda text: changed(text, "duration_s", "inf"), "duration_s: expected a finite", id="infinite"),
        pytest.param(lambda text: changed(text, "pdms", "high"), "result 1", id="word"),
        pytest.param(lambda text: text.replace(",outcome,", ",end,"), "named outcome", id="column"),
        pytest.param(lambda text: text.replace(",duration_s,", ",time,"), "named duration_s", id="metric"),
        pytest.param(lambda text: text[:-20], "result 4: expected .* fields", id="cut"),
        pytest.param(lambda text: text + changed(text, "duration_s", "1").splitlines()[1], "the same", id="two"),
        pytest.param(lambda text: "a,b\n1,2\n", "named scenario", id="other CSV"),
        pytest.param(lambda text: "\0", "results.csv", id="bytes"),
        pytest.param(lambda text: "", "named scenario", id="empty"),
    ],
)
def test_a_file_that_is_no_result_is_one_line_that_names_it(
    driven: Path, tmp_path: Path, change: Callable[[str], str], expected: str
) -> None:
    path = tmp_path / "results.csv"
    path.write_text(change((driven / "results.csv").read_text()))
    with pytest.raises(DataError, match=expected) as error:
        read_results([path])
    assert str(path) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({"docs": Path("page.md")}, id="without a folder"),
        pytest.param({"docs": Path("page.md"), "out": Path("runs")}, id="of flags"),
        pytest.param({"docs": Path("page.md"), "out": Path("runs"), "view": True}, id="beside a view"),
        pytest.param({"docs": Path("page.md"), "critical": "severity"}, id="beside a search"),
        pytest.param({"reuse": (Path("results.csv"),), "critical": "severity"}, id="reused beside a search"),
        pytest.param({"reuse": (Path("results.csv"),)}, id="reused without a folder"),
    ],
)
def test_options_that_would_do_nothing_are_refused(
    tmp_path: Path, options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SettingsError, match=f"--{'reuse' if 'reuse' in options else 'docs'}"):
        Drive(what="lta_truck", corruption=("fog",), **options).run()
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_other_workers_give_the_same_results(driven: Path, tmp_path: Path) -> None:
    run_campaign(PLAN, tmp_path, Pool(workers=2))
    assert (tmp_path / "results.csv").read_bytes() == (driven / "results.csv").read_bytes()


@pytest.mark.slow
def test_more_seeds_keep_those_that_are_there(driven: Path, tmp_path: Path) -> None:
    out = tmp_path / "more"
    run_campaign(replace(PLAN, clean_seeds=1), out)
    assert run_campaign(replace(PLAN, clean_seeds=2), out).made == 2
    assert len(rows(out)) == 4


def test_a_perception_that_fails_is_a_row(tmp_path: Path) -> None:
    broken = replace(PLAN, clean_seeds=1, perceptions=(PerceptionSpec(name="broken", uses=f"{EYES}:Broken"),))
    (row,) = run_campaign(broken, tmp_path).results
    assert (row.outcome, row.message) == ("perception failed", "MemoryError: no memory left")


def test_a_run_in_which_every_episode_fails_exits_with_1_and_keeps_its_results(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings: dict[str, Any] = {"what": "ima_building", "duration_s": 2.0}
    with pytest.raises(SystemExit, match="1"):
        Drive(**settings, perception=(f"broken={EYES}:Broken",), out=tmp_path).run()
    assert [row["outcome"] for row in rows(tmp_path)] == ["perception failed"] and (tmp_path / "report.html").is_file()
    told = capsys.readouterr()
    assert "broken: perception failed in 1 of 1 episodes: MemoryError: no memory left" in told.out
    assert re.search(r"^perception .* failed ", told.out, re.MULTILINE), "a column of the table"
    Drive(**settings, perception=("truth", f"broken={EYES}:Broken")).run()  # some worked
    Drive(**settings).run()
    assert "failed" not in capsys.readouterr().out.rpartition("perception")[2]


def test_progress_counts_controls_and_episodes_together(tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    plan = replace(PLAN, perceptions=PLAN.perceptions[:1], clean_seeds=1, controls=True, careful=True)
    result = run_campaign(plan, tmp_path, progress=lambda *steps: told.append(steps))
    assert len(result.controls) == 2 and result.made == 4
    assert {total for _, total in told} == {4}
    assert [done for done, _ in told] == sorted(done for done, _ in told) and told[-1] == (4, 4)


@pytest.mark.slow
def test_a_driver_of_one_s_own_that_fails_is_a_row_and_the_campaign_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings: dict[str, Any] = {"what": "ima_building", "duration_s": 15.0, "seed": (0,), "out": tmp_path}
    with pytest.raises(SystemExit, match="1"):
        Drive(**settings, driver=f"{EYES}:Fainting", fail_under=("failed<=0%",)).run()
    (row,) = rows(tmp_path)
    assert (row["outcome"], row["message"]) == ("driver failed", "ZeroDivisionError: nobody is there")
    assert "truth: driver failed in 1 of 1 episodes: ZeroDivisionError" in capsys.readouterr().out
    job = jobs.episodes_of(replace(PLAN, driver=f"{EYES}:Fainting"))[0]
    assert job.driver_sha256 and "driver_sha256" in decisive(job)
    assert "driver_sha256" not in decisive(jobs.episodes_of(PLAN)[0])
    assert episode_key(job) != episode_key(replace(job, driver_sha256="another source"))
    log = tmp_path / f"episodes/{row['key']}.npz"
    assert EpisodeLog.load(log).settings.driver_sha256 == job.driver_sha256
    with pytest.raises(SettingsError, match="names a driver of its own, which runs only when asked for; add --driver"):
        replay_at(log, DriveOptions(str(log)))
    again = replay_at(log, DriveOptions(str(log), driver=f"{EYES}:Fainting"))[1]
    assert again.outcome == "driver failed" and len(again) == len(EpisodeLog.load(log)) - 1


def test_a_plan_starts_no_program_for_a_driver_and_knows_those_that_are_unknown(tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    for driver, words in (("pipe:python drive.py", "no command"), ("planing", "did you mean 'planning'")):
        plan.write_text(f"scenarios = ['lta_truck']\ndriver = '{driver}'\n[[perceptions]]\nname = 'truth'\n")
        with pytest.raises(SettingsError, match=words) as raised:
            read_campaign(plan)
        assert str(raised.value).startswith(f"{plan}: driver: ")


def test_a_driver_who_fails_a_control_stops_the_campaign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "controls_of", lambda plan: replace(PLAN, perceptions=PLAN.perceptions[1:]))
    with pytest.raises(SettingsError, match="ima_building seed 0: crashed"):
        run_campaign(replace(PLAN, controls=True), tmp_path)
    assert not (tmp_path / "results.csv").exists() and (tmp_path / "controls.csv").exists()


def test_a_report_has_every_perception_and_its_pictures(driven: Path) -> None:
    result = run_campaign(PLAN, driven)
    paths = write_report(result, driven)
    text = markdown(result)
    assert all(path.stat().st_size > 0 for path in paths)
    assert "| nothing | clean | 2 | 100 %" in text and "Hardest crashes" in text
    assert len(summary_table(result).rows) == 2
    # Who perceives nothing has no percept of the actor that it crashes with.
    assert "| nothing | clean | 2 | 2 | 0 | 0 | 0 |" in text.partition("## What came late")[2]


@pytest.mark.slow
def test_encounters_of_a_class_that_a_perception_has_not_are_kept_apart(tmp_path: Path) -> None:
    blind = PerceptionSpec(name="vehicles only", uses=f"{EYES}:BlindForPeople")
    plan = replace(
        PLAN, scenarios=("ima_building", "ped_dartout"), perceptions=(*PLAN.perceptions, blind), clean_seeds=1
    )
    result = run_campaign(plan, tmp_path)
    marked = {(one.scenario, one.perception): (one.road_user, one.detectable) for one in result.results}
    assert marked["ima_building", "vehicles only"] == ("car", True)
    assert marked["ped_dartout", "nothing"] == ("pedestrian", True)
    assert marked["ped_dartout", "vehicles only"] == ("pedestrian", False)
    together, apart = markdown(result).split("## Pedestrians")
    assert "| vehicles only | clean | 1 |" in together and "| vehicles only | clean | 2 |" not in together
    # A perception that has the class counts there as everywhere: its crash is one.
    lines = apart.splitlines()
    assert next(line for line in lines if line.startswith("| nothing")).endswith("| 0 |")
    assert next(line for line in lines if line.startswith("| vehicles only")).endswith("| 1 |")
    (scenario,) = (line for line in lines if line.startswith("| ped_dartout (pedestrian)"))
    assert scenario.count("*") == 1
    names = [str(row.cells[0]) for row in summary_table(result).rows]
    assert names == ["truth", "nothing", "vehicles only", "truth", "nothing", "vehicles only *"]


def test_a_narrow_terminal_shows_every_number(tmp_path: Path) -> None:
    plan = replace(PLAN, perceptions=(PerceptionSpec(name="truth with a long name", uses="truth"),), clean_seeds=1)
    result = run_campaign(plan, tmp_path)
    result = dataclasses.replace(result, plan=replace(plan, scenarios=("ima_building", "ima_queue")))
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(summary_table(result))
    text = console.export_text()
    assert "…" not in text and all(column in text for column in ("episodes", "crashed", "stuck", "lost", "100 %"))


@pytest.mark.slow
def test_crashes_that_the_careful_driver_avoids_are_avoidable(tmp_path: Path) -> None:
    result = run_campaign(replace(PLAN, careful=True, clean_seeds=1), tmp_path)
    assert [one.outcome for one in result.careful] == ["arrived"]
    text = markdown(result).partition("## Crashed")[0]
    (line,) = (line for line in text.splitlines() if line.startswith("| nothing | clean"))
    assert line.split("|")[-2].strip().startswith("100 %")
    (truth,) = (line for line in text.splitlines() if line.startswith("| truth | clean"))
    assert not truth.split("|")[-2].strip(), "without a crash there is no share of them"
    assert (tmp_path / "careful.csv").is_file()


@pytest.mark.slow
def test_an_estimate_counts_all_that_is_missing(tmp_path: Path) -> None:
    plan = replace(PLAN, controls=True, careful=True, clean_seeds=1)
    episodes, seconds = runner.estimate_s(plan, tmp_path, Pool())
    assert (episodes, seconds > 0.0) == (2 + 2 + 1, True)
    assert runner.run_campaign(plan, tmp_path).made == episodes
    assert runner.estimate_s(plan, tmp_path, Pool()) == (0, 0.0)


def test_an_episode_is_looked_at_again_from_its_log(driven: Path) -> None:
    path = driven / "episodes" / f"{rows(driven)[0]['key']}.npz"
    former, same = replay_at(path, DriveOptions(what=str(path)))
    for one, other in zip(former.ticks, same.ticks, strict=True):
        assert np.array_equal(one.percept.boxes.array, other.percept.boxes.array)
    _, other = replay_at(path, DriveOptions(what=str(path), perception=(f"{EYES}:Blind",)))
    assert all(len(tick.tracks) == 0 for tick in other.ticks)
    assert EpisodeLog.load(path).outcome is former.outcome
    assert same.settings == former.settings


def test_a_log_runs_no_code_that_it_names(driven: Path, tmp_path: Path) -> None:
    log = EpisodeLog.load(driven / "episodes" / f"{rows(driven)[0]['key']}.npz")
    log.settings = replace(log.settings, perception=f"{EYES}:Blind", detector="")
    path = log.save(tmp_path / "log.npz")
    with pytest.raises(SettingsError, match=f"add --perception {EYES}:Blind"):
        replay_at(path, DriveOptions(what=str(path)))


def test_a_second_look_says_what_it_looked_with(driven: Path, tmp_path: Path) -> None:
    log = EpisodeLog.load(driven / "episodes" / f"{rows(driven)[0]['key']}.npz")
    path = EpisodeLog(log.settings, log.actors[0], log.ticks[:2], log.outcome).save(tmp_path / "log.npz")
    options = DriveOptions(what=str(path), perception=("ego",), corruption=("fog",), driver="careful")
    former, again = replay_at(path, options)
    settings = again.settings
    assert (settings.perception, settings.corruption, settings.severity) == ("ego", "fog", 3)
    assert settings.detector and settings.driver == "careful"
    heads = [column.head for column in comparison_table(former, again).columns]
    assert "tracks, truth, planning" in heads and "tracks, ego in fog 3, careful" in heads


@pytest.mark.parametrize(
    "given",
    [{"perception": ("ego", "truth")}, {"perception": ("ego",), "corruption": ("snow", "fog")}, {"severity": (2,)}],
)
def test_options_beside_a_log_that_would_do_nothing_are_refused(driven: Path, given: dict[str, Any]) -> None:
    path = driven / "episodes" / f"{rows(driven)[0]['key']}.npz"
    with pytest.raises(SettingsError, match=r"expected one value for a log|add --corruption"):
        replay_at(path, DriveOptions(what=str(path), **given))


def test_a_log_s_own_perception_looks_again_through_a_corruption(driven: Path, tmp_path: Path) -> None:
    """Options are checked as those of that perception, a detector here, not of the truth."""
    path = driven / "episodes" / f"{rows(driven)[0]['key']}.npz"
    log = EpisodeLog.load(path)
    settings = replace(log.settings, perception="ego", detector=file_sha256(SHIPPED_DETECTOR))
    short = EpisodeLog(settings, log.actors[0], log.ticks[:2], log.outcome).save(tmp_path / "log.npz")
    Drive(what=str(short), corruption=("fog",), out=tmp_path / "again").run()
    again = EpisodeLog.load(tmp_path / "again/again.npz").settings
    assert again == replace(settings, corruption="fog", severity=3, engine=engine_for(SHIPPED_DETECTOR))


def test_a_perception_that_fails_at_once_is_a_row_and_its_message_is_shown(tmp_path: Path) -> None:
    plan = replace(PLAN, clean_seeds=1, perceptions=(PerceptionSpec(name="broken", uses=f"{EYES}:Broken"),))
    assert runner.estimate_s(plan, tmp_path, Pool())[0] == 1
    result = run_campaign(plan, tmp_path)
    assert [one.outcome for one in result.results] == ["perception failed"]
    assert "broken: perception failed in 1 of 1 episodes: " in summary_table(result).caption


def test_an_agent_that_does_not_exist_fails_its_episode(tmp_path: Path) -> None:
    plan = replace(
        PLAN,
        scenarios=("lta_truck",),
        corruption=("fog",),
        corrupted_agents="999999",
        clean_seeds=1,
        seeds=1,
        perceptions=(PerceptionSpec(name="team"),),
        loop=LoopSettings(duration_s=0.5),
    )
    (row,) = (one for one in run_campaign(plan, tmp_path).results if not one.clean)
    assert row.outcome == "perception failed"
    assert re.match(r"perception: fault 'fog:3 on 999999': expected ids .* found 999999$", row.message)


def test_a_log_is_not_repeated_by_another_detector(driven: Path, tmp_path: Path) -> None:
    log = EpisodeLog.load(driven / "episodes" / f"{rows(driven)[0]['key']}.npz")
    log.settings = replace(log.settings, perception="team", detector="0" * 64)
    path = log.save(tmp_path / "log.npz")
    with pytest.raises(SettingsError, match="checkpoint: expected the detector of the log"):
        replay_at(path, DriveOptions(what=str(path)))


@pytest.mark.slow
def test_a_detector_s_episode_repeats_from_its_log(tmp_path: Path) -> None:
    options = {"perception": ("team",), "corruption": ("fog",), "seed": (0,), "duration_s": 2.0, "detect_every_s": 0.2}
    drive_episodes("lta_truck", **options, channel=("its-g5-6",), out=tmp_path)
    for row in rows(tmp_path):
        path = tmp_path / "episodes" / f"{row['key']}.npz"
        former, again = replay_at(path, DriveOptions(what=str(path)))
        assert len(former) == len(again) and any(tick.percept is not None for tick in former.ticks)
        for one, other in zip(former.ticks, again.ticks, strict=True):
            assert (one.percept is None) == (other.percept is None)
            if one.percept is not None:
                assert np.array_equal(one.percept.boxes.array, other.percept.boxes.array)


def test_two_campaigns_cannot_write_into_one_folder(tmp_path: Path) -> None:
    from dsrc.runs.lock import locked

    with locked(tmp_path, what="campaign"), pytest.raises(DataError):
        run_campaign(PLAN, tmp_path)


def test_python_drives_by_the_options_of_the_command(tmp_path: Path) -> None:
    result = drive_episodes("ima_building:no_conflict", perception=("truth",), seed=(3,), out=tmp_path)
    assert [one.seed for one in result.results] == [3] and result.results[0].outcome == "arrived"


@pytest.mark.slow
def test_a_killed_campaign_keeps_its_rows_and_resumes_to_the_same_bytes(tmp_path: Path) -> None:
    line = [
        sys.executable,
        "-m",
        "dsrc",
        "drive",
        "ima_building",
        "--perception",
        "truth",
        "sight",
        "--seed",
        *"012345",
    ]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    subprocess.run([*line, "--out", str(whole)], check=True, capture_output=True)
    process = subprocess.Popen([*line, "--out", str(killed)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while len(list(killed.glob("episodes/*.json"))) < 3:
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    kept = len(list(killed.glob("episodes/*.json")))
    assert 3 <= kept < 12
    subprocess.run([*line, "--out", str(killed)], check=True, capture_output=True)
    assert (killed / "results.csv").read_bytes() == (whole / "results.csv").read_bytes()
    assert json.loads((killed / "plan.json").read_text())["name"] == "ima_building"


def test_a_fault_is_a_row_of_tables_a_column_of_results_and_part_of_a_log(tmp_path: Path) -> None:
    """A plan without faults has neither the column nor the field: its files keep their bytes."""
    text = "latency:0.3 from 1 s to 2 s + brake_gain:0.9"
    plan = replace(PLAN, perceptions=PLAN.perceptions[:1], fault=(text,), clean_seeds=1, seeds=1)
    result = run_campaign(plan, tmp_path)
    assert [(one.title, one.clean) for one in result.results] == [("clean", True), (text, False)]
    assert [row["fault"] for row in rows(tmp_path)] == ["", text]
    assert list(read_results([tmp_path / "results.csv"]).values())[1].title == text
    assert f"| truth | {text} | 1 |" in markdown(result) and "0 with a fault" in markdown(result)
    shown = {str(row.cells[1]) for row in summary_table(result).rows}
    assert shown == {"clean", text}
    clean, faulted = (tmp_path / "episodes" / f"{one.key}.npz" for one in result.results)
    assert EpisodeLog.load(faulted).settings.fault == text
    assert '"fault"' not in str(np.load(clean)["about"]) and '"fault"' not in clean.with_suffix(".json").read_text()
    former, again = replay_at(faulted, DriveOptions(what=str(faulted)))
    ages = [[tick.actors.time_s - tick.percept.time_s for tick in log.ticks if tick.percept] for log in (former, again)]
    assert ages[0] == ages[1] and again.settings.fault == text
    other = DriveOptions(what=str(faulted), fault=("latency:0.1",))
    assert replay_at(faulted, other)[1].settings.fault == "latency:0.1"
    assert run_campaign(plan, tmp_path).made == 0
    columns = results_csv([one for one in result.results if one.clean]).partition("\n")[0].split(",")
    assert "fault" not in columns and "key" in columns
