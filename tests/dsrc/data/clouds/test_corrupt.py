"""Corrupted arrays: those of drives, bit for bit, with all that a corruption leaves as it is."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

import dsrc
from dsrc.data.clouds.cloud import Cloud, beams_of, columns_of, rows_of
from sensors.corruptions import CORRUPTIONS, PRESETS, corrupt_frame
from sensors.corruptions.check import example_frame
from sensors.frame import AgentFrame, Frame
from sensors.presets import get_lidar
from sensors.sweep import ADDED, make_sweep
from sim.boxes import Boxes
from sim.errors import DataError, SettingsError, notice

ALONE = [kind for kind in CORRUPTIONS if not CORRUPTIONS[kind].spares_ego]
BOXES = np.array([[14.0, 0.0, -1.1, 4.5, 1.8, 1.5, 0.0, 12.0, 0.0], [9.0, 3.5, -1.1, 4.5, 1.8, 1.5, 0.0, 10.0, 0.0]])


def street() -> NDArray[np.float32]:
    """A cloud of 32 rings as KITTI stores one, (P, 4)."""
    sweep = example_frame().agents[0].sweep
    return np.column_stack([sweep.points, sweep.intensity])


def frame_of(cloud: NDArray[np.float32], boxes: NDArray[np.float64], index: int = 0) -> Frame:
    """The frame of a drive that holds a cloud and nothing more, as another tool's file would give it."""
    sweep = make_sweep(cloud[:, :3], intensity=cloud[:, 3])
    agent = AgentFrame(0, "vehicle", np.eye(4), 10.0, sweep)
    truth = Boxes.from_array(boxes[:, :7], object_id=np.arange(len(boxes)))
    return Frame(index, 0.1 * index, (agent,), truth, boxes[:, 7:], np.zeros((1, len(boxes)), np.int32))


@pytest.mark.parametrize("family", ["physical", "paper"])
@pytest.mark.parametrize("kind", ALONE)
def test_an_array_is_corrupted_as_a_frame_of_a_drive_with_the_same_cloud(kind: str, family: str) -> None:
    if family == "paper" and CORRUPTIONS[kind].paper_apply is None:
        pytest.skip("without a published model")
    cloud = street()
    before = cloud.copy()
    out = dsrc.corrupt(cloud, kind, severity=4, seed=7, boxes=BOXES, family=family, index=3)
    after = corrupt_frame(frame_of(cloud, BOXES, 3), kind, 4, 7, family).agents[0].sweep
    assert np.array_equal(out, np.column_stack([after.points, after.intensity]))
    assert out.dtype == np.float32
    assert np.array_equal(cloud, before)
    assert not np.array_equal(out, cloud)


def test_a_sweep_keeps_its_columns() -> None:
    sweep = example_frame().agents[0].sweep
    out = dsrc.corrupt(sweep, "fog", severity=3, seed=1)
    assert out.spec == sweep.spec
    assert out.lost > 0
    assert len(dsrc.corrupt(sweep, "incomplete_echo", severity=3)) < len(sweep)


@pytest.mark.parametrize("kind", ["fog", "snow", "crosstalk", "beam_missing", "noise"])
def test_further_columns_stay_with_their_points_and_are_zero_in_added_ones(kind: str) -> None:
    cloud = street()
    rows = np.column_stack([cloud, np.arange(len(cloud)) + 1.0]).astype(np.float64)
    out = dsrc.corrupt(rows, kind, severity=4, boxes=BOXES)
    assert out.dtype == np.float64
    row = out[:, 4].astype(int) - 1
    kept = row >= 0
    assert len(np.unique(row[kept])) == kept.sum() > 0
    near = np.linalg.norm(np.cross(rows[row[kept], :3], out[kept, :3]), axis=1)
    assert kind == "noise" or near.max() < 0.5  # along the ray, or where it was
    plain = dsrc.corrupt(cloud, kind, severity=4, boxes=BOXES)
    assert np.array_equal(plain, out[:, :4].astype(np.float32))


def test_coordinates_of_points_that_stay_keep_all_their_bits() -> None:
    rows = street().astype(np.float64) + 1e-10
    out = dsrc.corrupt(rows, "beam_missing", severity=5)
    assert 0 < len(out) < len(rows)
    assert {row.tobytes() for row in out} <= {row.tobytes() for row in rows}


