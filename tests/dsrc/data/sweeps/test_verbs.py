"""The table of `docs/your_data.md`: every verb takes every format, each cell on files in that format."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dsrc.data.datasets.check import check_dataset
from dsrc.data.datasets.convert import convert
from dsrc.data.datasets.corrupt import corrupt_dataset
from dsrc.data.drives import labelled_frames, open_drives
from dsrc.evaluation.detect import Method, evaluate_drive, frame_positions
from dsrc.evaluation.find import detect_drives
from dsrc.evaluation.scoring.read import read_detections
from dsrc.evaluation.scoring.score import score
from dsrc.realism.gauge import compare, measure
from dsrc.training.samples import SampleStore
from sensors.corruptions import Condition
from sim.boxes import Boxes
from sim.errors import DataError
from tests.dsrc.data.sweeps import trees
from tests.dsrc.data.sweeps.scene import FRAMES
from tests.dsrc.evaluation.fakes import PointCounter
from tests.paths import ROOT

FORMATS: dict[str, tuple[Callable[[Path], Path], str | None]] = {
    "KITTI object": (trees.kitti_object, None),
    "KITTI tracking": (trees.kitti_tracking, None),
    "SemanticKITTI": (trees.semantic_kitti, None),
    "nuScenes": (trees.nuscenes, None),
    "Argoverse 2": (trees.argoverse, "pyarrow"),
    "OpenLABEL": (trees.openlabel, None),
    "bag": (trees.rosbag, "rosbags"),
    "folder of scans": (trees.scans, None),
}
WITHOUT_TRUTH = ("SemanticKITTI", "bag")
VERBS = ("check", "convert", "corrupt", "detect", "evaluate", "train", "view", "score --truth", "realism")


@pytest.fixture(params=list(FORMATS))
def tree(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path]:
    make, package = FORMATS[request.param]
    if package is not None:
        pytest.importorskip(package)
    return request.param, make(tmp_path / "data")


def test_check_finds_no_fault(tree: tuple[str, Path]) -> None:
    assert check_dataset(tree[1]) == []


def test_convert_keeps_points_and_boxes(tree: tuple[str, Path], tmp_path: Path) -> None:
    convert(data=tree[1], out=tmp_path / "out", to="opv2v")
    (before,), (after,) = open_drives(tree[1]), open_drives(tmp_path / "out")
    for i in range(FRAMES):
        old, new = before.read(i), after.read(i)
        assert np.array_equal(new.agents[0].sweep.points, old.agents[0].sweep.points)
        assert np.abs(new.truth.array - old.truth.array).max(initial=0.0) < 1e-9


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (trees.kitti_object, ["--to mcap does not keep where the labels of 1 of 1 drives are complete"]),
        (trees.nuscenes, []),
        (trees.semantic_kitti, ["--to mcap does not keep that 3 of 3 frames have no ground truth"]),
    ],
)
def test_convert_says_in_a_line_what_it_does_not_keep_of_labels(
    make: Callable[[Path], Path], said: list[str], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("mcap")
    convert(data=make(tmp_path / "data"), out=tmp_path / "out", to="mcap")
    assert [record.getMessage() for record in caplog.records] == said


def _to_opv2v(data: Path, out: Path) -> Path:
    convert(data=data, out=out, to="opv2v")
    return out


def _in_fog(data: Path, out: Path) -> Path:
    return corrupt_dataset(data=data, out=out, corruption="fog", severity=1)[0]


@pytest.mark.parametrize("again", [_to_opv2v, _in_fog])
def test_opv2v_keeps_where_labels_are_complete(
    again: Callable[[Path, Path], Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A car in the picture counts, one beside it and one in a region of no care do not, before and after."""
    data = trees.kitti_object(tmp_path / "data", "DontCare -1 -1 -10 500 150 560 200 -1 -1 -1 -1000 -1000 -1000 -10\n")
    convert(data=data, out=tmp_path / "once", to="opv2v")
    (before,), (after,) = open_drives(data), open_drives(again(tmp_path / "once", tmp_path / "twice"))
    assert after.format == "OPV2V" and not after.complete() and not caplog.records
    rng = np.random.default_rng(0)
    for i in range(FRAMES):
        old, new = before.read(i).region, after.read(i).region
        assert old is not None and new is not None
        assert len(new.ignored_px) == len(old.ignored_px) == 1 and len(new.ignored) == len(old.ignored)
        there = rng.uniform([-10.0, -30.0, -1.0], [60.0, 30.0, 1.0], (500, 3))
        rows = np.column_stack([there, np.tile([4.0, 2.0, 1.5, 0.3], (500, 1))])
        counts = old.counts(Boxes.from_array(rows))
        assert 50 < counts.sum() < 450
        assert np.array_equal(new.counts(Boxes.from_array(rows)), counts)


