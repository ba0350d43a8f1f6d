"""Stored detections: what an evaluation found is read again, scored to the same numbers, and checked."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from dsrc.data.drives import open_drive
from dsrc.data.sample import make_sample
from dsrc.evaluation.detect import Method, evaluate_drive
from dsrc.evaluation.detection_table import DetectionTable, join_tables, one_frame, points_left, read_table
from dsrc.evaluation.evaluate import evaluate_drives
from dsrc.evaluation.metrics.ap import evaluate
from dsrc.evaluation.stored import read_index, read_run
from dsrc.ops.detections import Detections
from dsrc.ops.grid import GridSpec
from dsrc.options.detection import Evaluation
from sensors.corruptions import Condition, corrupt_frame, drive_seed
from sim.boxes import Boxes
from sim.errors import DataError
from tests.dsrc.evaluation.fakes import GRID, PointCounter
from tests.dsrc.evaluation.small import write_detector, write_drives


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list]:
    root = tmp_path_factory.mktemp("stored")
    write_drives(root / "test", drives=2)
    config = Evaluation(
        checkpoint=(f"DSRC={write_detector(root / 'dsrc.pt', 'dsrc')}",),
        data=root / "test",
        out=root / "out",
        corruption=("fog",),
    )
    return config.out, evaluate_drives(config)


@pytest.mark.slow
def test_stored_detections_score_what_the_evaluation_says(done: tuple[Path, list]) -> None:
    out, rows = done
    index = read_index(out)
    assert [drive.name for drive in index.drives] == ["drive_0", "drive_1"]
    by_name = {(row.method, row.condition): row for row in rows}
    for run in index.runs:
        table = join_tables([read_run(out, keys) for keys in run.cells])
        row = by_name[run.method, run.kind]
        assert evaluate(table.results()).metrics().items() <= row.metrics.items()
        assert (len(table), len(table.truth), len(table.score)) == (row.frames, row.truth, row.detections)
    assert {(run.method, run.kind) for run in index.runs} == {
        (method, kind) for method in ("DSRC", "DSRC, ego alone") for kind in ("clean", "fog")
    }
    assert any(len(read_run(out, run.cells[0]).score) for run in index.runs)


def test_boxes_of_one_drive_id_and_size_are_one_object() -> None:
    """The same id in another drive is another object, and so is one of another size: its reader has no tracks."""

    def frame(position: int, *boxes: tuple[int, float, float]) -> DetectionTable:
        rows = [(x, 0.0, 0.0, length, 1.8, 1.5, 0.0) for _, x, length in boxes]
        truth = Boxes.from_array(rows, object_id=[number for number, _, _ in boxes])
        return one_frame(position, position, 0, Detections.zeros(), truth)

    table = join_tables([frame(0, (7, 40.0, 4.5), (8, 20.0, 4.2)), frame(1, (7, 30.0, 4.5)), frame(0, (7, 30.0, 4.5))])
    first, other, again, elsewhere = table.objects(np.array([0, 0, 1])).tolist()
    assert first == again and len({first, other, elsewhere}) == 3
    assert len(set(join_tables([frame(0, (1, 9.0, 4.5)), frame(1, (1, 9.0, 4.9))]).objects(np.zeros(2, int)))) == 2


def test_a_table_names_frames_ego_and_points_of_the_drive(done: tuple[Path, list]) -> None:
    out, _ = done
    index = read_index(out)
    drive = open_drive(Path(index.drives[1].path))
    assert drive.digest() == index.drives[1].data
    clean, fog = (read_run(out, next(r for r in index.runs if r.kind == kind).cells[1]) for kind in ("clean", "fog"))
    for row, position in enumerate(clean.position):
        frame = drive.read(int(position))
        sample = make_sample(frame, None, GridSpec(range_m=index.runs[0].range_m))
        truth = clean.results()[row].truth
        assert clean.index[row] == frame.index and clean.ego_id[row] == sample.agent_ids[0]
        assert truth.object_id.tolist() == sample.boxes.object_id.tolist()
        np.testing.assert_array_equal(truth.array.astype(np.float32), sample.boxes.array.astype(np.float32))
    assert (clean.points[:, 0] <= clean.points[:, 1]).all() and (clean.points[:, 1] > 0).all()
    # Nothing is lost in clean air, and fog adds no point of an object.
    np.testing.assert_array_equal(clean.points[:, :2], clean.points[:, 2:])
    np.testing.assert_array_equal(clean.points[:, :2], fog.points[:, :2])
    assert (fog.points[:, 2:] <= fog.points[:, :2]).all() and (fog.points[:, 3] < fog.points[:, 1]).any()


def test_an_index_that_is_missing_or_wrong_is_one_line(done: tuple[Path, list], tmp_path: Path) -> None:
    out, _ = done
    with pytest.raises(DataError, match="nowhere: results: expected a folder, found no such folder"):
        read_index(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"detections\.json: expected the index of stored detections, found none"):
        read_index(tmp_path)
    whole = json.loads((out / "detections.json").read_text())
    wrong = {
        "version": ({**whole, "version": 2}, "version: expected 1, found 2"),
        "cells": ({**whole, "drives": whole["drives"][:1]}, "runs: DSRC: cells: expected cells of 1 drives, found 2"),
        "field": ({**whole, "more": 1}, "content: expected an index of detections"),
        "key": (
            {**whole, "runs": [{**whole["runs"][0], "cells": [["../../x"], []]}]},
            "content: expected an index of detections",
        ),
    }
    for content, message in wrong.values():
        (tmp_path / "detections.json").write_text(json.dumps(content))
        with pytest.raises(DataError, match=message):
            read_index(tmp_path)


def _table(n: int = 3, d: int = 4) -> DetectionTable:
    rng = np.random.default_rng(0)
    boxes = np.column_stack([rng.normal(0, 20, (n + d, 3)), rng.uniform(1, 5, (n + d, 3)), rng.uniform(-3, 3, n + d)])
    detections = Detections(Boxes.from_array(boxes[n:]), np.sort(rng.random(d).astype(np.float32))[::-1])
    return one_frame(5, 50, 1000, detections, Boxes.from_array(boxes[:n], object_id=np.arange(n)))


def test_columns_come_back_as_they_were() -> None:
    table = join_tables([_table(), _table(0, 0), _table(2, 9)])
    again = read_table(Path("a.npz"), table.arrays())
    for name, column in table.arrays().items():
        np.testing.assert_array_equal(column, again.arrays()[name], err_msg=name)
    assert len(join_tables([])) == 0 and join_tables([]).results() == []


def test_numbers_of_frames_may_be_microseconds_and_those_of_32_bits_are_read() -> None:
    arrays = _table().arrays()
    stamps = {**arrays, "index": np.array([1_532_402_927_647_951])}
    assert read_table(Path("a.npz"), stamps).arrays()["index"] == stamps["index"]
    assert read_table(Path("a.npz"), {**arrays, "index": np.array([50], np.int32)}).index == [50]


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("boxes", lambda c: c[:, :6], r"shape \(n, 7\)"),
        ("boxes", lambda c: c.astype(np.float64), "an array of float32, found float64"),
        ("boxes", lambda c: c[:-1], "one row for each of 4 detections, found 3"),
        ("boxes", lambda c: np.where(np.arange(7) == 3, np.float32(0), c), "positive sizes, found 0 m"),
        ("truth", lambda c: np.where(np.arange(7) == 0, np.float32(np.nan), c), "finite numbers"),
        ("score", lambda c: c + np.float32(1), "0 to 1"),
        ("score", lambda c: c[::-1], "the best first in each frame"),
        ("label", lambda c: c + np.uint8(7), "numbers below 7"),
        ("found", lambda c: -c, "numbers of at least 0"),
        ("points", lambda c: c - np.int32(1), "numbers of at least -1"),
        ("ego_id", lambda c: None, "an array of int64, found none"),
    ],
)
def test_a_wrong_column_is_named_with_its_file(
    name: str, change: Callable[[np.ndarray], np.ndarray], message: str
) -> None:
    arrays = {**_table().arrays()}
    arrays[name] = change(arrays[name])
    with pytest.raises(DataError, match=rf"a\.npz: {name}: expected {message}"):
        read_table(Path("a.npz"), {key: c for key, c in arrays.items() if c is not None})


def test_a_network_whose_sizes_underflow_is_stored_and_finds_nothing() -> None:
    flat = Boxes.from_array([[0.0, 0, 0, 0, 0, 0, 0]])
    table = one_frame(0, 0, 1, Detections(flat, np.ones(1, np.float32)), Boxes.from_array([[0.0, 0, 0, 4, 2, 2, 0]]))
    read_table(Path("a.npz"), table.arrays())
    assert evaluate(table.results()).metrics()["ap_bev_30"] == 0.0


def test_points_that_are_left_are_those_of_the_corrupted_sweeps(tmp_path: Path) -> None:
    drive = open_drive(write_drives(tmp_path, drives=1) / "drive_0")
    frame = drive.read(0)
    np.testing.assert_array_equal(points_left(frame, frame), frame.points_on)
    thinner = frame.with_sweeps([agent.sweep[::3] for agent in frame.agents])
    left = points_left(frame, thinner)
    assert (left <= frame.points_on).all() and 0 < left.sum() < frame.points_on.sum()
    # Boxes tell the same where points do not know their object, but for a point of the road at the foot of a box.
    anonymous = frame.with_sweeps(
        [replace(agent.sweep, object_id=np.full_like(agent.sweep.object_id, -1)) for agent in frame.agents]
    )
    fewer = anonymous.with_sweeps([agent.sweep[::3] for agent in anonymous.agents])
    by_box = points_left(anonymous, fewer)
    assert (by_box >= left).all() and (by_box <= left + 1).all()


def test_detections_of_a_drive_carry_the_points_of_all_that_take_part(tmp_path: Path) -> None:
    drive = open_drive(write_drives(tmp_path, drives=1) / "drive_0")
    condition = Condition("beam_missing", 5)
    methods = [Method("all", PointCounter(grid=GRID)), Method("alone", PointCounter(grid=GRID), agents=1)]
    results = evaluate_drive(drive, [0], {condition: methods}, seed=0)
    tables = [results[condition, method.name].table for method in methods]
    np.testing.assert_array_equal(tables[0].points, tables[1].points)
    frame = drive.read(0)
    corrupted = corrupt_frame(frame, "beam_missing", 5, drive_seed(0, "drive_0"))
    objects = np.searchsorted(frame.truth.object_id, tables[0].object_id)
    np.testing.assert_array_equal(tables[0].points[:, 3], points_left(frame, corrupted)[:, objects].sum(axis=0))


def test_the_index_says_what_made_it(done: tuple[Path, list]) -> None:
    out, _ = done
    index = read_index(out)
    assert msgspec.json.decode((out / "detections.json").read_bytes(), type=type(index)) == index
    alone = [run for run in index.runs if run.method.endswith("alone")]
    assert {run.agents for run in alone} == {1} and all(len(run.detector) == 64 for run in index.runs)
