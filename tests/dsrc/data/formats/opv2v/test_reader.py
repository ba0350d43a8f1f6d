import json
import math
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from dsrc.data.checksums import write_checksums
from dsrc.data.datasets.corrupt import corrupt_dataset
from dsrc.data.drive_folder import write_protocol
from dsrc.data.drives import list_drives
from dsrc.data.formats.annotation import flattened
from dsrc.data.formats.opv2v.reader import DriveReader, agent_table, write_frame
from dsrc.data.formats.pcd import read_pcd
from sensors.deskew import deskew_frame
from sensors.frame import Frame
from sensors.sweep import MOTIONS, Motion
from sim.boxes import Boxes
from sim.errors import DataError, SettingsError
from sim.geometry import matrix_from_carla, pose_matrix, transform_points
from tests.dsrc.data import goldens
from tests.dsrc.data.toy import same_frames, toy_frame


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    for index in range(2):
        write_frame(tmp_path / "drive", toy_frame(index))
    return tmp_path / "drive"


@pytest.fixture(scope="module")
def mini(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return goldens.unpack_opv2v_mini(tmp_path_factory.mktemp("mini"))


def plain(path: Path) -> dict:
    """Read a yaml as other tools do."""
    return yaml.load(path.read_text(), yaml.SafeLoader)


def strip(drive: Path) -> None:
    """Make the drive one that another tool could have written."""
    for path in drive.glob("*/*.yaml"):
        path.write_text(path.read_text().partition("\n")[2])


def test_a_frame_reads_back_equal_to_what_was_written(drive: Path) -> None:
    reader = DriveReader(drive)
    assert reader.frames == (0, 1) and len(reader) == 2
    assert same_frames(reader.read(1), toy_frame(1))
    assert same_frames(DriveReader(drive).read(0), toy_frame(0))


def test_frames_without_objects_agents_points_or_spec_are_legal(tmp_path: Path) -> None:
    full = toy_frame(7)
    empty = replace(full.agents[0], sweep=replace(full.agents[0].sweep[:0], spec=None))
    frame = Frame(7, 0.7, (empty,), Boxes.zeros(), np.zeros((0, 2)), np.zeros((1, 0), np.int32))
    write_frame(tmp_path / "d", frame)
    assert same_frames(DriveReader(tmp_path / "d").read(0), frame)


def test_old_trees_have_unknown_lanes_and_visible_fractions(drive: Path) -> None:
    wanted = ("acceleration", "signals", "lane", "visible_fraction")
    for path in drive.glob("*/*.yaml"):
        line, _, rest = path.read_text().partition("\n")
        record = json.loads(line.removeprefix("testbed: '").removesuffix("'"))
        old = json.dumps({name: value for name, value in record.items() if name not in wanted})
        path.write_text(f"testbed: '{old.replace(chr(39), chr(92) + 'u0027')}'\n{rest}")
    frame = DriveReader(drive).read(0)
    assert np.isnan(frame.acceleration).all() and frame.acceleration.shape == (6, 2)
    assert np.isnan(frame.visible_fraction).all() and frame.visible_fraction.shape == (3, 6)
    assert frame.lane == ("",) * 6 and not frame.signals.any()


def test_a_box_that_is_no_number_is_never_written(tmp_path: Path) -> None:
    frame = toy_frame(0)
    frame.truth.center[1, 2] = math.nan
    with pytest.raises(ValueError, match="frame 0: a box, velocity or pose is not finite"):
        write_frame(tmp_path / "d", frame)
    assert not list(tmp_path.rglob("*.pcd"))


def test_the_yaml_says_in_carlas_words_what_the_frame_holds(drive: Path) -> None:
    frame, notes = toy_frame(1), plain(drive / "1000" / "000001.yaml")
    agent = frame.agents[0]
    assert notes["ego_speed"] == pytest.approx(7.25 * 3.6)
    assert np.allclose(matrix_from_carla(notes["lidar_pose"]), agent.sweep.world_from_lidar, atol=1e-9)
    assert np.allclose(matrix_from_carla(notes["true_ego_pos"]), agent.world_from_body, atol=1e-9)
    row = frame.truth.object_id.tolist().index(1001)
    truck = notes["vehicles"][1001]
    center = np.add(truck["location"], truck["center"]) * [1, -1, 1]
    assert np.allclose(center, frame.truth.center[row], atol=1e-9)
    assert np.allclose(2 * np.array(truck["extent"]), frame.truth.size[row], atol=1e-9)
    assert truck["angle"] == pytest.approx([0.0, -math.degrees(frame.truth.yaw[row]), 0.0])
    assert truck["speed"] == pytest.approx(3.6 * np.hypot(*frame.velocity[row]))


def test_the_yaml_of_a_vehicle_has_the_pose_of_its_tilted_body(tmp_path: Path) -> None:
    level = toy_frame(0)
    tilt = np.random.default_rng(0).uniform(-0.1, 0.1, (len(level.truth), 2))
    write_frame(tmp_path / "d", replace(level, tilt=tilt))
    read = DriveReader(tmp_path / "d").read(0)
    np.testing.assert_array_equal(read.tilt, tilt)
    assert same_frames(replace(read, tilt=level.tilt), level)
    row = level.truth.object_id.tolist().index(1001)
    truck = plain(tmp_path / "d" / "1000" / "000000.yaml")["vehicles"][1001]
    pose = matrix_from_carla([*np.add(truck["location"], truck["center"]), *truck["angle"]])
    expected = pose_matrix(level.truth.center[row], level.truth.yaw[row], *tilt[row])
    np.testing.assert_allclose(pose, expected, atol=1e-9)


def test_vehicles_are_those_the_agent_has_a_point_on_without_itself(drive: Path) -> None:
    listed = {agent: set(plain(drive / agent / "000000.yaml")["vehicles"]) for agent in ("1000", "1002", "-1")}
    assert listed["1000"] == {1001, 1002, 1004}  # not the pedestrian, not the car 1 km away
    assert listed["1002"] == {1000, 1001}  # no point on the bus
    assert listed["-1"] == {1000, 1001, 1002, 1004}


def test_connected_vehicles_can_be_left_out(tmp_path: Path) -> None:
    write_frame(tmp_path / "d", toy_frame(0), connected_vehicles=False)
    assert set(plain(tmp_path / "d" / "-1" / "000000.yaml")["vehicles"]) == {1001, 1004}
    assert same_frames(DriveReader(tmp_path / "d").read(0), toy_frame(0))


@pytest.mark.parametrize("written", MOTIONS)
@pytest.mark.parametrize("wanted", MOTIONS)
def test_a_drive_written_in_one_motion_reads_in_any_other(tmp_path: Path, written: Motion, wanted: Motion) -> None:
    write_frame(tmp_path / "d", toy_frame(1), motion=written)
    assert DriveReader(tmp_path / "d").read(0).agents[0].sweep.motion == written
    frame, expected = DriveReader(tmp_path / "d", wanted).read(0), deskew_frame(toy_frame(1), wanted)
    for mine, other in zip(frame.agents, expected.agents, strict=True):
        assert mine.sweep.motion == wanted and mine.sweep.time_s == pytest.approx(other.sweep.time_s, abs=1e-12)
        np.testing.assert_allclose(mine.sweep.points, other.sweep.points, atol=5e-5)
        np.testing.assert_allclose(mine.sweep.world_from_lidar, other.sweep.world_from_lidar, atol=1e-9)
        np.testing.assert_allclose(mine.sweep.time_offset, other.sweep.time_offset, atol=1e-8)
    assert np.array_equal(frame.truth.array, toy_frame(1).truth.array) and frame.time_s == toy_frame(1).time_s


def test_a_frame_keeps_the_paths_of_its_sensors_and_their_motion(tmp_path: Path) -> None:
    frame = deskew_frame(toy_frame(2), "raw")
    write_frame(tmp_path / "d", frame)
    assert same_frames(DriveReader(tmp_path / "d").read(0), frame)
    assert same_frames(DriveReader(tmp_path / "d", "raw").read(0), frame)


@pytest.mark.parametrize(("motion", "after"), [("start", -0.05), ("middle", 0.0), ("end", 0.05), ("raw", 0.0)])
def test_lidar_pose_is_the_frame_of_the_points(tmp_path: Path, motion: Motion, after: float) -> None:
    sweep = toy_frame(1).agents[0].sweep
    write_frame(tmp_path / "d", toy_frame(1), motion=motion)
    pose = matrix_from_carla(plain(tmp_path / "d" / "1000" / "000001.yaml")["lidar_pose"])
    np.testing.assert_allclose(pose, sweep.path.at(np.array([sweep.time_s + after]))[0], atol=1e-9)
    if motion != "raw":
        points = read_pcd(tmp_path / "d" / "1000" / "000001.pcd").points.astype(np.float64)
        np.testing.assert_allclose(transform_points(pose, points), sweep.world_points, atol=5e-5)


def record_of(path: Path) -> tuple[dict, str]:
    line, _, rest = path.read_text().partition("\n")
    return json.loads(line.removeprefix("testbed: '").removesuffix("'")), rest


def age(drive: Path) -> None:
    """Make the drive one that was written before records kept the sensors' paths."""
    for path in drive.glob("*/*.yaml"):
        record, rest = record_of(path)
        del record["motion"], record["path"]
        path.write_text(f"testbed: '{json.dumps(record)}'\n{rest}")


@pytest.mark.parametrize("older", [age, strip])
@pytest.mark.parametrize("motion", ["start", "end", "raw"])
def test_a_drive_without_paths_reads_as_it_is_and_not_otherwise(drive: Path, older: Callable, motion: Motion) -> None:
    older(drive)
    plainly, middle = DriveReader(drive).read(0), DriveReader(drive, "middle").read(0)
    assert plainly.agents[0].sweep.path is None and plainly.agents[0].sweep.motion == "middle"
    assert np.array_equal(plainly.agents[0].sweep.points, toy_frame(0).agents[0].sweep.points)
    assert same_frames(plainly, middle)
    with pytest.raises(DataError, match=rf"1000/000000.pcd: cannot be read as '{motion}': sweep: path: ") as caught:
        DriveReader(drive, motion).read(0)
    assert "\n" not in str(caught.value)


def test_a_motion_with_a_typo_is_named_before_anything_is_read(drive: Path) -> None:
    with pytest.raises(SettingsError, match="did you mean 'raw'"):
        DriveReader(drive, "row")  # type: ignore[arg-type]


def test_a_sweep_without_a_path_cannot_be_written_in_another_motion(tmp_path: Path) -> None:
    frame = toy_frame(0)
    frame = frame.with_sweeps([replace(agent.sweep, path=None) for agent in frame.agents])
    with pytest.raises(DataError, match="frame 0: agent 1000: sweep: path"):
        write_frame(tmp_path / "d", frame, motion="raw")
    assert not (tmp_path / "d").exists()


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ([[0.0] * 7], "testbed.path: expected none or at least two poses, times ascending"),
        ([[0.1] + [0.0] * 6, [0.1] + [0.0] * 6], "testbed.path: expected none or at least two poses"),
        ([[0.0] * 6, [0.1] * 6], "testbed: damaged record"),
    ],
)
def test_a_path_that_is_none_gets_one_line(drive: Path, path: list, message: str) -> None:
    notes = drive / "1000" / "000000.yaml"
    record, rest = record_of(notes)
    notes.write_text(f"testbed: '{json.dumps({**record, 'path': path})}'\n{rest}")
    with pytest.raises(DataError) as caught:
        DriveReader(drive).read(0)
    assert f"{notes}: {message}" in str(caught.value) and "\n" not in str(caught.value)


