"""Results of an evaluation open as drives with the detections of all methods, and say what is wrong with them."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from dsrc.evaluation.detection_table import join_tables
from dsrc.evaluation.evaluate import evaluate_drives
from dsrc.evaluation.metrics.ap import evaluate
from dsrc.faults.condition import frame_condition
from dsrc.models.storage.checkpoint import load_student
from dsrc.options.detection import Evaluation
from dsrc.review.frames import Recordings
from dsrc.review.model import ReviewModel
from dsrc.review.page.page import Shown
from dsrc.review.page.panels import CONTROLS
from dsrc.review.sources.base import Setup
from dsrc.review.sources.detected import ComputedSet, corrupted_frame
from dsrc.review.sources.opening import add_detectors, open_sources
from dsrc.review.state import ReviewState
from sensors.corruptions import Condition
from sim.errors import CheckpointError, DataError, SettingsError
from tests.dsrc.evaluation.small import write_detector, write_drives

FOG = Setup(Condition("fog", 3))
_WHERE = ("method", "condition", "drive", "position")
BLOCKED = Setup(frame_condition("blocked:120 on ego", "evaluate"))


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list]:
    root = tmp_path_factory.mktemp("results")
    write_drives(root / "test", drives=2)
    files = [
        f"{name}={write_detector(root / f'{method}.pt', method)}" for name, method in (("A", "dsrc"), ("B", "attfuse"))
    ]
    config = Evaluation(
        checkpoint=tuple(files),
        data=root / "test",
        out=root / "out",
        corruption=("fog",),
        fault=("blocked:120 on ego",),
        ego_alone=False,
    )
    return root, evaluate_drives(config)


def test_results_open_as_their_drives_with_a_set_for_each_method(done: tuple[Path, list]) -> None:
    root, rows = done
    sources = open_sources(root / "out")
    assert [(source.name, list(source.sets)) for source in sources] == [
        ("drive_0", ["A", "B"]),
        ("drive_1", ["A", "B"]),
    ]
    assert all(source.labelled and len(source) == 2 for source in sources)
    for row in rows:
        if row.condition in ("clean", "fog"):
            setup = Setup() if row.condition == "clean" else FOG
            table = join_tables([source.sets[row.method].run(setup) for source in sources])
            assert row.metrics.items() >= evaluate(table.results()).metrics().items()
    assert sources[0].sets["A"].conditions() == (Condition(), FOG.condition, BLOCKED.condition)
    shown = ReviewState(corruption="blocked:120 on ego", methods=("A",))
    model = Recordings(sources)
    assert model.setup(shown) == BLOCKED
    (control,) = (one for one in CONTROLS if one.field == "corruption")
    assert "blocked:120 on ego" in control.widget.options(Shown(model, shown, None))


def test_what_is_stored_is_what_the_detector_finds_here(done: tuple[Path, list]) -> None:
    root, _ = done
    (source, _), here = open_sources(root / "out"), ComputedSet("A", load_student(root / "dsrc.pt"))
    for setup in (Setup(), FOG, BLOCKED):
        for row in range(2):
            frame = source.read(row)
            corrupted = corrupted_frame(frame, setup.condition, source.seed, source.name)
            mine, stored = here.compute(row, frame, corrupted, setup), source.sets["A"].get(row, setup)
            for name, column in stored.arrays().items():
                np.testing.assert_allclose(mine.arrays()[name], column, rtol=1e-4, atol=1e-4, err_msg=name)
        assert here.rows(setup).tolist() == [0, 1]


def test_frames_other_egos_and_conditions_without_detections_are_unknown(done: tuple[Path, list]) -> None:
    root, _ = done
    stored = open_sources(root / "out")[0].sets["A"]
    ego = int(stored.get(0, Setup()).ego_id[0])
    assert stored.get(0, Setup(ego_id=ego)) is not None and stored.get(0, Setup(ego_id=ego + 1)) is None
    assert stored.get(7, Setup()) is None and stored.get(0, Setup(Condition("snow", 3))) is None
    assert len(stored.run(Setup(Condition("snow", 3)))) == 0 and len(stored.run(Setup(ego_id=ego + 1))) == 0


def test_moved_drives_are_found_where_they_are_said_to_be(done: tuple[Path, list], tmp_path: Path) -> None:
    root, _ = done
    shutil.copytree(root / "out", tmp_path / "out")
    shutil.move(shutil.copytree(root / "test", tmp_path / "other"), tmp_path / "moved")
    index = json.loads((tmp_path / "out/detections.json").read_text())
    for drive in index["drives"]:
        drive["path"] = drive["path"].replace(str(root / "test"), str(tmp_path / "gone"))
    (tmp_path / "out/detections.json").write_text(json.dumps(index))
    alone = open_sources(tmp_path / "out")
    assert (
        "detections.json: drives: drive_0: " in alone[0].note
        and "give the folder of its drives by --drives" in alone[0].note
    )
    assert len(open_sources(tmp_path / "out", tmp_path / "moved")) == 2
    with pytest.raises(DataError, match=r"detections\.json: drives: drive_0: .*give the folder of its drives"):
        open_sources(tmp_path / "out", root / "test" / "drive_1")


def test_results_whose_drives_are_gone_have_the_boxes_and_counts_that_they_had(
    done: tuple[Path, list], tmp_path: Path
) -> None:
    root, _ = done
    shutil.copytree(root / "out", tmp_path / "out")
    index = tmp_path / "out/detections.json"
    index.write_text(index.read_text().replace(str(root / "test"), str(tmp_path / "gone")))
    model, before = ReviewModel(open_sources(tmp_path / "out")), ReviewModel(open_sources(root / "out"))
    assert model.names == before.names == ["drive_0", "drive_1"]
    assert model.methods(0) == [f"{name}{of}" for of in ("", ", fog 3", ", blocked:120 on ego") for name in "AB"]
    state = ReviewState(frame=1, threshold=0.1, methods=("B",))
    view = model.view(state)
    assert view.counts == before.view(state).counts and view.counts.fn + view.counts.tp > 0
    assert view.notice.startswith("Boxes of all drives without clouds: ") and "\n" not in view.notice
    assert sum(agent.total for agent in view.agents) == 0
    foggy = model.view(replace(state, methods=("B, fog 3",)))
    assert foggy.counts == before.view(replace(state, corruption="fog")).counts


def test_a_folder_of_runs_has_every_drive_once_with_the_methods_of_all(done: tuple[Path, list], tmp_path: Path) -> None:
    root, _ = done
    for name in ("monday", "tuesday"):
        shutil.copytree(root / "out", tmp_path / "runs" / name)
    model = ReviewModel(open_sources(tmp_path / "runs"))
    assert model.names == ["drive_0", "drive_1"]
    assert model.methods(0) == ["monday: A", "monday: B", "tuesday: A", "tuesday: B"]
    state = ReviewState(threshold=0.1)
    counts = [model.view(replace(state, methods=(name,))).counts for name in ("monday: B", "tuesday: B")]
    assert counts[0] == counts[1]
    shutil.copytree(root / "test", tmp_path / "moved")
    assert len(open_sources(tmp_path / "runs", tmp_path / "moved")) == 2
    both = model.index(replace(state, methods=("monday: A", "tuesday: A"))).counts(0.1, 0.5)
    assert both["monday: A"] == both["tuesday: A"]


def test_detections_of_another_data_set_are_refused(done: tuple[Path, list], tmp_path: Path) -> None:
    root, _ = done
    shutil.copytree(root / "out", tmp_path / "out")
    write_drives(tmp_path / "other", drives=2, frames=3)
    with pytest.raises(DataError, match=r"drive_0: data: expected the drive that was evaluated"):
        open_sources(tmp_path / "out", tmp_path / "other")


def test_what_a_path_lacks_is_one_line(done: tuple[Path, list], tmp_path: Path) -> None:
    root, _ = done
    with pytest.raises(DataError, match="no such folder"):
        open_sources(tmp_path / "nowhere")
    with pytest.raises(DataError, match="expected an OPV2V tree"):
        open_sources(tmp_path)
    with pytest.raises(DataError, match=r"test: drives: expected detections\.json of dsrc evaluate"):
        open_sources(root / "test", root / "test")
    (tmp_path / "a.npz").write_bytes(b"nothing")
    with pytest.raises(DataError, match=r"a\.npz"):
        open_sources(tmp_path / "a.npz")


def test_a_foreign_checkpoint_and_a_repeated_name_are_one_line(done: tuple[Path, list], tmp_path: Path) -> None:
    root, _ = done
    sources = open_sources(root / "out")
    (tmp_path / "foreign.pt").write_bytes(b"nothing")
    with pytest.raises(CheckpointError, match=r"foreign\.pt"):
        add_detectors(sources, [str(tmp_path / "foreign.pt")])
    with pytest.raises(SettingsError, match="names that differ"):
        add_detectors(sources, [f"A={root / 'dsrc.pt'}"])
    add_detectors(sources, [f"again={root / 'dsrc.pt'}"])
    assert list(sources[1].sets) == ["A", "B", "again"] and sources[1].sets["again"].conditions() is None


def test_a_damaged_cell_and_frames_of_another_drive_name_their_file(done: tuple[Path, list], tmp_path: Path) -> None:
    root, _ = done
    out = shutil.copytree(root / "out", tmp_path / "out")
    index = json.loads((out / "detections.json").read_text())
    first = index["runs"][0]["cells"]
    (out / "cells" / f"{first[0][0]}.npz").write_bytes(b"damaged")
    with pytest.raises(DataError, match=rf"{first[0][0]}\.npz"):
        open_sources(out)[0].sets["A"].get(0, Setup())
    first[1] = first[1] * 2
    (out / "detections.json").write_text(json.dumps(index))
    with pytest.raises(DataError, match="drive drive_1: position: expected ascending numbers"):
        open_sources(out)[1].sets["A"].get(0, Setup())


def test_conditions_have_titles() -> None:
    titles = [c.label for c in (Condition(), FOG.condition, Condition("beam_missing", 5, "paper", "ego"))]
    assert titles == ["clean", "fog 3", "beam missing 5 (paper), ego"]


def test_the_page_says_of_every_error_what_its_table_of_causes_says(done: tuple[Path, list]) -> None:
    root, _ = done
    model = ReviewModel(open_sources(root / "out"))
    with (root / "out/causes.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    assert rows
    for name, condition, drive, position in sorted({tuple(row[key] for key in _WHERE) for row in rows}):
        kind, _, severity = condition.partition(" ")
        fog = {"corruption": "fog", "severity": int(severity)} if kind == "fog" else {"corruption": condition}
        number = [source.name for source in model.sources].index(drive)
        state = ReviewState(drive=number, frame=int(position), methods=(name,), threshold=0.3, **fog)
        told = {(one.error, one.object_id, one.rank): one.sentence for one in model.causes(state)}
        here = [row for row in rows if tuple(row[key] for key in _WHERE) == (name, condition, drive, position)]
        numbers = [tuple(int(row[key]) if row[key] else None for key in ("object_id", "rank")) for row in here]
        assert told == {(row["error"], *own): row["sentence"] for row, own in zip(here, numbers, strict=True)}


def test_who_is_out_of_reach_or_beyond_the_number_of_agents_takes_no_part(done: tuple[Path, list]) -> None:
    source = open_sources(done[0] / "out")[0]
    stored, frame = source.sets["A"], source.read(0)
    ego, *others = (agent.agent_id for agent in frame.agents)
    run = stored.runs[Condition()]
    for changes, team in (({}, (ego, *others)), ({"comm_range_m": 0.1}, (ego,)), ({"agents": 1}, (ego,))):
        stored.runs[Condition()] = msgspec.structs.replace(run, **changes)
        assert stored.team(frame, ego, Setup()) == (team, run.range_m)
