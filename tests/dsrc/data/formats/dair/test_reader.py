import copy
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dsrc.data.datasets.convert import convert
from dsrc.data.drives import list_drives, open_drive, open_drives
from dsrc.data.formats.dair.reader import DairReader
from dsrc.data.formats.levelling import occlusion
from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.data.sample import SampleRequest, make_sample
from dsrc.ops.grid import GridSpec
from sensors.sweep import POINT_FIELDS
from sim.boxes import CLASSES
from sim.errors import DataError
from tests.dsrc.data import dair_tree
from tests.dsrc.data.toy import toy_frame


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return dair_tree.make(tmp_path / "download")


def test_a_batch_is_a_drive_and_a_pair_without_its_cloud_is_reported(
    root: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("WARNING"):
        readers = open_drives(root.parent)
    assert [reader.drive for reader in readers] == [root / "3", root / "12"]
    assert [reader.frames for reader in readers] == [(15346,), (15344, 15345)]
    assert all(reader.agents == (0, -1) for reader in readers)
    assert "1 of 4 pairs are left out" in caplog.text


def test_both_clouds_lie_in_the_boxes_of_the_world(root: Path) -> None:
    """The chain of calibrations, the offset between the sides, and left and right are all as they should be."""
    for frame in (open_drive(root / "12").read(0), open_drive(root / "12").read(1), open_drive(root / "3").read(0)):
        stem = f"{frame.index:06d}"
        assert np.allclose(frame.truth.array, dair_tree.boxes(stem), atol=1e-6)
        assert [CLASSES[i] for i in frame.truth.label] == ["car", "truck", "van"]
        for agent in frame.agents:
            assert len(agent.sweep) == 180  # lost beams are no points
            inside = frame.truth.contains(agent.sweep.world_points, margin=0.01)
            assert np.array_equal(inside.argmax(axis=0), np.repeat([0, 1, 2], 60)) and inside.any(axis=0).all()
            assert agent.sweep.intensity.max() == pytest.approx(179 / 256)
        assert (frame.points_on == 60).all()
        assert np.allclose(frame.agents[0].world_from_body, dair_tree.novatel_to_world(stem), atol=1e-6)


def test_the_sides_keep_their_own_times(root: Path) -> None:
    first, second = (open_drive(root / "12").read(i) for i in (0, 1))
    assert (first.time_s, second.time_s) == pytest.approx((0.0, 0.1))
    assert first.agents[1].sweep.time_s == pytest.approx(-0.1)
    assert second.agents[1].sweep.time_s == pytest.approx(-0.05)
    assert first.agents[0].speed == pytest.approx(5.0, abs=1e-3) and first.agents[1].speed == 0.0
    assert [agent.kind for agent in first.agents] == ["vehicle", "roadside"]


def test_velocities_are_known_only_for_labels_with_tracks(root: Path, tmp_path: Path) -> None:
    plain = open_drive(root / "12").read(0)
    assert plain.truth.object_id.tolist() == [1, 2, 3] and np.isnan(plain.velocity).all()
    tracked = open_drive(dair_tree.make(tmp_path / "tracked", tracks=True) / "12").read(0)
    assert tracked.truth.object_id.tolist() == [41, 42, 43]
    assert np.allclose(tracked.velocity[0], 10.0 * np.array([np.cos(0.6), np.sin(0.6)]), atol=1e-6)
    assert np.allclose(tracked.velocity[1:], 0.0, atol=1e-6)
    alone = open_drive(tmp_path / "tracked" / root.name / "3").read(0)
    assert np.isnan(alone.velocity).all()  # there is no other frame in its batch


def test_splits_and_original_labels_are_parts_of_the_path(root: Path) -> None:
    assert list_drives(root / "val") == [root / "val" / "3", root / "val" / "12"]
    assert open_drive(root / "val" / "12").frames == (15345,)
    assert list_drives(root.parent / "train") == [root / "train" / "12"]
    assert open_drive(root / "train" / "12").frames == (15344,)
    assert len(open_drive(root / "original" / "12").read(0).truth) == 1
    assert list_drives(root / "val" / "original") == list_drives(root / "original" / "val")
    with pytest.raises(DataError, match=r"vla: expected a split or a batch .* did you mean 'val'"):
        list_drives(root / "vla")
    with pytest.raises(DataError, match="expected a batch with frames of this split"):
        list_drives(root / "test")


def test_a_labelled_object_has_at_least_one_point(root: Path) -> None:
    path = root / "cooperative/label_world/015344.json"
    labels = json.loads(path.read_text())
    far = dair_tree.boxes("015344")[0] + [-60.0, -80.0, 0, 0, 0, 0, 0]
    path.write_text(json.dumps([*labels, {"type": "Bus", "world_8_points": dair_tree.corners(far)}]))
    frame = open_drive(root / "12").read(0)
    # It is nearer to the infrastructure than to the vehicle.
    assert frame.points_on[:, 3].tolist() == [0, 1]
    sample = make_sample(frame, None, SampleRequest(GridSpec((-200, -200, -20, 200, 200, 20)), comm_range_m=200.0))
    assert 4 in sample.boxes.object_id


def test_the_vehicle_itself_is_known_by_where_its_lidar_stands(root: Path) -> None:
    path = root / "cooperative/label_world/015344.json"
    labels = json.loads(path.read_text())
    lidar = open_drive(root / "12").read(0).agents[0].sweep.world_from_lidar[:3, 3]
    # The infrastructure has seen it 0.1 s earlier, half a metre behind.
    own = np.array([lidar[0] - 0.5, lidar[1], lidar[2] - 1.2, 4.8, 1.9, 1.6, 2.6])
    path.write_text(json.dumps([*labels, {"type": "Car", "world_8_points": dair_tree.corners(own)}]))
    frame = open_drive(root / "12").read(0)
    assert frame.truth.object_id.tolist() == [0, 1, 2, 3]
    assert np.allclose(frame.truth.array[0], own, atol=1e-6)
    assert (frame.points_on[:, 1:] == 60).all()
    sample = make_sample(frame, 0, SampleRequest(GridSpec((-200, -200, -20, 200, 200, 20)), comm_range_m=200.0))
    assert sample.boxes.object_id.tolist() == [1, 2, 3]


def test_labels_whose_corners_go_round_the_other_way_are_the_same_boxes(root: Path) -> None:
    before = open_drive(root / "12").read(0).truth.array
    path = root / "cooperative/label_world/015344.json"
    labels = json.loads(path.read_text())
    for entry in labels:
        points = entry["world_8_points"]
        entry["world_8_points"] = [points[k] for k in (1, 0, 3, 2, 5, 4, 7, 6)]
    path.write_text(json.dumps(labels))
    assert np.allclose(open_drive(root / "12").read(0).truth.array, before, atol=1e-9)


def test_the_hash_sees_labels_poses_and_clouds(root: Path) -> None:
    before = open_drive(root / "12").digest()
    assert open_drive(root / "12").digest() == before != open_drive(root / "3").digest()
    for name in (
        "cooperative/label_world/015345.json",
        "vehicle-side/calib/novatel_to_world/015345.json",
        "infrastructure-side/calib/virtuallidar_to_world/000011.json",
    ):
        path = root / name
        text = path.read_text()
        path.write_text(text.replace("1", "2", 1))
        assert open_drive(root / "12").digest() != before, name
        path.write_text(text)
    assert open_drive(root / "12").digest() == before


def test_a_reader_travels_to_another_process(root: Path) -> None:
    reader = copy.copy(open_drive(root / "val" / "12"))  # as pickle does
    assert reader.frames == (15345,) and len(reader.read(0).truth) == 3


def test_an_unknown_motion_of_the_sensor_is_named(root: Path) -> None:
    assert open_drive(root / "12", "middle").read(0).agents[0].sweep.motion == "middle"
    with pytest.raises(DataError, match=r"015344.pcd: cannot be read as 'raw': sweep: path: "):
        open_drive(root / "12", "raw").read(0)


def edit(name: str, change: Callable) -> Callable[[Path], None]:
    def broken(root: Path) -> None:
        path = root / name
        value = json.loads(path.read_text())
        value = change(value) or value
        path.write_text(json.dumps(value))

    return broken


LABEL = "cooperative/label_world/015344.json"
NOVATEL = "vehicle-side/calib/novatel_to_world/015344.json"
PAIRS = "cooperative/data_info.json"


@pytest.mark.parametrize(
    ("break_it", "file", "message"),
    [
        (lambda r: (r / LABEL).write_text("[{"), LABEL, "not a readable JSON file"),
        (lambda r: (r / LABEL).write_text("[" * 100_000), LABEL, "[0]: expected object, found array"),
        (lambda r: (r / LABEL).write_bytes(b"\xff\xfe"), LABEL, "not a readable JSON file"),
        (edit(LABEL, lambda v: {"a": 1}), LABEL, "content: expected array, found object"),
        (edit(LABEL, lambda v: v[0].pop("type") and None), LABEL, "[0].type: expected a value, found nothing"),
        (edit(LABEL, lambda v: v[1].update(type="Tank")), LABEL, "[1].type: expected one of Car"),
        (edit(LABEL, lambda v: v[1]["world_8_points"].pop() and None), LABEL, "[1].world_8_points: expected 8 points"),
        (edit(LABEL, lambda v: v[1]["world_8_points"][2].append(1.0)), LABEL, "[1].world_8_points: expected 8 points"),
        (edit(LABEL, lambda v: v[0].update(world_8_points=[[0, 0, 0]] * 8)), LABEL, "expected corners of a box"),
        (edit(LABEL, lambda v: v[0]["world_8_points"].__setitem__(0, ["a", 0, 0])), LABEL, "expected float, found str"),
        (lambda r: (r / NOVATEL).unlink(), NOVATEL, "file not found"),
        (edit(NOVATEL, lambda v: v["rotation"].pop() and None), NOVATEL, "rotation, translation: expected 3 x 3 and 3"),
        (
            edit(NOVATEL, lambda v: v["rotation"][0].__setitem__(0, 5.0)),
            NOVATEL,
            "rotation: expected a rotation matrix",
        ),
        (edit(NOVATEL, lambda v: [[0]]), NOVATEL, "content: expected object, found array"),
        (
            edit(PAIRS, lambda v: v[0].pop("vehicle_pointcloud_path") and None),
            PAIRS,
            "[0].vehicle_pointcloud_path: expected",
        ),
        (
            edit(PAIRS, lambda v: v[0].update(vehicle_pointcloud_path="a/b.pcd")),
            PAIRS,
            "expected a number as name, found b",
        ),
        (edit(PAIRS, lambda v: v[0].update(system_error_offset=[1])), PAIRS, "[0].system_error_offset: expected"),
        (edit("vehicle-side/data_info.json", lambda v: {"a": 1}), "vehicle-side/data_info.json", "expected array"),
        (
            edit("vehicle-side/data_info.json", lambda v: v[0].update(calib_novatel_to_world_path="../../x.json")),
            "vehicle-side/data_info.json",
            "calib_novatel_to_world_path: expected a path in the tree, found ../../x.json",
        ),
        (
            edit("vehicle-side/data_info.json", lambda v: v[0].update(pointcloud_timestamp="noon")),
            "vehicle-side/data_info.json",
            "[0].pointcloud_timestamp: expected int, found str",
        ),
        (
            lambda r: (r / "infrastructure-side/data_info.json").unlink(),
            "infrastructure-side/data_info.json",
            "not found",
        ),
    ],
)
def test_a_broken_tree_gets_one_line_that_names_file_and_field(
    root: Path, break_it: Callable, file: str, message: str
) -> None:
    break_it(root)
    with pytest.raises(DataError) as caught:
        open_drive(root / "12").read(0)
    assert str(caught.value).startswith(str(root / file)) and message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("missing", ["label", "cloud", "vehicle", "infrastructure"])
def test_an_incomplete_pair_is_left_out(root: Path, missing: str, caplog: pytest.LogCaptureFixture) -> None:
    """The published list has pairs that were held back, some without any other trace."""
    if missing == "label":
        (root / LABEL).unlink()
    elif missing == "cloud":
        (root.parent / f"{root.name}-infrastructure-side-velodyne" / "000009.pcd").unlink()
    else:
        path = root / f"{missing}-side/data_info.json"
        path.write_text(json.dumps(json.loads(path.read_text())[1:]))
    assert open_drive(root / "12").frames == (15345,)
    assert "2 of 4 pairs are left out" in caplog.text


def test_a_tree_may_have_another_name(root: Path) -> None:
    tree = root.rename(root.with_name("dair"))
    assert list_drives(tree) == [tree / "3", tree / "12"] == list_drives(tree.parent)


def test_a_tree_without_a_complete_pair_is_named(root: Path) -> None:
    for cloud in root.parent.glob("*-velodyne/*.pcd"):
        cloud.unlink()
    with pytest.raises(DataError, match="pairs: expected at least one whose clouds, label and entries are there"):
        list_drives(root)


@pytest.fixture
def ours(tmp_path: Path) -> Path:
    """The toy drive as a DAIR-V2X-C tree."""
    for index in range(3):
        write_frame(tmp_path / "data" / "toy", toy_frame(index))
    convert(tmp_path / "data", tmp_path / "out", "dair")
    return tmp_path / "out"


def test_our_frames_come_back_from_a_tree_of_ours(ours: Path) -> None:
    (reader,) = open_drives(ours)
    assert reader.agents == (1000, -1) and reader.frames == (0, 1, 2)
    frame, before = reader.read(1), toy_frame(1)
    seen = np.flatnonzero((before.points_on[[0, 2]] >= 1).any(axis=0))
    assert frame.truth.object_id.tolist() == before.truth.object_id[seen].tolist()
    assert np.array_equal(frame.truth.label, before.truth.label[seen])
    assert np.allclose(frame.truth.array, before.truth[seen].array, atol=2e-6)
    assert np.array_equal(frame.points_on, before.points_on[[0, 2]][:, seen])
    assert frame.velocity == pytest.approx(
        (toy_frame(2).truth.center - toy_frame(0).truth.center)[seen, :2] / 0.2, abs=1e-4
    )
    for mine, other in zip(frame.agents, (before.agents[0], before.agents[2]), strict=True):
        assert (mine.agent_id, mine.kind, mine.sweep.spec) == (other.agent_id, other.kind, other.sweep.spec)
        assert np.allclose(mine.world_from_body, other.world_from_body, atol=1e-9)
        assert np.allclose(mine.sweep.world_points, other.sweep.world_points, atol=1e-5)
        for name in POINT_FIELDS[1:]:
            assert np.array_equal(getattr(mine.sweep, name), getattr(other.sweep, name)), name
    assert np.array_equal(frame.agents[0].sweep.points, before.agents[0].sweep.points)


def test_the_infrastructures_frame_is_level_as_a_virtual_lidars(ours: Path) -> None:
    sweep = open_drives(ours)[0].read(0).agents[1].sweep
    assert np.allclose(sweep.world_from_lidar[2], [0, 0, 1, sweep.world_from_lidar[2, 3]], atol=1e-9)
    assert not np.allclose(toy_frame(0).agents[2].sweep.world_from_lidar[2, :3], [0, 0, 1], atol=0.01)


def test_a_tree_has_the_folders_that_loaders_ask_for(ours: Path) -> None:
    root = ours / "cooperative-vehicle-infrastructure"
    for name in (
        "vehicle-side/velodyne/000002.pcd",
        "vehicle-side/label/lidar/000002.json",
        "vehicle-side/label/lidar_backup/000002.json",
        "infrastructure-side/velodyne/000002.pcd",
        "infrastructure-side/label/virtuallidar/000002.json",
        "cooperative/label_world/000002.json",
        "cooperative/label_world_backup/000002.json",
    ):
        assert (root / name).is_file(), name
    assert json.loads((root / "train.json").read_text()) == ["000000", "000001", "000002"]
    assert not (root / ".parts").exists() and not list(root.rglob("*.tmp"))
    around, front = (
        json.loads((root / f"cooperative/{n}/000000.json").read_text()) for n in ("label_world", "label_world_backup")
    )
    assert {entry["track_id"] for entry in front} < {entry["track_id"] for entry in around}
    # In its own frame a box has the point of view of the sensor: 1001 stands 20 m ahead of the first car.
    (truck,) = (
        e for e in json.loads((root / "vehicle-side/label/lidar/000000.json").read_text()) if e["track_id"] == "1001"
    )
    assert truck["type"] == "Truck" and np.hypot(truck["3d_location"]["x"], truck["3d_location"]["y"]) == pytest.approx(
        np.hypot(20, 6), abs=0.05
    )
    assert truck["3d_dimensions"] == {"h": 3.0, "w": 2.5, "l": 9.0}


def test_labels_say_how_much_the_better_placed_side_sees(ours: Path) -> None:
    root = ours / "cooperative-vehicle-infrastructure"
    frame = toy_frame(1)
    around = {e["track_id"]: e for e in json.loads((root / "cooperative/label_world/000001.json").read_text())}
    for row, number in enumerate(frame.truth.object_id.tolist()):
        if str(number) in around:
            best = occlusion(frame.visible_fraction[[0, 2], row]).min()
            assert around[str(number)]["occluded_state"] == best
    assert {entry["occluded_state"] for entry in around.values()} > {0}


def test_a_frame_of_one_agent_has_no_two_sides(tmp_path: Path) -> None:
    write_frame(tmp_path / "data" / "toy", toy_frame(0).of_agents([0]))
    with pytest.raises(DataError, match=r"toy: frame 0: agents: expected two, one for each side of DAIR-V2X-C"):
        convert(tmp_path / "data", tmp_path / "out", "dair")
    with pytest.raises(DataError, match=r"toy: frame 0: agents: expected agent 7, found \[1000\]"):
        convert(tmp_path / "data", tmp_path / "other", "dair", agent_id="7")


def test_two_vehicles_are_two_sides(tmp_path: Path) -> None:
    write_frame(tmp_path / "data" / "toy", toy_frame(0).of_agents([0, 1]))
    convert(tmp_path / "data", tmp_path / "out", "dair", agent_id="1002")
    (reader,) = open_drives(tmp_path / "out")
    assert reader.agents == (1002, 1000)
    assert [agent.kind for agent in reader.read(0).agents] == ["vehicle", "vehicle"]


def test_dair_reader_needs_a_batch(root: Path) -> None:
    with pytest.raises(DataError, match="expected a batch of a DAIR-V2X-C tree"):
        DairReader(root)
