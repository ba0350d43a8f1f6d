"""Pictures of a frame hold the boxes, points and features that they are of."""

import copy
import dataclasses
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from msgspec.structs import replace
from PIL import Image
from torch import Tensor

from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.data.sample import Sample
from dsrc.evaluation.config import Benchmark
from dsrc.evaluation.report.report import provenance_of
from dsrc.evaluation.runner import run_plan
from dsrc.models.detector import Detector
from dsrc.models.inputs.batch import collate
from dsrc.models.inputs.labels import cells_in_boxes
from dsrc.models.inputs.trained_frame import as_trained
from dsrc.models.storage.checkpoint import save_detector, with_fusion
from dsrc.ops.detections import Detections
from dsrc.ops.iou import bev_iou
from dsrc.tables.document import SectionWriter
from dsrc.tables.figure import png_bytes
from sensors.frame import Frame
from sim.boxes import Boxes
from sim.errors import UserError
from studies.dsrc_paper.drawing import AGENT, FOUND, HELPED, TRUTH, project
from studies.dsrc_paper.evidence import firing_channels, vehicle_evidence
from studies.dsrc_paper.frame_figures import detection_figure, feature_figure, match_counts
from studies.dsrc_paper.frames import DrawnFrame, frames_at, only_helpers_see, read_drawn_frames, spread_samples
from studies.dsrc_paper.pictures import check_pictures, write_pictures
from tests.dsrc.evaluation.small import POINTS, make_detector, make_plan, write_drives
from tests.dsrc.training.drive import frame

GRID = make_detector("dsrc").settings.grid


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Benchmark:
    root = tmp_path_factory.mktemp("pictures")
    write_drives(root / "test", frames=3)
    return make_plan(root, {"DSRC": [("dsrc", 0)], "plain": [("attfuse", 0)]})


@pytest.fixture(scope="module")
def drawn_frames(plan: Benchmark) -> list[DrawnFrame]:
    return read_drawn_frames(plan, GRID)


@pytest.fixture(scope="module")
def drawn_frame(drawn_frames: list[DrawnFrame]) -> DrawnFrame:
    return drawn_frames[1]


