"""Scores by source: what counts in frames of several data sets, and what costs nothing."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from dsrc.__main__ import main
from dsrc.data.drives import find_drives, open_drive
from dsrc.evaluation.scoring.frames import FrameKey
from dsrc.evaluation.scoring.sources import ALL, SourceScore, score_sources, source_table
from dsrc.evaluation.scoring.truth import read_truth
from dsrc.evaluation.scoring.write import FoundFrame, write_json
from dsrc.ops.detections import Detections
from sim.boxes import Boxes
from sim.errors import DataError
from tests.dsrc.data.sweeps.scene import FRAMES
from tests.dsrc.data.sweeps.trees import argoverse, kitti_object, scans
from tests.dsrc.evaluation.small import write_detector

RAISED_M = 0.1
UNSEEN = "Car 0.00 0 0 0 0 0 0 1.50 1.80 4.20 2.00 1.60 35.00 0.00\n"
"""A car of KITTI's labels without a point, 35 m before the camera and 2 m to the right."""


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("sources")
    kitti_object(root / "data" / "kitti", more=UNSEEN)
    scans(root / "data" / "own")
    return root


def found_in(tree: Path, more: list[list[float]] | None = None, scores: list[float] | None = None) -> list[FoundFrame]:
    """Every true vehicle, `RAISED_M` too high, and further boxes with their scores, in all frames of a tree."""
    frames = []
    for path in find_drives(tree):
        drive = open_drive(path)
        agent = drive.read(0).agents[0].agent_id
        for key, truth in read_truth(tree, [FrameKey(path.name, number) for number in drive.frames]).items():
            right = truth.boxes.array[~truth.own] + [0.0, 0.0, RAISED_M, 0.0, 0.0, 0.0, 0.0]
            array = np.concatenate([right, np.reshape(more or [], (-1, 7))])
            score = np.concatenate([np.full(len(right), 0.9), scores or []]).astype(np.float32)
            found = Detections(Boxes.from_array(array), score)
            frames.append(FoundFrame(path.name, key.frame, agent, found, truth.boxes))
    return frames


def by_source(scores: list[SourceScore]) -> dict[str, SourceScore]:
    return {one.source: one for one in scores}


def test_each_folder_is_a_source_and_their_frames_add_up(world: Path, tmp_path: Path) -> None:
    scores = by_source(score_sources(write_json(tmp_path, found_in(world / "data")), world / "data"))
    assert list(scores) == [ALL, "kitti", "own"]
    assert [one.frames for one in scores.values()] == [2 * FRAMES, FRAMES, FRAMES]
    assert [one.vehicles for one in scores.values()] == [2 * FRAMES, FRAMES, FRAMES]
    for one in scores.values():
        assert one.ap == {0.5: 1.0, 0.7: 1.0} and one.recall == 1.0 and one.false_per_frame == 0.0
        assert one.height_m == pytest.approx(RAISED_M, abs=1e-3)


def test_false_boxes_count_from_the_score_on_and_unseen_cars_cost_nothing(world: Path, tmp_path: Path) -> None:
    ahead, unsure, beyond = ([x, -8.0, -0.9, 4.0, 1.8, 1.5, 0.0] for x in (20.0, 28.0, 60.0))
    on_unseen = [35.3, -2.0, -0.9, 4.2, 1.8, 1.5, np.pi / 2]
    more, sure = [ahead, unsure, beyond, on_unseen], [0.95, 0.1, 0.95, 0.95]
    scores = by_source(score_sources(write_json(tmp_path, found_in(world / "data", more, sure)), world / "data"))
    assert scores["kitti"].false_per_frame == 1.0
    assert scores["own"].false_per_frame == 2.0  # nobody labelled a car there
    assert scores[ALL].false_per_frame == 1.5
    assert scores[ALL].recall == 1.0
    # Three false boxes before three true ones: precision is 1/2 at every recall in the end.
    assert scores["kitti"].ap[0.5] == pytest.approx(0.5)


def test_what_is_not_found_is_missed(world: Path, tmp_path: Path) -> None:
    frames = [one._replace(found=one.found[:0]) for one in found_in(world / "data")]
    everything = score_sources(write_json(tmp_path, frames), world / "data")[0]
    assert everything.recall == 0.0 and everything.ap[0.5] == 0.0 and math.isnan(everything.height_m)
    assert "nan" not in source_table([everything]).markdown()


def test_boxes_of_no_labelled_frame_are_refused(world: Path, tmp_path: Path) -> None:
    scans(tmp_path / "bare", labelled=False)
    path = write_json(
        tmp_path, [FoundFrame("scans", 0, 0, Detections(Boxes.zeros(), np.zeros(0, np.float32)), Boxes.zeros())]
    )
    with pytest.raises(DataError, match="truth: expected frames with ground truth"):
        score_sources(path, tmp_path / "bare")


def test_a_log_of_argoverse_is_scored_too(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    argoverse(tmp_path / "data")
    (one,) = score_sources(write_json(tmp_path, found_in(tmp_path / "data")), tmp_path / "data")
    assert one.vehicles == FRAMES and one.ap[0.7] == 1.0
    assert one.height_m == pytest.approx(RAISED_M, abs=0.02)


def test_drives_of_one_name_are_refused_before_the_work(world: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("one", "other"):
        kitti_object(world / "twice" / name)
    write_detector(world / "small.pt", "attfuse")
    line = ["detect", str(world / "twice"), "--checkpoint", str(world / "small.pt"), "--score"]
    with pytest.raises(SystemExit) as ended:
        main([*line, "--out", str(world / "twice_bar")])
    assert ended.value.code == 2
    assert "drives: expected names that differ, found training twice" in capsys.readouterr().err
    assert not (world / "twice_bar").exists()


def test_one_command_detects_and_scores(world: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_detector(world / "small.pt", "attfuse")
    line = ["detect", str(world / "data"), "--checkpoint", str(world / "small.pt"), "--score"]
    for _ in range(2):  # again replaces what it wrote
        main([*line, "--out", str(world / "bar"), "--workers", "1"])
    printed = capsys.readouterr().out
    assert "false" in printed and "kitti" in printed and "own" in printed
    rows = json.loads((world / "bar" / "sources.json").read_text())["rows"]
    assert [row["source"] for row in rows] == [ALL, "kitti", "own"]
    assert all(row["vehicles"] == row["frames"] for row in rows)
