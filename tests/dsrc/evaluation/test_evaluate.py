"""An evaluation is a small benchmark: its table, files and plots hold its rows and what made them."""

import csv
import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from dsrc.evaluation.causes.cause import FALSE, MISSED
from dsrc.evaluation.causes.results import cause_tables
from dsrc.evaluation.evaluate import evaluate_drives, plan_of_evaluation
from dsrc.evaluation.results import Row, find_row
from dsrc.evaluation.stored import read_index, read_run
from dsrc.evaluation.stress import IOU, SURE
from dsrc.options.detection import Evaluation
from dsrc.review.errors.judged import JudgedRun
from dsrc.review.sources.base import Setup
from sim.errors import DataError, SettingsError
from tests.dsrc.data.sweeps.trees import kitti_object
from tests.dsrc.evaluation.small import write_detector, write_drives

FILES = {
    "results.csv", "results.json", "timings.csv", "ap_per_corruption.png", "mce_map.png", "precision_recall.png",
    "reliability.png", "causes.csv",
}  # fmt: skip


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("evaluate")
    write_drives(root / "test", drives=1)
    for name, method in (("small", "dsrc"), ("plain", "attfuse")):
        write_detector(root / f"{name}.pt", method)
    return root


def config_of(world: Path, out: str, **settings: object) -> Evaluation:
    checkpoints = (f"DSRC={world / 'small.pt'}", str(world / "plain.pt"))
    return Evaluation(**{"checkpoint": checkpoints, "data": world / "test", "out": world / out, **settings})


def files_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")}


@pytest.fixture(scope="module")
def done(world: Path) -> tuple[Evaluation, list[Row]]:
    config = config_of(world, "out", corruption=("fog", "beam_missing"), seed=4)
    return config, evaluate_drives(config)


def test_every_error_of_an_evaluation_has_a_cause(done: tuple[Evaluation, list[Row]]) -> None:
    config, _ = done
    with (config.out / "causes.csv").open(encoding="utf-8") as file:
        assert json.loads(file.readline()[2:])["seed"] == 4
        lines = list(csv.DictReader(file))
    counts = Counter((line["method"], line["condition"], line["error"]) for line in lines)
    index, expected = read_index(config.out), Counter[tuple[str, str, str]]()
    for run in index.runs:
        judged = JudgedRun(run.method, Setup(run.condition), read_run(config.out, run.cells[0]))
        found = judged.counts(SURE, IOU)
        label = run.condition.label
        expected[run.method, label, "missed"], expected[run.method, label, "false"] = found.fn, found.fp
    assert counts == +expected and sum(counts.values()) > 0
    assert {line["kind"] for line in lines} <= {*MISSED, *FALSE} and all(line["sentence"] for line in lines)
    made = {"made by the corruption", "amid made points"}
    assert {line["condition"].split()[0] for line in lines if line["kind"] in made} == {"fog"}
    hiding = [(line["hidden_from"].split(), line["hidden_by"].split()) for line in lines]
    assert all(len(agents) == len(by) for agents, by in hiding)
    assert {one for _, by in hiding for one in by if not one.isdecimal()} == {"-"}
    tables = cause_tables(config.out)
    total = sum(row.cells[1] for table in tables for row in table.rows)
    assert total == len(lines)
    for table in tables:
        assert all(row.cells[1] == sum(row.cells[2:]) for row in table.rows), table.name


def test_an_evaluation_writes_tables_plots_and_what_made_them(done: tuple[Evaluation, list[Row]]) -> None:
    config, rows = done
    methods, conditions = ["DSRC", "plain", "DSRC, ego alone"], ["clean", "beam_missing", "fog"]
    assert [(r.condition, r.method) for r in rows[:9]] == [(kind, name) for kind in conditions for name in methods]
    assert {(r.condition, r.method) for r in rows[9:]} == {(s, name) for s in ("mean_ap", "mce") for name in methods}
    assert all((row.bytes_per_frame > 0) == ("alone" not in row.method) for row in rows[:9])
    assert all(row.heard is None and row.seconds_per_frame > 0 for row in rows[:9])
    assert rows[0].metrics["ap_bev_30"] > 0 and rows[0].result.curves["bev", 0.3].ap == rows[0].metrics["ap_bev_30"]
    assert files_in(config.out) >= FILES
    result = json.loads((config.out / "results.json").read_text())
    made_by = result["provenance"]
    assert made_by["seed"] == 4 and {"python", "platform", "commit", "versions"} <= set(made_by)
    settings = made_by["settings"]
    assert (settings["corruption"], settings["engine"]) == (["beam_missing", "fog"], "fused")
    assert (
        len(settings["methods"]["DSRC"][0]["sha256"]) == 64 and settings["methods"]["DSRC, ego alone"][0]["agents"] == 1
    )
    assert list(settings["datasets"]["test"]) == ["drive_0"]
    listed = {(row["condition"], row["method"]): row for row in result["rows"]}
    assert set(listed) == {(row.condition, row.method) for row in rows} and len(listed) == len(result["rows"])
    for row in rows:
        assert (
            listed[row.condition, row.method]["metrics"].items()
            >= {name: pytest.approx(value) for name, value in row.metrics.items() if value == value}.items()
        )
    with (config.out / "results.csv").open() as file:
        assert json.loads(file.readline()[2:]) == made_by
        lines = list(csv.DictReader(file))
    assert len(lines) == 3 * (3 + 2) and float(lines[0]["ap_bev_30"]) == rows[0].metrics["ap_bev_30"]
    assert "seconds" not in lines[0]
    times = (config.out / "timings.csv").read_text().splitlines()
    assert times[0].endswith("frames,median_seconds_per_frame") and len(times) == 1 + 3 * 3
    with Image.open(config.out / "mce_map.png") as image:
        assert json.loads(image.text["Description"]) == made_by