def test_a_drive_without_our_record_reads_as_plain_opv2v(drive: Path) -> None:
    strip(drive)
    frame, truth = DriveReader(drive).read(0), toy_frame(0).truth
    seen = truth[[0, 1, 2, 4]]
    assert frame.truth.object_id.tolist() == [1000, 1001, 1002, 1004]
    assert np.allclose(frame.truth.array, seen.array, atol=1e-9)
    assert (frame.truth.label == 0).all()
    assert np.allclose(frame.velocity, toy_frame(0).velocity[[0, 1, 2, 4]], atol=1e-9)
    assert ((frame.points_on > 0) == (toy_frame(0).points_on[:, [0, 1, 2, 4]] > 0))[:, 1].all()
    assert [a.sweep.spec for a in frame.agents] == [None] * 3
    assert [a.kind for a in frame.agents] == ["vehicle", "vehicle", "roadside"]


def test_carla_boxes_match_the_reference() -> None:
    golden = goldens.load("coords")
    for case in ("case0", "case1", "case2"):
        get = {k: golden[f"{case}/{k}"] for k in ("ids", "location", "center", "angle", "extent", "lidar_pose")}
        world_from_box = matrix_from_carla(np.concatenate([get["location"] + get["center"], get["angle"]], axis=1))
        lidar_from_box = np.linalg.inv(matrix_from_carla(get["lidar_pose"])) @ world_from_box
        boxes = flattened(lidar_from_box, get["extent"], get["ids"])
        order = [golden[f"{case}/unfiltered/ids"].tolist().index(i) for i in get["ids"]]
        want = goldens.ours(golden[f"{case}/unfiltered/boxes"][order])
        assert goldens.apart(boxes.array, want).max() < 1e-6


