from pathlib import Path

import numpy as np
import pytest

from dsrc.data.drives import list_drives
from dsrc.data.formats.opv2v.reader import DriveReader
from dsrc.data.sample import Sample, SampleRequest, make_sample
from dsrc.models.inputs.teacher import teacher_clouds
from dsrc.ops.grid import GridSpec
from sim.boxes import Boxes
from tests.dsrc.data import goldens
from tests.dsrc.data.toy import toy_frame


@pytest.fixture
def golden_sample() -> Sample:
    golden = goldens.load("teacher_cloud")
    boxes = [golden[f"boxes/{i}"].reshape(-1, 7)[:, [0, 1, 2, 5, 4, 3, 6]] for i in range(3)]
    clouds = tuple(golden[f"points/{i}"] for i in range(3))
    own = tuple(Boxes.from_array(b) for b in boxes)
    return Sample("golden", (0, 1, 2), clouds, np.stack([np.eye(4)] * 3), own[0], own)


@pytest.fixture
def sample() -> Sample:
    return make_sample(toy_frame(0), None, GridSpec())


def test_hull_clouds_equal_the_references_row_by_row(golden_sample: Sample) -> None:
    golden, made = goldens.load("teacher_cloud"), teacher_clouds(golden_sample, "hull")
    assert np.array_equal(made.merged, golden["merged"])
    for i in range(2):
        assert np.array_equal(made.clouds[i], golden[f"teacher/{i}"])
        assert np.array_equal(made.object_clouds[i][:, :4], golden[f"inside/{i}"])
    whole = np.concatenate([golden["points/2"], np.zeros((len(golden["points/2"]), 1), np.float32)], axis=1)
    assert np.array_equal(made.clouds[2], whole) and np.array_equal(made.object_clouds[2], whole)


def test_the_golden_trees_teacher_clouds_have_the_references_sizes(tmp_path: Path) -> None:
    expected, k = goldens.load("opv2v_mini_expected"), 0
    for drive in list_drives(goldens.unpack_opv2v_mini(tmp_path)):
        reader = DriveReader(drive)
        for i in range(len(reader)):
            made = teacher_clouds(
                make_sample(reader.read(i), None, SampleRequest(GridSpec(), keep_ego_box=True)), "hull"
            )
            sizes = [len(c) for c in (*made.clouds, *made.object_clouds)]
            assert sizes == expected[f"train/{k}/n_points_paint"].tolist()
            k += 1


def test_an_agent_without_objects_has_an_empty_object_cloud(golden_sample: Sample) -> None:
    made = teacher_clouds(golden_sample, "rotated")
    assert made.object_clouds[2].shape == (0, 5)
    assert np.array_equal(made.clouds[2][:, :4], golden_sample.clouds[2]) and not made.clouds[2][:, 4].any()


def test_rotated_clouds_hold_exactly_the_points_in_boxes(sample: Sample) -> None:
    made = teacher_clouds(sample)
    for cloud, objects, boxes, own in zip(
        made.clouds, made.object_clouds, sample.agent_boxes, sample.clouds, strict=True
    ):
        inside = boxes.contains(made.merged[:, :3]).any(axis=0)
        assert np.array_equal(objects[:, :4], made.merged[inside]) and (objects[:, 4] == 1).all()
        outside = ~boxes.contains(own[:, :3]).any(axis=0)
        assert np.array_equal(cloud[len(objects) :, :4], own[outside]) and not cloud[len(objects) :, 4].any()


def test_a_hull_paints_at_least_what_the_box_paints(sample: Sample) -> None:
    boxes, hulls = teacher_clouds(sample), teacher_clouds(sample, "hull")
    assert all(len(b) <= len(h) for b, h in zip(boxes.object_clouds, hulls.object_clouds, strict=True))
    assert sum(map(len, boxes.object_clouds)) < sum(map(len, hulls.object_clouds))


def test_the_two_ideas_can_be_switched_off(sample: Sample) -> None:
    full = teacher_clouds(sample)
    sparse = teacher_clouds(sample, dense=False)
    plain = teacher_clouds(sample, paint=False)
    for i, own in enumerate(sample.clouds):
        assert len(sparse.clouds[i]) == len(own)
        assert {tuple(p) for p in sparse.clouds[i][:, :4]} == {tuple(p) for p in own}
        assert np.array_equal(plain.clouds[i][:, :4], full.clouds[i][:, :4]) and not plain.clouds[i][:, 4].any()


def test_teacher_clouds_of_nothing_are_empty() -> None:
    nothing = Sample("", (1,), (np.zeros((0, 4), np.float32),), np.eye(4)[None], Boxes.zeros(), (Boxes.zeros(),))
    for inside in ("rotated", "hull"):
        made = teacher_clouds(nothing, inside)
        assert made.clouds[0].shape == (0, 5) and made.merged.shape == (0, 4)