@pytest.fixture(scope="module")
def teacher(plan: Benchmark, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the file of a teacher that was trained on the ego alone."""
    return teacher_of("none", tmp_path_factory.mktemp("teacher"))


def teacher_of(fusion: str, folder: Path) -> str:
    settings = replace(make_detector("dsrc").settings, role="teacher", fusion=fusion, rec=False)
    save_detector(folder / f"{fusion}.pt", Detector(settings))
    return str(folder / f"{fusion}.pt")


def lines_of(axes: Axes, color: str) -> list[np.ndarray]:
    """Return the segments that are drawn in a colour."""
    found = [c for c in axes.collections if isinstance(c, LineCollection) and to_hex(c.get_color()[0]) == color.lower()]
    return [segment for collection in found for segment in collection.get_segments()]


def hidden_from_the_ego(whole: Frame, cars: int) -> Frame:
    """Return a frame whose ego has no points on some of the cars that it and helpers had points on."""
    ego, *helpers = whole.agents
    seen = np.flatnonzero((whole.points_on[0] > 0) & (whole.points_on[1:] > 0).any(axis=0))[:cars]
    assert len(seen) == cars
    sweep = ego.sweep[~np.isin(ego.sweep.object_id, whole.truth.object_id[seen])]
    counts = whole.points_on.copy()
    counts[0, seen] = 0
    return dataclasses.replace(whole, agents=(dataclasses.replace(ego, sweep=sweep), *helpers), points_on=counts)


def test_frames_stand_at_percentiles_of_what_only_helpers_see(tmp_path: Path) -> None:
    fewer = {"b": (2, 0), "a": (0, 1, 1)}  # cars of which the ego loses sight, frame by frame
    for name, cars in fewer.items():
        for index, count in enumerate(cars):
            write_frame(tmp_path / "test" / name, hidden_from_the_ego(frame(index, **POINTS), count))
    plan = make_plan(tmp_path, {"DSRC": [("dsrc", 0)]}, pictures=dict(percentiles=(0, 20, 40, 60, 80, 81, 100)))
    places = [(reader.drive.name, position) for _, reader, position in frames_at(plan, GRID)]
    # In order: none lost in the first of a and the second of b, one in two frames of a, two in the first of b.
    assert places == [("a", 0), ("a", 0), ("b", 1), ("a", 1), ("a", 2), ("b", 0), ("b", 0)]
    drawn_frames = read_drawn_frames(plan, GRID)
    helped = [int(only_helpers_see(one.sample).sum()) for one in drawn_frames]
    assert [count - helped[0] for count in helped] == [0, 0, 0, 1, 1, 2, 2]
    ego_ids = [set(one.sample.agent_boxes[0].object_id) for one in drawn_frames]
    for one, ids in zip(drawn_frames, ego_ids, strict=True):
        assert ids.isdisjoint(one.sample.boxes.object_id[only_helpers_see(one.sample)])


def test_frames_without_a_box_that_only_helpers_see_are_drawn_where_there_is_no_other(tmp_path: Path) -> None:
    for index in range(2):
        write_frame(tmp_path / "test" / "alone", frame(index, **POINTS).of_agents([0]))
    everywhere = make_plan(tmp_path, {"DSRC": [("dsrc", 0)]}, pictures=dict(percentiles=(0, 50, 100)))
    assert [position for _, _, position in frames_at(everywhere, GRID)] == [0, 0, 1]
    assert not any(only_helpers_see(one.sample).any() for one in read_drawn_frames(everywhere, GRID))
    write_frame(tmp_path / "test" / "together", frame(0, **POINTS))
    assert {reader.drive.name for _, reader, _ in frames_at(everywhere, GRID)} == {"together"}


def test_frames_are_of_those_that_the_tables_are_of_and_corrupted_as_asked(plan: Benchmark) -> None:
    (first, *_, last) = frames_at(replace(plan, frames=2, pictures=dict(percentiles=(1, 100))), GRID)
    assert {(reader.drive.name, position) for _, reader, position in (first, last)} == {("drive_0", 0), ("drive_1", 2)}
    clean, foggy = (
        read_drawn_frames(replace(plan, pictures=dict(corruption=kind)), GRID)[0] for kind in ("clean", "fog")
    )
    assert foggy.title == clean.title.replace("clean", "fog")
    assert foggy.sample.clouds[0].shape != clean.sample.clouds[0].shape
    np.testing.assert_array_equal(foggy.sample.boxes.array, clean.sample.boxes.array)
    np.testing.assert_array_equal(only_helpers_see(foggy.sample), only_helpers_see(clean.sample))


def test_pictures_that_cannot_be_drawn_are_reported_before_the_work(
    plan: Benchmark, teacher: str, tmp_path: Path
) -> None:
    check_pictures(replace(plan, pictures=dict(teacher=teacher)))
    student = plan.methods[0].detectors[0]
    for pictures, words in (
        (dict(teacher="none.pt"), "none.pt: no such"),
        (dict(teacher=student), "settings.role: expected teacher"),
        (
            dict(teacher=teacher_of("v2vnet", tmp_path)),
            "v2vnet.pt: detector: fusion: expected .* found 'attention'",
        ),
    ):
        with pytest.raises(UserError, match=words):
            check_pictures(replace(plan, pictures=pictures))


def test_what_lies_where_a_camera_looks_is_in_the_middle_and_higher_is_up() -> None:
    eye, aim = np.array([-10.0, 0.0, 5.0]), np.array([10.0, 0.0, 5.0])
    seen = project(np.array([[10.0, 0, 5], [10, 0, 7], [10, 2, 5], [-20, 0, 5]]), eye, aim)
    np.testing.assert_allclose(seen[0], [0, 0, 20], atol=1e-12)
    np.testing.assert_allclose(seen[1], [0, 0.1, 20], atol=1e-12)
    np.testing.assert_allclose(seen[2], [-0.1, 0, 20], atol=1e-12)  # y is to the left
    assert seen[3, 2] == -10.0  # behind


def test_every_box_is_drawn_in_both_views_of_every_method_and_frame(drawn_frames: list[DrawnFrame]) -> None:
    found = {
        name: [make_detector(name).detect(drawn_frame.sample) for drawn_frame in drawn_frames]
        for name in ("dsrc", "attfuse")
    }
    figure = detection_figure(drawn_frames, found, GRID)
    panels = np.array(figure.axes).reshape(2, 2, len(drawn_frames))
    x0, y0, _, x1, y1, _ = GRID.range_m
    for row, of_method in enumerate(found.values()):
        for column, (drawn_frame, detections) in enumerate(zip(drawn_frames, of_method, strict=True)):
            detections = detections[bev_iou(detections.boxes.array, drawn_frame.ego.array).max(axis=1) < 0.5]
            assert len(detections)
            scene, above = panels[row, :, column]
            helped = only_helpers_see(drawn_frame.sample)
            boxes = drawn_frame.sample.boxes
            for drawn, color in ((boxes[~helped], TRUTH), (boxes[helped], HELPED), (detections.boxes, FOUND)):
                assert len(lines_of(scene, color)) == 12 * len(drawn)
                outlines = lines_of(above, color)[: len(drawn)]
                np.testing.assert_allclose([line[0] for line in outlines], drawn.corners()[:, 0, :2])
            assert (above.get_xlim(), above.get_ylim()) == ((x0, x1), (y0, y1))
            low, high = np.array([scene.get_xlim(), scene.get_ylim()]).T
            seen = np.concatenate(lines_of(scene, TRUTH))
            assert (seen >= low).all() and (seen <= high).all()  # nothing is cut off
            assert match_counts(detections, boxes) in scene.get_title(loc="left")
    assert [panel.get_ylabel() for panel in panels[:, 0, 0]] == ["dsrc", "attfuse"]
    for drawn_frame, panel in zip(drawn_frames, panels[0, 0], strict=True):
        assert panel.get_title(loc="left").startswith(f"Percentile {drawn_frame.percentile}\n{drawn_frame.title}\n")
    assert len(png_bytes(figure, dpi=40)) > 5000


def test_a_detection_of_the_ego_itself_is_neither_a_hit_nor_false(drawn_frame: DrawnFrame) -> None:
    truth, ego = drawn_frame.sample.boxes, drawn_frame.ego
    assert len(ego) == 1 and len(truth) > 1
    np.testing.assert_allclose(ego.center[0, :2], [0, 0], atol=2.0)
    far = Boxes.from_array([[30, 20, -1, 4, 2, 1.5, 0]])
    boxes = Boxes.from_array(np.concatenate([truth.array[1:], ego.array, far.array]))
    found = Detections(boxes, np.linspace(0.9, 0.5, len(boxes), dtype=np.float32))
    figure = detection_figure([drawn_frame], {"some": [found]}, GRID)
    title = figure.axes[0].get_title(loc="left").splitlines()[-1]
    assert title == f"{len(truth) - 1} hit, 1 missed, 1 false, and the ego itself"
    for axes, edges in zip(figure.axes, (12, 2), strict=True):
        assert len(lines_of(axes, FOUND)) == edges * len(truth)
        assert len(lines_of(axes, AGENT)) == edges * 2  # its body, and the detection of it


def logits_of(detector: Detector, sample: Sample) -> np.ndarray:
    """Return the (2, h, w) logits of a student."""
    batch = collate([sample], detector.settings, training=False)
    with torch.inference_mode():
        return detector(batch.student, batch.layout).cls[0].numpy()


def with_head(detector: Detector, change: Callable[[Tensor], Tensor]) -> Detector:
    """Return a detector whose class head's weights are changed."""
    other = copy.deepcopy(detector)
    with torch.no_grad():
        other.cls_head.weight.copy_(change(other.cls_head.weight))
    return other


def test_evidence_is_what_speaks_for_a_vehicle_and_nothing_else(drawn_frame: DrawnFrame) -> None:
    detector = make_detector("dsrc")
    bias = detector.cls_head.bias.detach().numpy()[:, None, None]
    seen = vehicle_evidence(detector, drawn_frame.sample)
    assert seen.shape == (GRID.height // 2, GRID.width // 2) and seen.min() >= 0 and seen.max() > 0
    assert (seen >= (logits_of(detector, drawn_frame.sample) - bias).max(axis=0) - 1e-4).all()
    # Where nothing speaks against a vehicle, it is all of the logit but the bias, of the anchor with more of it.
    willing = with_head(detector, torch.abs)
    np.testing.assert_allclose(
        vehicle_evidence(willing, drawn_frame.sample),
        (logits_of(willing, drawn_frame.sample) - bias).max(axis=0),
        rtol=1e-3,
        atol=1e-3,
    )
    # However large the features are: a head that takes all of them for background has no evidence.
    assert not vehicle_evidence(with_head(detector, lambda weight: -weight.abs()), drawn_frame.sample).any()


def test_evidence_before_fusion_is_the_egos_own(drawn_frame: DrawnFrame) -> None:
    detector = make_detector("dsrc")
    alone = vehicle_evidence(detector, drawn_frame.sample, fused=False)
    np.testing.assert_allclose(
        alone, vehicle_evidence(with_fusion(detector, "none"), drawn_frame.sample), rtol=1e-4, atol=1e-5
    )
    assert not np.allclose(alone, vehicle_evidence(detector, drawn_frame.sample), rtol=0.01)


def test_evidence_of_a_network_of_the_mirror_image_lies_where_the_vehicles_are(drawn_frame: DrawnFrame) -> None:
    detector = make_detector("dsrc")
    left = copy.deepcopy(detector)
    left.settings = replace(detector.settings, left_handed=True)
    # Seen in a mirror, what the network finds is where it was, seen in a mirror.
    there = vehicle_evidence(left, as_trained(drawn_frame.sample, left.settings))
    np.testing.assert_allclose(there[::-1], vehicle_evidence(detector, drawn_frame.sample), atol=1e-4)


def test_a_teacher_of_all_agents_sees_what_the_ego_does_not(drawn_frame: DrawnFrame) -> None:
    settings = replace(make_detector("dsrc").settings, role="teacher", fusion="none", rec=False)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        teacher = Detector(settings).eval()
    without = dataclasses.replace(
        drawn_frame.sample,
        **{name: getattr(drawn_frame.sample, name)[:1] for name in ("clouds", "agent_boxes", "agent_ids")},
    )
    np.testing.assert_array_equal(
        vehicle_evidence(teacher, without) > 0, vehicle_evidence(with_fusion(teacher, "attention"), without) > 0
    )
    assert not np.allclose(
        vehicle_evidence(with_fusion(teacher, "attention"), without),
        vehicle_evidence(with_fusion(teacher, "attention"), drawn_frame.sample),
    )


def test_channels_that_never_fire_are_counted_over_all_frames(drawn_frames: list[DrawnFrame]) -> None:
    detector = copy.deepcopy(make_detector("dsrc"))
    samples = [drawn_frame.sample for drawn_frame in drawn_frames]
    last = [layer for layer in detector.shrink if getattr(layer, "bias", None) is not None][-1]
    each = [firing_channels(detector, [sample]) for sample in samples]
    np.testing.assert_array_equal(firing_channels(detector, samples), np.logical_or.reduce(each))
    with torch.no_grad():
        last.weight[3:5], last.bias[3:5] = 0.0, torch.tensor([-1.0, 1.0])
    fired = firing_channels(detector, samples)
    assert not fired[3] and fired[4]


def test_all_maps_have_one_scale_and_one_colour_bar(drawn_frames: list[DrawnFrame]) -> None:
    student = make_detector("dsrc")
    maps = {
        "student": partial(vehicle_evidence, student),
        "twice": lambda sample: 2 * vehicle_evidence(student, sample),
    }
    figure = feature_figure(drawn_frames, maps, GRID)
    panels = np.array(figure.axes[: 3 * len(drawn_frames)]).reshape(3, len(drawn_frames))
    (bar,) = figure.axes[3 * len(drawn_frames) :]
    assert "logits" in bar.get_ylabel() and "99th percentile of the cells in true boxes" in bar.get_ylabel()
    values = [[seen(drawn_frame.sample) for drawn_frame in drawn_frames] for seen in maps.values()]
    within = []
    for of_network in values:
        for drawn_frame, seen in zip(drawn_frames, of_network, strict=True):
            (inside,) = cells_in_boxes([drawn_frame.sample.boxes], GRID)
            smaller = len(inside) // len(seen)
            places = {(int(row) // smaller, int(column) // smaller) for row, column in np.argwhere(inside)}
            within += [seen[place] for place in places]
    for row, of_network in enumerate(values):
        for drawn_frame, panel, seen in zip(drawn_frames, panels[1 + row], of_network, strict=True):
            (image,) = panel.get_images()
            np.testing.assert_allclose(image.get_array(), seen)
            assert image.get_clim() == pytest.approx((0.0, np.quantile(within, 0.99)))
            # Columns go along x: the picture has the grid's extent with its first row at the bottom.
            assert tuple(image.get_extent()) == (GRID.range_m[0], GRID.range_m[3], GRID.range_m[1], GRID.range_m[4])
            assert image.origin == "lower"
            helped = only_helpers_see(drawn_frame.sample)
            assert len(lines_of(panel, TRUTH)) == 2 * (~helped).sum()
            assert len(lines_of(panel, HELPED)) == 2 * helped.sum()
    assert [panel.get_ylabel() for panel in panels[:, 0]] == ["LiDAR points of\nall agents", "student", "twice"]


@pytest.mark.slow
def test_figures_6_and_8_are_written_with_what_made_them(plan: Benchmark, teacher: str, tmp_path: Path) -> None:
    drawn = replace(plan, corruption=("clean",), frames=2, pictures=dict(teacher=teacher, percentiles=(50,)))
    result = run_plan(drawn, tmp_path)
    writer = SectionWriter(tmp_path, provenance_of(result))
    write_pictures(result, writer)
    figure_6, channels, figure_8 = writer.sections
    assert [block.name for block in writer.sections] == ["figure_6", "channels", "figure_8"]
    for block in (figure_6, figure_8):
        with Image.open(tmp_path / block.picture) as image:
            assert json.loads(image.text["Description"])["settings"]["datasets"] == result.drives
        assert "evaluated frames with true boxes that only helpers have points on" in block.text
        assert read_drawn_frames(drawn, GRID)[0].title in block.text
    assert "trained with the fusion 'none'" in figure_6.text
    width = make_detector("dsrc").cls_head.in_channels
    for name, method in (("baseline: plain", "attfuse"), ("student: DSRC", "dsrc")):
        count = (~firing_channels(make_detector(method), spread_samples(drawn, GRID))).sum()
        assert f"| {name} | {width} | {count} |" in channels.text
    assert "| teacher |" in channels.text
    assert all((tmp_path / table).is_file() for table in channels.tables)
    alone = make_plan(Path(plan.datasets[0].drives[0]).parent, {"late": [("late", 0)]}, corruption=("clean",), frames=1)
    writer = SectionWriter(tmp_path / "alone", {})
    write_pictures(run_plan(alone, tmp_path / "alone"), writer)
    assert writer.sections[0].text == "Figure 6 is left out: it needs a plain method with attention (attfuse).\n"