@pytest.mark.parametrize("again", [_to_opv2v, _in_fog])
def test_opv2v_keeps_that_frames_have_no_labels(
    again: Callable[[Path, Path], Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = trees.kitti_object(tmp_path / "data")
    (lost,) = data.glob("training/label_2/000001.txt")
    lost.unlink()
    (before,) = open_drives(data)
    assert len(labelled_frames(before)) == FRAMES - 1
    convert(data=data, out=tmp_path / "once", to="opv2v")
    (after,) = open_drives(again(tmp_path / "once", tmp_path / "twice"))
    assert [after.frames[i] for i in labelled_frames(after)] == [before.frames[i] for i in labelled_frames(before)]
    assert not caplog.records
    convert(data=after.drive, out=tmp_path / "kitti", to="kitti")
    lost_in_kitti = "--to kitti does not keep that 1 of 3 frames have no ground truth"
    assert [record.getMessage().partition(", nor ")[0] for record in caplog.records] == [lost_in_kitti]


def test_corrupt_keeps_that_nobody_labelled_a_bag(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    (drive,) = corrupt_dataset(data=trees.rosbag(tmp_path / "data"), out=tmp_path / "out", corruption="fog", severity=1)
    (after,) = open_drives(drive)
    assert after.format == "OPV2V" and len(after) == FRAMES
    assert labelled_frames(after) == []


def test_corrupt_changes_the_points(tree: tuple[str, Path], tmp_path: Path) -> None:
    corrupt_dataset(data=tree[1], out=tmp_path / "out", corruption="fog", severity=5)
    before, after = open_drives(tree[1])[0].read(0), open_drives(tmp_path / "out")[0].read(0)
    clean, foggy = before.agents[0].sweep, after.agents[0].sweep
    assert len(foggy) > 0
    assert not np.array_equal(foggy.intensity, clean.intensity)


def test_a_corrupted_tree_is_the_same_drive_with_the_same_truth(tree: tuple[str, Path], tmp_path: Path) -> None:
    again = tmp_path / "twice" / "data"
    for data, out in ((tree[1], tmp_path / "once" / "data"), (tmp_path / "once" / "data", again)):
        corrupt_dataset(data=data, out=out, corruption="point_dropping")
    (before,), (after,) = open_drives(tree[1]), open_drives(again)
    assert (after.drive.name, after.frames) == (before.drive.name, before.frames)
    assert labelled_frames(after) == labelled_frames(before)
    old, new = before.read(1), after.read(1)
    assert np.allclose(new.truth.array, old.truth.array, rtol=0, atol=1e-9)
    assert np.allclose(new.agents[0].sweep.world_from_lidar, old.agents[0].sweep.world_from_lidar, rtol=0, atol=1e-9)
    assert len(new.agents[0].sweep) < len(old.agents[0].sweep)


def test_detect_writes_boxes_with_and_without_truth(tree: tuple[str, Path], tmp_path: Path) -> None:
    checkpoint = str(ROOT / "dsrc" / "checkpoints" / "small-plain.pt")
    row, (boxes,) = detect_drives(checkpoint=checkpoint, data=tree[1], out=tmp_path / "boxes")
    (found,) = read_detections(boxes)
    (drive,) = open_drives(tree[1])
    assert row.frames == FRAMES
    assert [(key.drive, key.frame) for key in found.frames] == [(drive.drive.name, frame) for frame in drive.frames]
    assert row.detections == sum(map(len, found.frames.values())) > 0


def test_evaluate_judges_what_is_labelled(tree: tuple[str, Path]) -> None:
    name, data = tree
    (drive,) = open_drives(data)
    method, clean = Method("counter", PointCounter()), Condition("clean", 1, "physical")
    if name in WITHOUT_TRUTH:
        with pytest.raises(DataError, match=r"ground truth: expected boxes of at least one frame, found none; .*judge"):
            frame_positions([drive], None)
        return
    positions = frame_positions([drive], None)[0]
    assert positions == list(range(FRAMES))
    result = evaluate_drive(drive, positions, {clean: [method]}, 0)[clean, "counter"]
    assert [len(frame.truth) for frame in result.table.results()] == [1] * FRAMES
    assert [len(frame.detections) for frame in result.table.results()] == [1] * FRAMES


def test_train_takes_the_labelled_frames(tree: tuple[str, Path]) -> None:
    name, data = tree
    request, drives = PointCounter().settings, [drive.drive for drive in open_drives(data)]
    if name in WITHOUT_TRUTH:
        with pytest.raises(DataError, match="frames with ground truth: expected at least one"):
            SampleStore(drives, request)
        return
    store = SampleStore(drives, request)
    assert len(store.frames) == len(labelled_frames(store.drives[0])) == FRAMES
    sample = store.sample(store.frames[0], store.egos(store.frames[0])[0])
    assert len(sample.boxes) == 1
    assert len(sample.clouds[0]) > 500


def test_view_shows_the_clouds(tree: tuple[str, Path], tmp_path: Path) -> None:
    from dsrc.review.page.output.export import export_html

    page = export_html(data=tree[1], out=tmp_path / "page.html", frames=1)
    assert page.stat().st_size > 10_000


def test_score_takes_the_truth_of_a_tree(tree: tuple[str, Path], tmp_path: Path) -> None:
    name, data = tree
    if name in WITHOUT_TRUTH:
        pytest.skip("no ground truth")
    (drive,) = open_drives(data)
    frames = []
    for i in range(FRAMES):
        sweep = drive.read(i).agents[0].sweep
        boxes = drive.read(i).truth.transform(np.linalg.inv(sweep.world_from_lidar))
        rows = boxes[boxes.is_vehicle].array.tolist()
        frames.append({"drive": drive.drive.name, "frame": drive.frames[i], "boxes": rows, "score": [0.9] * len(rows)})
    (tmp_path / "boxes.json").write_text(json.dumps({"frames": frames}))
    (result,) = score(tmp_path / "boxes.json", data, "opencood")
    assert result.ap["bev", 0.7] == pytest.approx(1.0)


def test_realism_takes_the_clouds(tree: tuple[str, Path]) -> None:
    sweeps = measure([tree[1]])
    assert len(sweeps) >= FRAMES  # a bag has two sensors
    assert {"range", "residual", "slope", "standing_15", "intensity_ground"} <= set(sweeps[0])
    assert all(row.distance == 0.0 for row in compare(sweeps, sweeps))


def test_the_page_has_a_row_for_each_format_and_a_column_for_each_verb() -> None:
    lines = (ROOT / "docs" / "your_data.md").read_text().splitlines()
    head = next(k for k, line in enumerate(lines) if line.startswith("| format |"))
    assert lines[head].split("|")[2:-1] == [f" `{verb}` " for verb in VERBS]
    rows = {line.split("|")[1].strip() for line in lines[head + 2 : head + 2 + len(FORMATS)]}
    assert rows == set(FORMATS)