def test_intensities_of_eight_bits_come_back_as_such() -> None:
    cloud = street()
    eight = cloud.copy()
    eight[:, 3] = np.rint(255.0 * cloud[:, 3])
    out = dsrc.corrupt(eight, "fog", severity=2)
    unit = dsrc.corrupt(np.column_stack([eight[:, :3], eight[:, 3] / np.float32(255.0)]), "fog", severity=2)
    assert out[:, :3] == pytest.approx(unit[:, :3])
    assert out[:, 3] == pytest.approx(255.0 * unit[:, 3], abs=1e-3)
    assert out[:, 3].max() > 1.0


def test_a_cloud_without_intensity_stays_one() -> None:
    out = dsrc.corrupt(street()[:, :3], "fog", severity=5)
    assert out.shape[1] == 3
    assert 0 < len(out) < len(street())


@pytest.mark.parametrize("bottom", [False, True])
def test_rings_of_a_column_count_from_the_top_or_from_the_bottom(bottom: bool) -> None:
    sweep = example_frame().agents[0].sweep
    ring = 31 - sweep.ring if bottom else sweep.ring
    rows = np.column_stack([sweep.points, sweep.intensity, ring]).astype(np.float32)
    out = dsrc.corrupt(rows, "beam_missing", severity=4, ring=4)
    own = corrupt_frame(example_frame(0).of_agents([0]), "beam_missing", 4, 0).agents[0]
    gone = set(np.unique(sweep.ring)) - {int(31 - r if bottom else r) for r in np.unique(out[:, 4])}
    assert len(gone) == 16
    assert own.agent_id != 0  # another agent has other dead beams


def test_added_points_have_the_ring_of_their_beam() -> None:
    spec = get_lidar("hdl-32e")
    sweep = example_frame().agents[0].sweep
    elevation = np.arctan2(sweep.points[:, 2], np.hypot(*sweep.points[:, :2].T))
    nearest = np.abs(elevation[:, None] - spec.elevation).argmin(axis=1)
    rows = np.column_stack([sweep.points, sweep.intensity, 31 - nearest]).astype(np.float32)
    out = dsrc.corrupt(rows, "crosstalk", severity=5, ring=4, sensor="hdl-32e")
    new = out[~(out[:, None, :3] == rows[None, ::1, :3]).all(axis=2).any(axis=1)]
    assert len(new) > 50
    angle = np.arctan2(new[:, 2], np.hypot(new[:, 0], new[:, 1]))
    assert np.abs(angle - spec.elevation[31 - new[:, 4].astype(int)]).max() < np.radians(1.0)


def test_a_named_sensor_gives_points_their_beams_and_columns() -> None:
    sweep = example_frame().agents[0].sweep
    spec = sweep.spec
    assert spec is not None
    assert np.array_equal(beams_of(sweep.points, spec), sweep.ring)
    assert np.array_equal(columns_of(sweep.points, sweep.ring, spec), sweep.column)
    assert np.array_equal(beams_of(sweep.points[:3], spec), sweep.ring[:3])
    turned = replace_spec(spec)
    ring, column = np.divmod(np.arange(turned.rings * turned.columns), turned.columns)
    azimuth, elevation = turned.azimuth[column] + turned.azimuth_offset[ring], turned.elevation[ring]
    across = np.cos(elevation)
    rays = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)], axis=1)
    assert np.array_equal(columns_of(rays, ring, turned), column)


def replace_spec(spec: dsrc.LidarSpec) -> dsrc.LidarSpec:
    """A clockwise sensor of 100 degrees with beams that differ in azimuth."""
    import msgspec

    return msgspec.structs.replace(
        spec,
        clockwise=True,
        azimuth_start_deg=-30.0,
        azimuth_end_deg=70.0,
        azimuth_offset_deg=tuple(np.linspace(-3.0, 3.0, spec.rings)),
    )


def test_labels_of_points_do_what_boxes_do() -> None:
    cloud = street()
    by_boxes = dsrc.corrupt(cloud, "incomplete_echo", boxes=BOXES)
    margin = Boxes.from_array(BOXES[:, :7]).contains(cloud[:, :3].astype(np.float64), 0.1).any(axis=0)
    assert margin.sum() > 20
    by_labels = dsrc.corrupt(cloud, "incomplete_echo", on_vehicle=margin)
    assert np.array_equal(by_boxes, by_labels)


