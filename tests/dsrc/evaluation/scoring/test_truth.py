"""True boxes of trees: those an evaluation takes, and what the protocols choose among."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dsrc.data.datasets.convert import convert
from dsrc.data.drives import open_drive
from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.data.sample import OPENCOOD_RANGE_M, SampleRequest, make_sample
from dsrc.evaluation.metrics.protocols import PROTOCOLS
from dsrc.evaluation.scoring.frames import FrameKey, Truth, select
from dsrc.evaluation.scoring.score import score
from dsrc.evaluation.scoring.truth import read_truth, truth_of_frame
from dsrc.ops.detections import Detections
from dsrc.ops.grid import GridSpec
from sim.boxes import Boxes
from sim.errors import DataError
from tests.dsrc.data.dair_tree import make
from tests.dsrc.data.goldens import unpack_opv2v_mini
from tests.dsrc.data.sweeps.trees import scans
from tests.dsrc.data.toy import toy_frame

GRID = GridSpec(range_m=(-51.2, -25.6, -3.0, 51.2, 25.6, 1.0))


def ids_in(name: str, truth: Truth) -> set[int]:
    return set(select(PROTOCOLS[name], Detections.zeros(), truth).truth.object_id.tolist())


@pytest.mark.parametrize("keep_ego", [True, False])
def test_opencoods_protocol_takes_the_boxes_that_opencood_judges(tmp_path: Path, keep_ego: bool) -> None:
    for drive in sorted(unpack_opv2v_mini(tmp_path).glob("*/")):
        reader = open_drive(drive)
        for i in range(len(reader)):
            frame = reader.read(i)
            settings = {"keep_ego_box": keep_ego, "team_by": "folders", "truth_range_m": OPENCOOD_RANGE_M}
            sample = make_sample(frame, None, SampleRequest(GRID, **settings))
            found = ids_in("opencood" if keep_ego else "opencood-no-ego", truth_of_frame(frame))
            assert found == set(sample.boxes.object_id.tolist()) and found


def test_the_ego_counts_where_a_protocol_says_so_and_reach_ends_where_it_says_so() -> None:
    frame = toy_frame(0)
    truth = truth_of_frame(frame, 1000)
    # 1003 is a pedestrian, 1005 is 900 m away and has no point; 1002 sees the ego.
    assert truth.boxes.object_id.tolist() == [1000, 1001, 1002, 1004] and truth.own.tolist() == [True] + [False] * 3
    assert truth.boxes.array[0, :2] == pytest.approx([0.0, 0.0], abs=0.1)
    assert truth.reach_m[1:].tolist() == [0.0, 0.0, 0.0] and 20 < truth.reach_m[0] < 32
    assert ids_in("testbed", truth) == {1001, 1002, 1004} and 1000 in ids_in("coalign", truth) | {1000}
    far = Truth(truth.boxes, truth.own, np.full(4, 80.0))
    assert not ids_in("testbed", far) and ids_in("kitti-r40", far) == {1001, 1002, 1004}
    with pytest.raises(DataError, match="frame 0: ego: expected one of the agents"):
        truth_of_frame(frame, 7)


def test_without_ids_the_ego_is_the_box_around_the_origin() -> None:
    boxes = Boxes.from_array([[20, 0, -1, 4, 2, 1.5, 0], [0.5, 0.3, -1, 4, 2, 1.5, 1.0], [0, 2, -1, 4, 2, 1.5, 0]])
    assert Truth.of(boxes).own.tolist() == [False, True, False]
    assert len(Truth.of(Boxes.zeros()).own) == 0


def test_a_kitti_tree_has_the_boxes_of_the_drive_it_was_made_of(tmp_path: Path) -> None:
    for index in range(2):
        write_frame(tmp_path / "data" / "one", toy_frame(index))
    tree = convert(tmp_path / "data", tmp_path / "kitti", "kitti", view="around")
    with (tree / "frames.csv").open() as file:
        places = {int(row["number"]): int(row["frame"]) for row in csv.DictReader(file)}
    for root in (tree, tree / "training", tree / "training" / "label_2"):
        found = read_truth(root, [FrameKey("", number) for number in places])
    for key, truth in found.items():
        drive = truth_of_frame(toy_frame(places[key.frame]), 1000)
        kept = np.isin(drive.boxes.object_id, [1001, 1002])  # KITTI has no buses, and the ego does not label itself
        np.testing.assert_allclose(truth.boxes.array, drive.boxes.array[kept], atol=2e-3)


def test_a_dair_tree_is_read_by_the_names_of_its_batches(tmp_path: Path) -> None:
    tree = make(tmp_path)
    drive = open_drive(tree / "12")
    key = FrameKey("12", drive.frames[0])
    calls: list[tuple[int, int]] = []
    truth = read_truth(tree, [key], lambda done, of: calls.append((done, of)))[key]
    assert len(truth.boxes) == 3 and calls == [(1, 1)]


def test_what_the_tree_lacks_is_one_line(tmp_path: Path) -> None:
    for name in ("one", "two"):
        write_frame(tmp_path / name, toy_frame(3))
    with pytest.raises(DataError, match=r"drive: expected one of one, two, found 'three'$"):
        read_truth(tmp_path, [FrameKey("three", 3)])
    with pytest.raises(DataError, match="drive: expected one of one, two, found detections without a drive"):
        read_truth(tmp_path, [FrameKey("", 3)])
    with pytest.raises(DataError, match="one: frame: expected one from 3 to 3, found detections of frame 4"):
        read_truth(tmp_path / "one", [FrameKey("", 4)])
    (tmp_path / "kitti" / "label_2").mkdir(parents=True)
    with pytest.raises(DataError, match=r"label_2/000004.txt: labels: .* found no labels of frame 4$"):
        read_truth(tmp_path / "kitti", [FrameKey("", 4)])
    with pytest.raises(DataError, match=r"label_2/000004.txt: labels: .* found detections of one 4$"):
        read_truth(tmp_path / "kitti", [FrameKey("one", 4)])
    (tmp_path / "clouds" / "velodyne").mkdir(parents=True)
    with pytest.raises(
        DataError, match="clouds: truth: expected a tree of OPV2V or DAIR-V2X-C, or KITTI's label_2, found"
    ):
        read_truth(tmp_path / "clouds", [FrameKey("", 4)])
    with pytest.raises(DataError, match="one: frame 3: ego: expected one of the agents"):
        read_truth(tmp_path / "one", [FrameKey("", 3, 77)])
    with pytest.raises(DataError, match="nowhere: no such folder"):
        read_truth(tmp_path / "nowhere", [FrameKey("", 4)])


def _in_opencoods_range(row: list[float]) -> bool:
    """Whether all 8 corners of a box are in the range, z included, corners by torch in float32.

    After the description of `mask_boxes_outside_range_numpy` and `boxes_to_corners_3d` in OpenCOOD's box_utils.py.
    """
    x, y, z, length, width, height, yaw = torch.tensor(row, dtype=torch.float32)
    signs = torch.tensor([[a, b, c] for a in (1.0, -1.0) for b in (1.0, -1.0) for c in (1.0, -1.0)]) / 2
    turn = torch.stack([yaw.cos(), yaw.sin(), -yaw.sin(), yaw.cos()]).reshape(2, 2)
    local = signs * torch.stack([length, width, height])
    corners = torch.cat([local[:, :2] @ turn, local[:, 2:]], dim=1) + torch.stack([x, y, z])
    low, high = torch.tensor([-140.0, -40.0, -3.0]), torch.tensor([140.0, 40.0, 1.0])
    return bool(((corners >= low) & (corners <= high)).all())


def test_a_box_at_the_border_counts_as_in_opencood_and_is_judged_by_the_digits_of_stored_ones(tmp_path: Path) -> None:
    """A truck of 2.9 m under a LiDAR at 1.9 m ends at z = 1.0, the border of OpenCOOD's range, by a rounding."""
    counted = []
    for off in (-1e-9, -1e-16, 0.0, 1e-16, 1e-9, 1e-7):
        row = [20.0, 0.1, -0.45 + off, 8.0, 2.5, 2.9, 0.3]
        boxes = Boxes.from_array([row])
        found = select(PROTOCOLS["opencood"], Detections.zeros(), replace(Truth.of(boxes), rounds=True)).truth
        assert len(found) == _in_opencoods_range(row)
        assert np.array_equal(found.array, boxes.array.astype(np.float32)[: len(found)])
        counted.append(len(found))
    assert counted == [1, 1, 1, 1, 1, 0]
    write_frame(tmp_path / "one", toy_frame(0))
    (truth,) = read_truth(tmp_path, [FrameKey("one", 0)]).values()
    assert np.array_equal(truth.boxes.array, truth_of_frame(open_drive(tmp_path / "one").read(0)).boxes.array)


def test_frames_that_nobody_labelled_are_left_out(tmp_path: Path) -> None:
    scans(tmp_path)
    labels = json.loads((tmp_path / "scans" / "boxes.json").read_text())
    (tmp_path / "scans" / "boxes.json").write_text(json.dumps({"frames": labels["frames"][:2]}))
    found = [
        {"drive": "scans", "frame": i, "boxes": labels["frames"][i]["boxes"][:1], "score": [0.9]} for i in range(3)
    ]
    (tmp_path / "found.json").write_text(json.dumps({"frames": found}))
    (result,) = score(tmp_path / "found.json", tmp_path / "scans", "testbed")
    assert (result.frames, result.truth, result.detections) == (2, 2, 2)
    assert result.ap["bev", 0.5] == 1.0
