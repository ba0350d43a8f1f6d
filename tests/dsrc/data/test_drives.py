"""Trees as they come from elsewhere, and finding drives of any format."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from dsrc.data.drives import drive_hashes, list_drives, open_drive, open_drives, traffic_runs
from dsrc.data.formats.opv2v.reader import write_frame
from sim.errors import DataError
from tests.dsrc.data import dair_tree
from tests.dsrc.data.loaders import x_to_world
from tests.dsrc.data.toy import toy_frame

HEADER = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z rgb
SIZE 4 4 4 4
TYPE F F F F
COUNT 1 1 1 1
WIDTH {n}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {n}
DATA ascii
"""
POSES = {
    641: [10.0, -20.0, 1.9, 0.5, 30.0, -1.0],
    650: [40.0, 5.0, 1.9, 0.0, -120.0, 0.0],
    -1: [25.0, -8.0, 4.5, 0, 90, -2],
}
CARS = {
    700: {
        "location": [25.0, -10.0, 0.1],
        "angle": [0.5, 45.0, -1.0],
        "extent": [2.4, 1.0, 0.8],
        "center": [0.1, 0.0, 0.75],
    },
    701: {
        "location": [20.0, 4.0, 0.0],
        "angle": [0.0, -100.0, 0.0],
        "extent": [4.0, 1.2, 1.6],
        "center": [0.0, 0.1, 1.5],
    },
}


def carla_points(rng: np.random.Generator) -> np.ndarray:
    """40 points in each car, in CARLA's world: its box is turned by all three angles about location + center."""
    parts = []
    for car in CARS.values():
        pose = x_to_world([*np.add(car["location"], car["center"]), *car["angle"]])
        parts.append((rng.uniform(-0.9, 0.9, (40, 3)) * car["extent"]) @ pose[:3, :3].T + pose[:3, 3])
    return np.concatenate(parts)


def real_opv2v(split: Path, stem_digits: int = 6) -> Path:
    """A scenario as OpenCDA dumps it: Open3D's ascii clouds, all keys, cameras, further files and folders."""
    rng = np.random.default_rng(3)
    scenario = split / "2021_08_22_21_41_24"
    (scenario / "maps").mkdir(parents=True)
    (scenario / ".cache").mkdir()
    (scenario / "notes.txt").write_text("no agent")
    for agent, pose in POSES.items():
        folder = scenario / str(agent)
        folder.mkdir()
        for tick in (69, 71):
            stem = f"{tick:0{stem_digits}d}"
            vehicles = {number: {**car, "speed": 18.0} for number, car in CARS.items()}
            content = {
                "camera0": {"cords": pose, "extrinsic": np.eye(4).tolist(), "intrinsic": np.eye(3).tolist()},
                "ego_speed": 36.0,
                "lidar_pose": pose,
                "plan_trajectory": [[1.0, 2.0, 3.0]],
                "predicted_ego_pos": pose,
                "true_ego_pos": [*pose[:2], 0.05, *pose[3:]],
                "vehicles": vehicles,
            }
            text = yaml.dump(content)
            # YAML 1.1 takes a number without a dot for text; other tools write some.
            (folder / f"{stem}.yaml").write_text(text.replace("ego_speed: 36.0", "ego_speed: 36e0"))
            (folder / f"{stem}_additional.yaml").write_text("speed_limit: 50\n")
            (folder / f"{stem}_camera0.png").write_bytes(b"\x89PNG")
            world = x_to_world(pose)
            local = (carla_points(rng) - world[:3, 3]) @ world[:3, :3]
            red = np.arange(len(local)) % 256
            packed = (red.astype(np.uint32) << 16).view(np.float32)
            rows = [f"{x:.6f} {y:.6f} {z:.6f} {c:.9g}" for (x, y, z), c in zip(local, packed, strict=True)]
            (folder / f"{stem}.pcd").write_text(HEADER.format(n=len(local)) + "\n".join(rows) + "\n")
    return scenario


@pytest.mark.parametrize("digits", [5, 6])
def test_opv2v_and_v2xset_read_as_they_come(tmp_path: Path, digits: int) -> None:
    """V2XSet's names have 5 digits and its roadside units negative ids; nothing else differs."""
    scenario = real_opv2v(tmp_path / "train", digits)
    (reader,) = open_drives(tmp_path)
    assert reader.drive == scenario and reader.agents == (641, 650, -1) and reader.frames == (69, 71)
    frame = reader.read(0)
    assert [agent.kind for agent in frame.agents] == ["vehicle", "vehicle", "roadside"]
    assert frame.truth.object_id.tolist() == [700, 701]
    assert reader.read(1).time_s - frame.time_s == pytest.approx(0.1)
    for agent in frame.agents:
        inside = frame.truth.contains(agent.sweep.world_points, 0.05)
        assert np.array_equal(inside.argmax(axis=0), np.repeat([0, 1], 40)) and inside.any(axis=0).all()
        assert agent.sweep.intensity.tolist() == pytest.approx((np.arange(80) / 255).tolist())
        assert agent.speed == pytest.approx(10.0)
        # Right of CARLA's x axis is where our y is negative.
        assert agent.sweep.world_from_lidar[1, 3] == -POSES[agent.agent_id][1]
    assert np.hypot(*frame.velocity.T) == pytest.approx([5.0, 5.0])
    assert frame.agents[0].world_from_body[2, 3] == 0.05