@pytest.mark.parametrize("nobody", [{"on_vehicle": np.zeros(len(street()), bool)}, {"boxes": np.zeros((0, 9))}])
@pytest.mark.parametrize("kind", ["incomplete_echo", "spray"])
def test_a_labelled_cloud_without_vehicles_stays_as_it_is(
    kind: str, nobody: dict, caplog: pytest.LogCaptureFixture
) -> None:
    notice.cache_clear()
    assert np.array_equal(dsrc.corrupt(street(), kind, **nobody), street())
    assert not caplog.messages  # an unlabelled one is told


def test_rows_of_a_table_are_found_again() -> None:
    cloud = street()
    table = Cloud(cloud.view([(name, "f4") for name in "xyzi"])[:, 0], intensity="i")
    sweep = table.sweep()
    assert np.array_equal(rows_of(sweep[::-3]), np.arange(len(cloud))[::-3])
    assert (rows_of(replace(sweep, object_id=np.full(len(cloud), ADDED, np.int32))) == -1).all()
    assert np.array_equal(table.of(sweep), table.table)


@pytest.mark.parametrize("rows", [0, 1])
def test_empty_clouds_and_single_points_are_legal(rows: int) -> None:
    for kind in ALONE:
        assert dsrc.corrupt(street()[:rows], kind, boxes=BOXES).shape[1] == 4
    assert len(dsrc.corrupt(street()[:0], "crosstalk", sensor="hdl-64e-s2")) >= 0


def test_presets_are_published_settings() -> None:
    cloud = street()
    out = dsrc.corrupt(cloud, "fog", seed=3, preset="robo3d_heavy")
    own = corrupt_frame(frame_of(cloud, BOXES), "fog", 3, 3, "paper", settings=PRESETS["fog"]["robo3d_heavy"])
    assert np.array_equal(out[:, :3], own.agents[0].sweep.points)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"kind": "frog"}, "did you mean 'fog'"),
        ({"severity": 6}, "1 to 5"),
        ({"severity": "3"}, "1 to 5, found '3'"),
        ({"seed": -1}, "at least 0"),
        ({"kind": "pose_error"}, "several agents"),
        ({"kind": "incomplete_echo"}, "boxes of the vehicles"),
        ({"kind": "spray"}, "boxes of the vehicles with velocities"),
        ({"kind": "spray", "boxes": BOXES[:, :7]}, "velocities"),
        ({"sensor": "hdl_64e"}, "hdl-64e"),
        ({"sensor": "livox-avia"}, "no rings"),
        ({"preset": "robo3d_hevy"}, "did you mean 'robo3d_heavy'"),
        ({"ring": 2}, "ring"),
        ({"ring": 3}, "whole numbers"),
        ({"boxes": np.zeros((2, 5))}, "(2, 5)"),
        ({"on_vehicle": np.zeros(3, bool)}, "on_vehicle"),
        ({"on_vehicle": np.zeros(3, bool), "boxes": BOXES}, "either boxes or on_vehicle, found both"),
        ({"points": example_frame().agents[0].sweep, "sensor": "hdl-64e"}, "a sweep has its own; leave out sensor"),
        ({"points": example_frame().agents[0].sweep, "ring": 4}, "a sweep has its own; leave out ring"),
        ({"preset": "robo3d_heavy", "severity": 3}, "leave out the severity"),
        ({"preset": "robo3d_heavy", "family": "physical"}, "leave out the family"),
        ({"points": street()[:, :2]}, "shape"),
        ({"points": street().astype(int)}, "floats"),
        ({"points": np.column_stack([np.full((5, 3), 1e39), np.zeros(5)])}, "finite"),
        ({"points": np.column_stack([street()[:5, :3], np.full(5, np.nan)])}, "0 to 1"),
        ({"columns": ("x", "y", "z")}, "4, as the points have, found 3"),
        ({"columns": "x,y,intensity,_"}, "names with x, y, z"),
        ({"columns": "x,y,z,X"}, "each once"),
        ({"columns": "x,y,z,ring", "ring": 3}, "its name among the columns"),
        ({"intensity_scale": 0}, "a positive number"),
        ({"intensity_scale": "nuscenes"}, "65535, or waymo"),
        ({"points": np.full((5, 4), 4000.0)}, "0 to 1"),
    ],
)
def test_a_mistake_is_one_line(change: dict, said: str) -> None:
    with pytest.raises((DataError, SettingsError), match=said.replace("(", r"\(").replace(")", r"\)")) as error:
        dsrc.corrupt(**{"points": street(), "kind": "fog", **change})
    assert "\n" not in str(error.value)