def test_the_golden_tree_reads_as_the_reference_reads_it(mini: Path) -> None:
    expected = goldens.load("opv2v_mini_expected")
    drives = list_drives(mini)
    assert [d.name for d in drives] == ["2021_01_01_a", "2021_01_02_b_far"]
    reader = DriveReader(drives[0])
    assert reader.agents == (641, 650, -1) and reader.frames == (68, 70)
    sweep = reader.read(0).agents[0].sweep
    cloud = np.concatenate([sweep.points * [1, -1, 1], sweep.intensity[:, None]], axis=1)
    # The golden cloud belongs to one of the agents of the tree.
    clouds = [a.sweep for d in drives for i in range(len(DriveReader(d))) for a in DriveReader(d).read(i).agents]
    arrays = [np.concatenate([s.points * [1, -1, 1], s.intensity[:, None]], axis=1) for s in clouds]
    assert cloud.shape[1] == 4
    assert any(
        a.shape == expected["pcd_to_np"].shape and np.allclose(a, expected["pcd_to_np"], atol=1e-5) for a in arrays
    )
    assert reader.read(1).time_s - reader.read(0).time_s == pytest.approx(0.1)


def test_drives_are_found_at_and_below_a_folder(mini: Path, tmp_path: Path) -> None:
    assert list_drives(mini.parent) == list_drives(mini)
    assert list_drives(mini / "2021_01_01_a") == [mini / "2021_01_01_a"]
    with pytest.raises(DataError, match="expected an OPV2V tree"):
        list_drives(tmp_path)
    with pytest.raises(DataError, match="no such folder"):
        list_drives(tmp_path / "nowhere")


