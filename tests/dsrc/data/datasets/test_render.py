"""dsrc dataset render: the same traffic seen by others, in a process that has neither SUMO nor highway-env."""

import shutil
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from dsrc.data.datasets.render import render
from dsrc.data.formats.opv2v.reader import DriveReader
from dsrc.data.write import DriveSpec, make_drive
from dsrc.options.drives import Changes
from dsrc.runs.executors import Pool
from sim.catalog.load import load_scenario
from sim.errors import DataError, ScenarioError, SettingsError
from sim.scenario import Scenario
from tests.paths import ROOT


def quick() -> Scenario:
    scenario = load_scenario("four_way")
    units = tuple(msgspec.structs.replace(unit, lidar="debug-16") for unit in scenario.agents.roadside)
    agents = msgspec.structs.replace(scenario.agents, vehicles=2, lidar="debug-16", roadside=units)
    return msgspec.structs.replace(scenario, agents=agents, warmup_s=20.0)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drives") / "four_way_5"
    make_drive(DriveSpec(quick(), 5, 2), folder)
    return folder


def frames_of(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.glob("*/*")) if p.is_file()}


@pytest.mark.slow
def test_without_changes_every_frame_is_the_same_without_sumo(drive: Path, tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules.update(dict.fromkeys(('libsumo', 'sumo', 'sumolib', 'traci', 'highway_env')))\n"
        "from dsrc.__main__ import main; main(sys.argv[1:])"
    )
    command = [sys.executable, "-c", code, "dataset", "render", str(drive), "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert frames_of(tmp_path / "four_way_5") == frames_of(drive)


def test_another_lidar_sees_the_same_traffic(drive: Path, tmp_path: Path) -> None:
    (made,) = render(drive / "traffic.npz", tmp_path, Changes(lidar="vlp-16", roadside=False, frames=1))
    frame, before = DriveReader(made).read(0), DriveReader(drive).read(0)
    assert [agent.sweep.spec.name for agent in frame.agents if agent.sweep.spec] == ["vlp-16", "vlp-16"]
    assert {agent.agent_id for agent in frame.agents} == {agent.agent_id for agent in before.agents} - {-1}
    row = np.isin(before.truth.object_id, frame.truth.object_id)
    np.testing.assert_array_equal(frame.truth.array, before.truth.array[row])
    assert len(frame.agents[0].sweep) > 2 * len(before.agents[0].sweep)


def test_agents_are_chosen_by_id_and_sensors_by_mounting(drive: Path, tmp_path: Path) -> None:
    before = DriveReader(drive).read(0)
    others = before.truth.object_id[
        before.truth.is_vehicle & ~np.isin(before.truth.object_id, DriveReader(drive).agents)
    ]
    changes = Changes(agent_id=(int(others[0]),), mount=(1.5, 0.0, 0.6, 5.0), frames=1)
    (made,) = render(drive, tmp_path, changes)
    frame = DriveReader(made).read(0)
    assert [agent.agent_id for agent in frame.agents] == [int(others[0]), -1]
    pose = np.linalg.inv(frame.agents[0].world_from_body) @ frame.agents[0].sweep.world_from_lidar
    np.testing.assert_allclose(pose[:3, 3], [1.5, 0.0, 0.6], atol=1e-6)
    assert np.degrees(np.arcsin(-pose[2, 0])) == pytest.approx(5.0)
    assert render(drive, tmp_path, changes) == [made]  # finished, left alone
    with pytest.raises(DataError, match="expected"):
        render(drive, tmp_path, Changes(vehicles=1, frames=1))


@pytest.mark.slow
def test_a_folder_of_drives_keeps_its_names_and_bytes_with_two_workers(drive: Path, tmp_path: Path) -> None:
    source = tmp_path / "data"
    for split in ("train", "test"):
        shutil.copytree(drive, source / split / "four_way_5")
    seen: list[tuple[int, int]] = []
    changes = Changes(vehicles=1, roadside=False, frames=1)
    made = render(source, tmp_path / "out", changes, Pool(2), lambda *p: seen.append(p))
    assert made == [tmp_path / "out" / split / "four_way_5" for split in ("test", "train")]
    assert seen[-1] == (2, 2)
    (alone,) = render(drive, tmp_path / "alone", changes)
    assert frames_of(made[0]) == frames_of(made[1]) == frames_of(alone)


def test_impossible_changes_are_named(drive: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"two folders below, found none; no such folder"):
        render(tmp_path / "none", tmp_path / "out", Changes())
    with pytest.raises(SettingsError, match="agent_id: expected ids of road users in the first frame, found 7"):
        render(drive, tmp_path / "out", Changes(agent_id=(7,)))
    with pytest.raises(SettingsError, match="leave out --vehicles"):
        render(drive, tmp_path / "out", Changes(agent_id=(1000,), vehicles=2))
    with pytest.raises(SettingsError, match="frames: expected at most 2, as recorded, found 3"):
        render(drive, tmp_path / "out", Changes(frames=3))
    with pytest.raises(ScenarioError, match=r"agents\.lidar: expected a LiDAR preset, found vlp16; did"):
        render(drive, tmp_path / "out", Changes(lidar="vlp16"))
    with pytest.raises(SettingsError, match="mount_pitch_deg"):
        render(drive, tmp_path / "out", Changes(mount=(0.0, 0.0, 1.0, 200.0)))
    with pytest.raises(SettingsError, match="a place apart from the input"):
        render(drive, drive.parent, Changes())
    assert not (tmp_path / "out").exists()
