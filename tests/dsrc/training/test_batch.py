"""Batches: pillars, foreground, scene and targets of a sample."""

import dataclasses

import numpy as np
import pytest
import torch
from msgspec.structs import replace

from dsrc.data.sample import Sample, make_sample
from dsrc.models.inputs.batch import collate, scene_of
from dsrc.models.settings import ModelSettings
from dsrc.ops.anchors import ANCHORS
from dsrc.ops.grid import GridSpec
from dsrc.training.recipes import debug
from sim.boxes import CLASSES, Boxes
from tests.dsrc.training.drive import frame


@pytest.fixture(scope="module")
def samples() -> list[Sample]:
    return [make_sample(frame(i), ego, debug().model.grid) for i, ego in ((0, 1000), (1, 1001))]


def test_a_batch_for_detection_holds_what_the_sensors_saw_and_nothing_else(samples: list[Sample]) -> None:
    batch = collate(samples, debug().model, training=False)
    assert batch.agents == (3, 3)
    assert batch.student.clouds == 6
    assert batch.targets is batch.teacher is batch.foreground is batch.scene is None


def test_pillars_hold_the_points_of_their_cell(samples: list[Sample]) -> None:
    settings = debug().model
    pillars = collate(samples, settings, training=False).student
    assert (np.diff(pillars.pillar.numpy()) >= 0).all()
    np.testing.assert_array_equal(np.bincount(pillars.pillar), pillars.count)
    column = np.floor((pillars.points[:, 0].numpy() - settings.grid.range_m[0]) / 0.4)
    row = np.floor((pillars.points[:, 1].numpy() - settings.grid.range_m[1]) / 0.4)
    coords = pillars.coords[pillars.pillar].numpy()
    assert (np.abs(coords[:, 2] - column) <= 1).all()
    assert (coords[:, 2] == column).mean() > 0.999
    assert (coords[:, 1] == row).mean() > 0.999


@pytest.mark.parametrize(("sdd", "pcp"), [(True, True), (True, False), (False, True)])
def test_the_teacher_sees_denser_or_painted_objects_as_the_switches_say(
    samples: list[Sample], sdd: bool, pcp: bool
) -> None:
    settings = replace(debug().model, sdd=sdd, pcp=pcp, max_points=1000)
    batch = collate(samples, settings, training=True)
    assert batch.teacher.points.shape[1] == (5 if pcp else 4)
    assert (len(batch.teacher.points) > len(batch.student.points)) == sdd
    assert batch.foreground.any()
    if pcp:
        painted = batch.teacher.points[:, 4] == 1
        assert 0 < painted.float().mean() < 1


def test_without_the_designs_a_batch_has_no_teacher_and_no_scene(samples: list[Sample]) -> None:
    batch = collate(samples, replace(debug().model, sdd=False, pcp=False, rec=False), training=True)
    assert batch.teacher is batch.foreground is batch.scene is None
    assert batch.targets.positive.any()


@pytest.mark.parametrize("name", ["pedestrian", "bicycle", "motorcycle"])
def test_the_anchors_of_a_road_user_are_those_of_its_class(name: str) -> None:
    """An overlap with the other anchor, large as it may be, teaches that one nothing."""
    grid = GridSpec(range_m=(-12.8, -12.8, -3.0, 12.8, 12.8, 1.0), cell_m=0.2)
    settings = replace(debug().model, grid=grid, users="vulnerable", sdd=False, pcp=False, rec=False)
    places = np.random.default_rng(0).uniform(-10, 10, (20, 2))
    rows = [(x, y, -1.0, 0.9, 0.9, 1.7, 0.0) for x, y in places]
    sample = make_sample(frame(0), 1000, grid)
    sample = dataclasses.replace(sample, boxes=Boxes.from_array(rows, np.full(20, CLASSES.index(name))))
    found = collate([sample], settings, training=True).targets.positive.numpy()
    called = {CLASSES[ANCHORS["vulnerable"].label[anchor]] for anchor in np.nonzero(found)[-1]}
    assert called == {"pedestrian" if name == "pedestrian" else "bicycle"}


@pytest.mark.parametrize(("fusion", "agents"), [("attention", (3, 3)), ("none", (1, 1)), ("late", (1,) * 6)])
def test_the_fusion_decides_who_stands_in_a_row_of_the_batch(
    samples: list[Sample], fusion: str, agents: tuple[int, ...]
) -> None:
    batch = collate(samples, replace(debug().model, fusion=fusion), training=True)
    assert batch.agents == agents
    assert len(batch.targets.positive) == len(agents)


def test_voxel_centre_plus_offset_is_the_mean_of_the_points_in_the_voxel() -> None:
    settings = ModelSettings(grid=debug().model.grid)
    low = np.array(settings.grid.range_m[:3])
    cell = np.array([10, 20, 3])
    inside = low + (cell + np.array([[0.1, 0.2, 0.3], [0.5, 0.6, 0.9]])) * 0.4
    cloud = np.concatenate([inside, np.zeros((2, 1))], axis=1).astype(np.float32)
    scene = scene_of([np.zeros((0, 4), np.float32), cloud], settings)
    np.testing.assert_array_equal(scene.voxel, [[1, 3, 20, 10]])
    np.testing.assert_allclose(
        low + (cell + 0.5) * 0.4 + scene.offset.numpy(), inside.mean(0, keepdims=True), atol=1e-5
    )
    assert scene.samples == 2


@pytest.mark.parametrize("fusion", ["none", "late"])
def test_the_teacher_of_a_lone_student_has_the_points_of_all_agents_on_its_objects(
    samples: list[Sample], fusion: str
) -> None:
    lone = replace(debug().model, fusion=fusion, max_points=1000)
    dense, sparse = (collate(samples, replace(lone, sdd=sdd), training=True) for sdd in (True, False))
    assert len(dense.teacher.points) > len(sparse.teacher.points) == len(sparse.student.points)
    torch.testing.assert_close(dense.student.points, sparse.student.points)