def test_missing_speeds_are_differences_of_positions(tmp_path: Path) -> None:
    scenario = real_opv2v(tmp_path)
    for path in scenario.glob("*/0000??.yaml"):
        content = yaml.safe_load(path.read_text())
        del content["vehicles"][700]["speed"]
        content["vehicles"][700]["location"][0] += 0.3 * (int(path.stem) - 69)
        path.write_text(yaml.dump(content))
    frame = open_drive(scenario).read(0)
    assert frame.velocity[0] == pytest.approx([6.0, 0.0])
    assert np.hypot(*frame.velocity[1]) == pytest.approx(5.0)


def test_python_in_a_yaml_is_not_run(tmp_path: Path) -> None:
    scenario = real_opv2v(tmp_path)
    path = scenario / "641" / "000069.yaml"
    path.write_text(f"lidar_pose: !!python/object/apply:os.system ['touch {tmp_path / 'pwned'}']\n" + path.read_text())
    with pytest.raises(DataError, match=r"000069.yaml: line 1: expected plain values, found a tag"):
        open_drive(scenario).read(0)
    assert not (tmp_path / "pwned").exists()


def test_formats_beside_each_other_are_all_found(tmp_path: Path) -> None:
    real_opv2v(tmp_path / "opv2v")
    write_frame(tmp_path / "ours", toy_frame(0))
    root = dair_tree.make(tmp_path / "dair")
    found = list_drives(tmp_path)
    assert set(found) == {root / "3", root / "12", tmp_path / "opv2v" / "2021_08_22_21_41_24", tmp_path / "ours"}
    assert {reader.format for reader in open_drives(tmp_path)} == {"OPV2V", "DAIR-V2X-C"}
    assert all(len(reader.read(0).truth) >= 2 for reader in open_drives(tmp_path))
    names = drive_hashes(found)
    assert set(names) == {"3", "12", "2021_08_22_21_41_24", "ours"} and len(set(names.values())) == 4


def test_a_drive_whose_name_is_a_number_does_not_make_its_folder_a_drive(tmp_path: Path) -> None:
    write_frame(tmp_path / "val" / "12", toy_frame(0))
    (tmp_path / "val" / "12" / "data_protocol.yaml").write_text("a: 1\n")
    assert list_drives(tmp_path) == list_drives(tmp_path / "val") == [tmp_path / "val" / "12"]


def test_clouds_in_bin_beside_annotations_are_named_as_v2x_reals(tmp_path: Path) -> None:
    """Files as its loader looks for them: https://github.com/ucla-mobility/V2X-Real, basedataset.py, load_lidar_bin."""
    write_frame(tmp_path / "2023-03-17-15-53-02_1_0", toy_frame(0))
    (drive,) = list_drives(tmp_path)
    for cloud in sorted(drive.glob("*/*.pcd")):
        cloud.with_suffix(".bin").write_bytes(np.zeros((5, 4), np.float32).tobytes())
        cloud.unlink()
    with pytest.raises(
        DataError, match=r"2023-03-17-15-53-02_1_0: annotations with clouds in \.bin, as V2X-Real has them"
    ):
        open_drive(drive)


def test_a_folder_without_drives_names_the_formats(tmp_path: Path) -> None:
    with pytest.raises(
        DataError,
        match=r"expected an OPV2V tree .*, a DAIR-V2X-C one .*, or sweeps: .* scans \(\.bin, \.pcd, \.ply, \.npy\)",
    ):
        list_drives(tmp_path)
    with pytest.raises(DataError, match="nowhere: no such folder"):
        list_drives(tmp_path / "nowhere")
    with pytest.raises(DataError, match="nowhere"):
        open_drive(tmp_path / "nowhere")


def test_drives_of_one_scenario_and_seed_show_one_run_of_traffic(tmp_path: Path) -> None:
    made = {
        "left_turn_1_vlp-32c": ("left_turn", 1),
        "left_turn_1_hdl-64e": ("left_turn", 1),
        "left_turn_2": ("left_turn", 2),
    }
    for name, (scenario, seed) in made.items():
        write_frame(tmp_path / name, toy_frame(0))
        protocol = {"world": {"seed": seed}, "testbed": {"scenario": {"name": scenario}}}
        (tmp_path / name / "data_protocol.yaml").write_text(yaml.safe_dump(protocol))
    foreign = {"foreign_1": "world: {}", "foreign_2": "world: {seed: 1}", "foreign_3": "world: {seed: 1}"}
    for name, text in foreign.items():
        write_frame(tmp_path / name, toy_frame(0))
        (tmp_path / name / "data_protocol.yaml").write_text(text)
    # By name: three foreign ones, then the turns.
    assert traffic_runs(open_drives(tmp_path)) == (0, 1, 2, 3, 3, 4)