def test_the_hash_sees_an_edited_annotation_and_no_location(drive: Path, tmp_path: Path) -> None:
    before = DriveReader(drive).digest()
    copy = shutil.copytree(drive, tmp_path / "elsewhere" / "drive")
    assert DriveReader(copy).digest() == before
    path = drive / "1000" / "000001.yaml"
    path.write_text(path.read_text().replace("ego_speed: 26", "ego_speed: 27"))
    assert DriveReader(drive).digest() != before


def test_the_hash_sees_clouds_that_were_changed_in_place(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def dim(path: Path) -> bytes:
        before = path.read_bytes()
        path.write_bytes(before[:-40] + bytes(40))
        return before

    monkeypatch.setenv("DSRC_CACHE", str(tmp_path / "cache"))
    cloud = drive / "1000" / "000001.pcd"
    foreign = DriveReader(drive).digest()
    before = dim(cloud)
    assert DriveReader(drive).digest() != foreign
    cloud.write_bytes(before)
    assert DriveReader(drive).digest() == foreign

    listed = write_checksums(drive)
    own = DriveReader(drive).digest()
    os.utime(listed, (1e9, 1e9))  # as in a copy whose clouds are newer, which is read once
    assert DriveReader(drive).digest() == own
    with monkeypatch.context() as patch:
        patch.setattr("dsrc.data.checksums.file_sha256", lambda path: pytest.fail(f"{path} is read again"))
        assert DriveReader(drive).digest() == own
    times = cloud.stat()
    dim(cloud)
    assert DriveReader(drive).digest() != own
    os.utime(cloud, ns=(times.st_atime_ns, times.st_mtime_ns))  # as by a tool that keeps the time of a file
    assert DriveReader(drive).digest() != own
    listed.write_text("damaged\n")
    os.utime(listed, (1e9, 1e9))
    assert DriveReader(drive).digest() not in (own, foreign)


def damage(path: Path, pattern: str, replacement: str) -> None:
    text, count = re.subn(pattern, replacement, path.read_text(), count=1)
    assert count == 1
    path.write_text(text)


@pytest.mark.parametrize(
    ("pattern", "replacement", "message"),
    [
        (r"location: \[[^,]*", "location: [.nan", "vehicles.1001.location: expected a finite number"),
        (r"extent: \[[^,]*", "extent: [-1.0", "vehicles.1001.extent: expected positive sizes"),
        (r"angle: \[[^,]*,", "angle: [", "vehicles.1001.angle: expected 3 numbers"),
        (r"lidar_pose: .*", "lidar_pose: 3", "lidar_pose: expected 6 numbers, found 3"),
        (r"  1001:", "  truck:", "vehicles: expected whole numbers as ids, found truck"),
        (r"  1001:", '  "--5":', "vehicles: expected whole numbers as ids, found --5"),
        (r"  1001:", "  99999999999999999999:", "vehicles: expected whole numbers as ids"),
        (r"ego_speed: .*", "ego_speed: 2001-99-99", "not a readable YAML file"),
        (r"ego_speed: .*", "ego_speed: !!python/object/apply:os.getcwd []", "expected plain values, found a tag"),
        (r"vehicles:(.|\n)*", "", "vehicles: expected a mapping of object id to box, found nothing"),
    ],
)
@pytest.mark.parametrize("foreign", [False, True])
def test_a_broken_yaml_gets_one_line(drive: Path, pattern: str, replacement: str, message: str, foreign: bool) -> None:
    if foreign:
        strip(drive)
    path = drive / "1000" / "000000.yaml"
    damage(path, pattern, replacement)
    with pytest.raises(DataError) as caught:
        DriveReader(drive).read(0)
    assert str(path) in str(caught.value) and message in str(caught.value) and "\n" not in str(caught.value)


def test_an_edited_or_damaged_record_is_not_believed(drive: Path) -> None:
    path = drive / "1000" / "000000.yaml"
    text = path.read_text()
    damage(path, r"speed: \d", "speed: 9")
    with pytest.raises(DataError, match=r"testbed.check: the file was edited or cut"):
        DriveReader(drive).read(0)
    path.write_text(text.replace('"points_on"', '"points"', 1))
    with pytest.raises(DataError, match="testbed: damaged record"):
        DriveReader(drive).read(0)
    path.write_text(text.partition("\n")[2])
    with pytest.raises(DataError, match="expected a record as in the other agents' files"):
        DriveReader(drive).read(0)
    path.write_text(text[:200])
    with pytest.raises(DataError, match="damaged record"):
        DriveReader(drive).read(0)


@pytest.mark.parametrize(
    ("field", "change"),
    [("points_on", 2**40), ("points_on", -1), ("object_id", 10**30), ("box", [0, 0, 0, -4, 2, 1.5, 0])],
)
def test_a_record_with_an_impossible_number_gets_one_line(drive: Path, field: str, change: object) -> None:
    path = drive / "1000" / "000000.yaml"
    record, rest = record_of(path)
    record[field][0] = change
    path.write_text(f"testbed: '{json.dumps(record)}'\n{rest}")
    with pytest.raises(DataError, match=rf"000000.yaml: testbed.*{field}") as caught:
        DriveReader(drive).read(0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("agents", [None, 5, ["a"], {"a": {}}])
def test_a_protocol_with_impossible_agents_is_named(drive: Path, agents: object) -> None:
    (drive / "data_protocol.yaml").write_text(yaml.safe_dump({"testbed": {"agents": agents}}))
    with pytest.raises(DataError, match=r"data_protocol.yaml: testbed.agents"):
        DriveReader(drive)


def test_frames_are_in_the_order_of_their_numbers(drive: Path) -> None:
    strip(drive)
    for old, new in (("000000", "2"), ("000001", "10")):
        for path in drive.glob(f"*/{old}.*"):
            path.rename(path.with_stem(new))
    assert DriveReader(drive).frames == (2, 10)


def test_an_ego_without_frames_and_an_id_with_zeros_before_it_are_named(drive: Path) -> None:
    strip(drive)
    (drive / "1002").rename(drive / "01002")
    with pytest.raises(DataError, match=r"drive: agent folders: expected ids without leading zeros, found 01002"):
        DriveReader(drive)
    (drive / "01002").rename(drive / "1002")
    for path in (drive / "1000").iterdir():
        path.unlink()
    with pytest.raises(DataError, match=r"drive/1000: timestamps: expected files such as 000000.yaml"):
        DriveReader(drive)


@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize("lost", ["1002/000000.pcd", "1002/000000.yaml", "1000/000000.pcd", "1000/000000.yaml"])
def test_a_frame_that_an_agent_lacks_a_file_of_is_left_out_on_request(
    drive: Path, tmp_path: Path, own: bool, lost: str
) -> None:
    if own:
        write_protocol(drive, {"testbed": {"frames": 2}})
    else:
        strip(drive)
    kept = DriveReader(drive).read(1)
    before = DriveReader(drive).digest()
    (drive / lost).unlink()
    ways = "a line `missing: frame` leaves such frames out, `missing: agent` such agents"
    if own or lost != "1000/000000.yaml":  # without a number of frames the ego's annotations say which there are
        with pytest.raises(DataError, match=rf"{lost}: file is missing; in .*data_protocol.yaml, {ways}"):
            DriveReader(drive)
    with (drive / "data_protocol.yaml").open("a") as file:
        file.write("\nmissing: frame\n")
    reader = DriveReader(drive)
    assert reader.frames == (kept.index,)
    assert same_frames(reader.read(0), kept) or not own
    assert np.array_equal(reader.read(0).agents[1].sweep.points, kept.agents[1].sweep.points)
    assert reader.digest() != before
    assert "missing" not in reader.protocol
    assert reader.protocol.get("testbed", {"frames": 1})["frames"] == 1
    # A drive that is made of it is whole, and does not excuse gaps of its own.
    corrupt_dataset(data=drive, out=tmp_path / "foggy", corruption="fog", severity=1)
    (foggy,) = list_drives(tmp_path / "foggy")
    assert DriveReader(foggy).frames == (kept.index,)
    assert "missing" not in (foggy / "data_protocol.yaml").read_text()
    for agent in reader.agents:
        (drive / str(agent) / "000001.pcd").unlink(missing_ok=True)
    with pytest.raises(DataError, match="frames: expected one of which no agent lacks a file, found none"):
        DriveReader(drive)


@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize("lost", ["1002/000000.pcd", "1000/000001.yaml", "1002"])
def test_an_agent_that_lacks_a_file_is_left_out_on_request(
    drive: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, own: bool, lost: str
) -> None:
    whole = [DriveReader(drive).read(i) for i in range(2)]
    if own:
        write_protocol(drive, {"testbed": {"frames": 2, "agents": agent_table(whole[0])}})
    else:
        strip(drive)
    plain = [DriveReader(drive).read(i) for i in range(2)]
    gone = int(lost.split("/")[0])
    shutil.rmtree(drive / lost) if lost == "1002" else (drive / lost).unlink()
    with (drive / "data_protocol.yaml").open("a") as file:
        file.write("\nmissing: agent\n")
    reader = DriveReader(drive)
    left = tuple(agent.agent_id for agent in plain[0].agents if agent.agent_id != gone)
    assert (reader.agents, reader.frames) == (left, (0, 1))
    rows = [row for row, agent in enumerate(whole[0].agents) if agent.agent_id != gone]
    for i, frame in enumerate(plain):
        read = reader.read(i)
        assert tuple(agent.agent_id for agent in read.agents) == left
        assert same_frames(read, frame.of_agents(rows)) or not own
        for row, agent in zip(rows, read.agents, strict=True):
            assert np.array_equal(agent.sweep.points, frame.agents[row].sweep.points)
    if own or lost != "1002":
        assert f"agents those that lack a file are left out: {gone}" in caplog.text
    # A drive that is made of it is whole, of the agents that are left.
    corrupt_dataset(data=drive, out=tmp_path / "foggy", corruption="fog", severity=1)
    (foggy,) = list_drives(tmp_path / "foggy")
    assert (DriveReader(foggy).agents, DriveReader(foggy).frames) == (left, (0, 1))
    for agent in left:
        (drive / str(agent) / "000001.pcd").unlink()
    with pytest.raises(DataError, match="agents: expected one that lacks no file, found none"):
        DriveReader(drive)


def test_what_becomes_of_missing_files_is_one_of_what_there_is(drive: Path) -> None:
    (drive / "1002" / "000001.pcd").unlink()
    with (drive / "data_protocol.yaml").open("a") as file:
        file.write("\nmissing: agents\n")
    with pytest.raises(DataError, match=r"data_protocol.yaml: missing: expected frame or agent, found agents"):
        DriveReader(drive)


def test_missing_parts_of_a_drive_are_named(drive: Path) -> None:
    write_protocol(drive, {"testbed": {"frames": 3, "agents": {1000: {}, 1002: {}, -1: {}}}})
    with pytest.raises(DataError, match=r"frames: expected 3 as in data_protocol.yaml, found 2; run dsrc generate"):
        DriveReader(drive)
    (drive / "1002" / "000001.pcd").unlink()
    with pytest.raises(DataError, match=r"1002/000001.pcd: file is missing"):
        DriveReader(drive)
    shutil.rmtree(drive / "1002")
    with pytest.raises(DataError, match=r"drive/1002: agent folder is missing; data_protocol.yaml names it"):
        DriveReader(drive)
    (drive / "data_protocol.yaml").unlink()
    with pytest.raises(DataError, match=r"agent folders: expected \[1000, 1002, -1\]"):
        DriveReader(drive).read(0)
    with pytest.raises(DataError, match="did you mean 'drive'"):
        DriveReader(drive.parent / "driev")
