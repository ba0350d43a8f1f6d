"""Pictures of a frame hold the boxes, points and features that they are of."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from msgspec.structs import replace
from PIL import Image

from dsrc.__main__ import main
from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.evaluation.config import Pictures
from dsrc.evaluation.plots.pictures import (
    AGENT,
    FOUND,
    TRUTH,
    check_pictures,
    detection_figure,
    feature_figure,
    feature_map,
    frames_at,
    only_helpers_see,
    project,
    take_shots,
    write_pictures,
)
from dsrc.evaluation.plots.plots import png_bytes
from dsrc.evaluation.runner import run_plan
from dsrc.models.detector import Detector
from dsrc.ops.detections import Detections
from sim.boxes import Boxes
from sim.errors import UserError
from tests.dsrc.evaluation.small import POINTS, make_detector, make_plan, write_drives
from tests.dsrc.training.drive import frame

GRID = make_detector("dsrc").settings.grid


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    root = tmp_path_factory.mktemp("pictures")
    write_drives(root / "test", frames=3)
    return make_plan(root, {"DSRC": [("dsrc", 0)], "plain": [("attfuse", 0)]})


@pytest.fixture(scope="module")
def shot(plan):
    return take_shots(plan, GRID)[1]


def lines_of(axes, color):
    """Return the segments that are drawn in a colour."""
    found = [c for c in axes.collections if isinstance(c, LineCollection) and to_hex(c.get_color()[0]) == color.lower()]
    return [segment for collection in found for segment in collection.get_segments()]


def hidden_from_the_ego(whole, cars):
    """Return a frame whose ego has no points on some of the cars that it and helpers had points on."""
    ego, *helpers = whole.agents
    seen = np.flatnonzero((whole.points_on[0] > 0) & (whole.points_on[1:] > 0).any(axis=0))[:cars]
    assert len(seen) == cars
    sweep = ego.sweep[~np.isin(ego.sweep.object_id, whole.truth.object_id[seen])]
    counts = whole.points_on.copy()
    counts[0, seen] = 0
    return dataclasses.replace(whole, agents=(dataclasses.replace(ego, sweep=sweep), *helpers), points_on=counts)


def test_frames_stand_at_percentiles_of_what_only_helpers_see(tmp_path):
    fewer = {"b": (2, 0), "a": (0, 1, 1)}  # cars of which the ego loses sight, frame by frame
    for name, cars in fewer.items():
        for index, count in enumerate(cars):
            write_frame(tmp_path / "test" / name, hidden_from_the_ego(frame(index, **POINTS), count))
    plan = make_plan(tmp_path, {"DSRC": [("dsrc", 0)]}, pictures=Pictures(percentiles=(0, 20, 40, 60, 80, 81, 100)))
    places = [(reader.drive.name, position) for _, reader, position in frames_at(plan, GRID)]
    # In order: none in the first of a and the second of b, one in two frames of a, two in the first of b.
    assert places == [("a", 0), ("a", 0), ("b", 1), ("a", 1), ("a", 2), ("b", 0), ("b", 0)]
    shots = take_shots(plan, GRID)
    helped = [int(only_helpers_see(one.sample).sum()) for one in shots]
    assert [count - helped[0] for count in helped] == [0, 0, 0, 1, 1, 2, 2]
    ego_ids = [set(one.sample.agent_boxes[0].object_id) for one in shots]
    for one, ids in zip(shots, ego_ids, strict=True):
        assert ids.isdisjoint(one.sample.boxes.object_id[only_helpers_see(one.sample)])


def test_frames_are_of_those_that_the_tables_are_of_and_corrupted_as_asked(plan):
    (first, *_, last) = frames_at(replace(plan, limit=2, pictures=Pictures(percentiles=(1, 100))), GRID)
    assert {(reader.drive.name, position) for _, reader, position in (first, last)} == {("drive_0", 0), ("drive_1", 2)}
    clean, foggy = (take_shots(replace(plan, pictures=Pictures(corruption=kind)), GRID)[0] for kind in ("clean", "fog"))
    assert foggy.title == clean.title.replace("clean", "fog")
    assert foggy.sample.clouds[0].shape != clean.sample.clouds[0].shape
    np.testing.assert_array_equal(foggy.sample.boxes.array, clean.sample.boxes.array)
    np.testing.assert_array_equal(only_helpers_see(foggy.sample), only_helpers_see(clean.sample))


def test_what_cannot_be_drawn_is_told_before_the_work(plan, tmp_path):
    check_pictures(plan)
    student = plan.methods[0].detectors[0]
    for pictures, words in (
        (Pictures(teacher="none.pt"), "none.pt: no such"),
        (Pictures(teacher=student), "settings.role: expected teacher"),
    ):
        with pytest.raises(UserError, match=words):
            check_pictures(replace(plan, pictures=pictures))
    (tmp_path / "b.toml").write_text(
        f'[[methods]]\nname = "a"\ndetectors = ["{student}"]\n[[datasets]]\nname = "d"\n'
        f'drives = ["{plan.datasets[0].drives[0]}"]\n[pictures]\nteacher = "none.pt"\n'
    )
    with pytest.raises(SystemExit, match="2"):
        main(["benchmark", str(tmp_path / "b.toml"), "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()


def test_what_lies_where_a_camera_looks_is_in_the_middle_and_higher_is_up():
    eye, aim = np.array([-10.0, 0.0, 5.0]), np.array([10.0, 0.0, 5.0])
    seen = project(np.array([[10.0, 0, 5], [10, 0, 7], [10, 2, 5], [-20, 0, 5]]), eye, aim)
    np.testing.assert_allclose(seen[0], [0, 0, 20], atol=1e-12)
    np.testing.assert_allclose(seen[1], [0, 0.1, 20], atol=1e-12)
    np.testing.assert_allclose(seen[2], [-0.1, 0, 20], atol=1e-12)  # y is to the left
    assert seen[3, 2] == -10.0  # behind


def test_every_box_is_drawn_in_both_views_of_every_method(shot):
    found = {name: make_detector(name).detect(shot.sample) for name in ("dsrc", "attfuse")}
    assert all(len(detections) for detections in found.values())
    figure = detection_figure(shot, found, make_detector("dsrc").settings.grid)
    assert len(figure.axes) == 4
    for column, detections in enumerate(found.values()):
        scene, above = figure.axes[2 * column], figure.axes[2 * column + 1]
        for boxes, color in ((shot.sample.boxes, TRUTH), (detections.boxes, FOUND)):
            assert len(lines_of(scene, color)) == 12 * len(boxes)
            outlines = lines_of(above, color)[: len(boxes)]
            np.testing.assert_allclose([outline[0] for outline in outlines], boxes.corners()[:, 0, :2])
        x0, y0, _, x1, y1, _ = make_detector("dsrc").settings.grid.range_m
        assert (above.get_xlim(), above.get_ylim()) == ((x0, x1), (y0, y1))
        low, high = np.array([scene.get_xlim(), scene.get_ylim()]).T
        seen = np.concatenate(lines_of(scene, TRUTH))
        assert (seen >= low).all() and (seen <= high).all()  # nothing is cut off
    assert len(png_bytes(figure, dpi=40)) > 5000


def test_a_detection_of_the_ego_itself_is_neither_a_hit_nor_false(shot):
    truth, ego = shot.sample.boxes, shot.ego
    assert len(ego) == 1 and len(truth) > 1
    np.testing.assert_allclose(ego.center[0, :2], [0, 0], atol=2.0)
    far = Boxes.from_array([[30, 20, -1, 4, 2, 1.5, 0]])
    boxes = Boxes.from_array(np.concatenate([truth.array[1:], ego.array, far.array]))
    found = Detections(boxes, np.linspace(0.9, 0.5, len(boxes), dtype=np.float32))
    figure = detection_figure(shot, {"some": found}, make_detector("dsrc").settings.grid)
    title = figure.axes[0].get_title(loc="left")
    assert title == f"some: {len(truth) - 1} hit, 1 missed, 1 false, and the ego itself"
    for axes, edges in zip(figure.axes, (12, 2), strict=True):
        assert len(lines_of(axes, FOUND)) == edges * len(truth)
        assert len(lines_of(axes, AGENT)) == edges * 2  # its body, and the detection of it


def test_feature_maps_are_of_the_grid_and_of_what_each_network_reads(shot):
    student = make_detector("dsrc")
    grid = student.settings.grid
    teacher = Detector(replace(student.settings, role="teacher", rec=False)).eval()
    values = feature_map(student, shot.sample)
    assert values.shape == (grid.height // 2, grid.width // 2) and values.max() > 0
    figure = feature_figure(shot, {"student": student, "teacher": teacher})
    titles = [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]
    assert titles == ["LiDAR points of all agents", "student", "teacher"]
    assert [axes.get_ylabel() for axes in figure.axes].count("mean |feature|") == 2  # colour bars
    for axes, detector in zip(figure.axes[1:3], (student, teacher), strict=True):
        (image,) = axes.get_images()
        np.testing.assert_allclose(image.get_array(), feature_map(detector, shot.sample))
        # Columns go along x: the picture has the grid's extent with its first row at the bottom.
        assert tuple(image.get_extent()) == (grid.range_m[0], grid.range_m[3], grid.range_m[1], grid.range_m[4])
        assert image.origin == "lower"
        assert len(lines_of(axes, TRUTH)) == 2 * len(shot.sample.boxes)


def test_figures_6_and_8_are_written_with_what_made_them(plan, tmp_path):
    outcome = run_plan(replace(plan, corruptions=("clean",), limit=1), tmp_path)
    blocks = write_pictures(outcome, tmp_path)
    assert [block.name for block in blocks] == ["made-up/figure_6", "made-up/figure_8"]
    for block in blocks:
        with Image.open(tmp_path / block.picture) as image:
            assert json.loads(image.text["Description"])["settings"]["datasets"] == outcome.drives
    alone = make_plan(Path(plan.datasets[0].drives[0]).parent, {"late": [("late", 0)]}, corruptions=("clean",), limit=1)
    text = write_pictures(run_plan(alone, tmp_path / "alone"), tmp_path / "alone")[0].text
    assert text == "Figure 6 is left out: it needs a plain method with attention (attfuse).\n"