def test_the_ego_alone_sees_less_of_the_same_truth(done: tuple[Evaluation, list[Row]]) -> None:
    _, rows = done
    together, alone = find_row(rows, "DSRC", "clean"), find_row(rows, "DSRC, ego alone", "clean")
    assert together.truth == alone.truth > 0 and together.metrics != alone.metrics


def test_two_evaluations_write_the_same_bytes_and_the_second_computes_nothing(
    done: tuple[Evaluation, list[Row]], world: Path
) -> None:
    config, rows = done
    before = {path: path.stat().st_mtime_ns for path in (config.out / "cells").iterdir()}
    results = {name: (config.out / name).read_bytes() for name in FILES - {"timings.csv"}}
    assert len(evaluate_drives(config)) == len(rows)
    assert {path: path.stat().st_mtime_ns for path in (config.out / "cells").iterdir()} == before
    assert {name: (config.out / name).read_bytes() for name in results} == results


def test_clean_only_and_cooperative_only(world: Path) -> None:
    evaluate_drives(config_of(world, "clean", corruption=("clean",), ego_alone=False))
    rows = json.loads((world / "clean" / "results.json").read_text())["rows"]
    assert [(row["method"], row["condition"]) for row in rows] == [("DSRC", "clean"), ("plain", "clean")]
    # Without a corruption nothing is lost: a map of what is lost would be empty.
    assert files_in(world / "clean") >= FILES - {"mce_map.png"}
    assert not (world / "clean" / "mce_map.png").exists()


@pytest.mark.slow
def test_a_fault_is_a_row_and_one_that_says_a_corruption_or_a_channel_has_its_numbers(world: Path) -> None:
    mixed = "beam_missing:3 on helpers + blocked:120 on ego"
    config = config_of(world, "faults", corruption=("fog",), fault=("fog:3", mixed, "delay:0.1"), ego_alone=False)
    rows = evaluate_drives(config)
    kinds = ["clean", "fog", "fog:3", mixed, "delay:0.1"]
    assert list(dict.fromkeys(row.condition for row in rows)) == [*kinds, "mean_ap", "mce"]
    by_kind = {row.condition: row for row in rows if row.method == "DSRC"}
    assert by_kind["fog:3"].metrics == by_kind["fog"].metrics != by_kind[mixed].metrics
    mean = (by_kind["clean"].metrics["ap_bev_50"] + by_kind["fog"].metrics["ap_bev_50"]) / 2
    assert by_kind["mean_ap"].metrics["ap_bev_50"] == pytest.approx(mean), "summaries are of corruptions"
    runs = {run.kind: run for run in read_index(config.out).runs if run.method == "DSRC"}
    assert runs["fog:3"].cells == runs["fog"].cells and len({run.cells for run in runs.values()}) == 4
    late = config_of(world, "delayed", corruption=("clean",), delay_s=0.1, ego_alone=False)
    assert evaluate_drives(late)[0].metrics == by_kind["delay:0.1"].metrics != by_kind["clean"].metrics


@pytest.mark.slow
def test_causes_know_the_age_of_messages_of_what_delays_them(world: Path) -> None:
    config = config_of(world, "late", corruption=("clean",), fault=("delay:0.1",), ego_alone=False)
    evaluate_drives(config)
    with (config.out / "causes.csv").open(encoding="utf-8") as file:
        file.readline()
        lines = [line for line in csv.DictReader(file) if line["error"] == "missed"]
    told = Counter((line["condition"], "100 ms old" in line["sentence"]) for line in lines)
    assert told["delay:0.1", True] > 0 and ("clean", True) not in told
    first = [line["sentence"] for line in lines if line["condition"] == "delay:0.1" and line["position"] == "0"]
    assert first and not any("ms old" in sentence for sentence in first), "nothing was sent before the first frame"


def test_a_fault_that_a_frame_cannot_have_stops_an_evaluation_before_its_work(world: Path) -> None:
    with pytest.raises(SettingsError, match=r"^evaluate: fault 'loss:0.3 from 2 s': expected none of from, to and for"):
        evaluate_drives(config_of(world, "timed", fault=("loss:0.3 from 2 s",)))
    with pytest.raises(DataError, match=r"drive_0: frame 0: fault 'frame_drop:1 on 77': expected ids among the agents"):
        evaluate_drives(config_of(world, "stranger", fault=("frame_drop:1 on 77",)))
    assert not (world / "timed").exists() and not (world / "stranger" / "cells").exists()


def test_what_the_sweeps_do_not_take_is_left_out_of_a_group_or_refused_before_the_work(
    world: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    # Points of a KITTI tree have no rings, and those of this one no comb of elevations either.
    alone = {"data": kitti_object(tmp_path / "kitti"), "checkpoint": (str(world / "plain.pt"),), "frames": 1}
    with pytest.raises(DataError, match=r"kitti.*: frame 0: agent .*: beam_missing: expected points with their rings"):
        evaluate_drives(config_of(world, "named", corruption=("point_dropping", "beam_missing"), **alone))
    assert not (world / "named" / "cells").exists()
    rows = evaluate_drives(config_of(world, "group", corruption=("paper_six",), **alone))
    assert "evaluate: leaves out beam_missing" in caplog.text
    kinds = {row.condition for row in rows}
    assert "beam_missing" not in kinds and {"clean", "fog"} <= kinds
    assert {row.method for row in rows} == {"plain"}  # one agent is the ego alone already


@pytest.mark.slow
def test_results_that_are_replaced_are_named(world: Path, caplog: pytest.LogCaptureFixture) -> None:
    clean = {"corruption": ("clean",), "ego_alone": False}
    evaluate_drives(config_of(world, "again", **clean))
    evaluate_drives(config_of(world, "again", **clean, frames=1))  # the same methods: the former results anew
    assert "replaces" not in caplog.text
    evaluate_drives(config_of(world, "again", **clean, checkpoint=(str(world / "plain.pt"),)))
    assert "again/results.csv: replaces the results of DSRC on test" in caplog.text


@pytest.mark.slow
def test_each_detector_has_a_row_per_channel_and_the_ego_alone_one(world: Path) -> None:
    config = config_of(world, "channels", corruption=("clean",), channel=("ideal", "its-g5-6"))
    rows = evaluate_drives(config)
    through = [f"{name}, {channel}" for channel in config.channel for name in ("DSRC", "plain")]
    assert [row.method for row in rows] == [*through, "DSRC, ego alone"]
    assert all(row.bytes_per_frame > 0 for row in rows[:4]) and rows[4].bytes_per_frame == 0.0
    assert rows[0].heard == 1.0


def test_checkpoints_are_named_by_their_file_or_by_hand(world: Path) -> None:
    def names(*texts: str) -> dict[str, str]:
        plan = plan_of_evaluation(config_of(world, "out", checkpoint=texts, ego_alone=False))
        return {method.name: method.detectors[0] for method in plan.methods}

    assert names("runs/a/detector.pt", "runs/b/detector.pt", "late fusion=runs/c.pt") == {
        "a/detector": "runs/a/detector.pt",
        "b/detector": "runs/b/detector.pt",
        "late fusion": "runs/c.pt",
    }
    assert names("runs/lr=0.1/d.pt") == {"d": "runs/lr=0.1/d.pt"}
    with pytest.raises(SettingsError, match="name=path"):
        names("x=a.pt", "x=b.pt")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"checkpoint": ()}, "at least one detector"),
        ({"corruption": ("fogg",)}, "did you mean 'fog'"),
        ({"severity": 6}, "severity: expected 1 to 5, found 6"),
        ({"frames": 0}, "frames"),
        ({"engine": "fussed"}, "did you mean 'fused'"),
        ({"messages": ("udp",)}, "^evaluate: messages: expected what helpers can tell, found udp; one of: boxes, cpm"),
        ({"messages": ("cpm",), "defence": ("trust",)}, "^evaluate: defence: expected agreement or free-space"),
        ({"defence": ("free-space",)}, "found free-space; add --messages boxes"),
    ],
)
def test_a_wrong_setting_is_named(world: Path, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        evaluate_drives(config_of(world, "wrong", **settings))
    assert not (world / "wrong" / "cells").exists()
