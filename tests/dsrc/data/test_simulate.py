"""The whole way from a shipped scenario to files, with the smallest sensor."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest

from dsrc.data.checksums import faulty_files
from dsrc.data.datasets.spec import log_settings
from dsrc.data.formats.opv2v.reader import DriveReader
from dsrc.data.formats.yaml import read_yaml
from dsrc.data.sample import SampleRequest, make_sample
from dsrc.data.write import generate
from dsrc.ops.grid import GridSpec
from sensors.recording.record import record
from sim.catalog.load import load_scenario
from sim.errors import DataError, SettingsError
from sim.scenario import Scenario
from sim.traffic.log import TrafficLog
from sim.traffic.open import open_traffic
from sim.world.world_file import load_world
from tests.dsrc.data.toy import same_frames
from tests.paths import ROOT

FRAMES = 3


def quick() -> Scenario:
    """The made junction with a short warm-up and the debugging sensor everywhere."""
    scenario = load_scenario("four_way")
    units = tuple(msgspec.structs.replace(u, lidar="debug-16") for u in scenario.agents.roadside)
    agents = msgspec.structs.replace(scenario.agents, vehicles=2, lidar="debug-16", roadside=units)
    return msgspec.structs.replace(scenario, agents=agents, warmup_s=30.0)


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return generate(quick(), tmp_path_factory.mktemp("train"), FRAMES, seed=5, interval_s=0.2)


def test_a_drive_is_named_by_scenario_and_seed_and_complete(drive: Path) -> None:
    reader = DriveReader(drive)
    assert drive.name == "four_way_5" and reader.frames == (0, 1, 2)
    assert len(reader.agents) == 3 and reader.agents[-1] == -1
    frames = [reader.read(i) for i in range(FRAMES)]
    assert [f.time_s - frames[0].time_s for f in frames] == pytest.approx([0.0, 0.2, 0.4])
    assert all(len(a.sweep) > 500 for f in frames for a in f.agents)
    assert all(f.points_on.any() for f in frames)


def test_a_generated_frame_makes_a_sample(drive: Path) -> None:
    sample = make_sample(DriveReader(drive).read(0), None, SampleRequest(GridSpec(), comm_range_m=200.0))
    assert len(sample.clouds) == 3 and all(len(c) for c in sample.clouds)


def test_the_truth_explains_who_sees_what(drive: Path) -> None:
    """Lanes, lights, accelerations and visible fractions come back from the files of a drive."""
    frames = [DriveReader(drive).read(i) for i in range(FRAMES)]
    for frame in frames:
        vehicles = frame.truth.is_vehicle
        assert all(lane for lane, is_vehicle in zip(frame.lane, vehicles, strict=True) if is_vehicle)
        assert np.isfinite(frame.acceleration).all()
        share, points = frame.visible_fraction, frame.points_on
        assert np.nanmin(share) >= 0.0 and np.nanmax(share) <= 1.0
        assert (share[points >= 10] > 0.0).all()
        assert (points[share == 0.0] < 3).all()  # points of a ray's jitter
    assert max(np.abs(frame.acceleration).max() for frame in frames) > 0.5


def test_a_drive_says_whether_it_lists_connected_vehicles_and_measures_visibility(tmp_path: Path) -> None:
    drive = generate(quick(), tmp_path, 1, seed=5, connected_vehicles=False, visibility=False)
    reader = DriveReader(drive)
    assert reader.protocol["testbed"]["connected_vehicles"] is False
    assert reader.protocol["testbed"]["visibility"] is False
    assert np.isnan(reader.read(0).visible_fraction).all()
    listed = [set(read_yaml(path)["vehicles"] or {}) for path in drive.glob("*/000000.yaml")]
    assert len(listed) == 3 and not set().union(*listed) & set(reader.agents)


def test_points_on_actors_lie_in_their_boxes(drive: Path) -> None:
    frame = DriveReader(drive).read(1)
    for agent in frame.agents:
        on = agent.sweep.object_id >= 0
        boxes = frame.truth
        inside = boxes.contains(agent.sweep.world_points[on], margin=0.8).any(axis=0)
        assert inside.mean() > 0.99


def test_a_killed_generate_resumes_to_the_same_bytes(drive: Path, tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from dsrc.data.write import generate;"
        "from tests.dsrc.data.test_simulate import quick;"
        "generate(quick(), Path(sys.argv[1]), 3, seed=5, interval_s=0.2)"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    process = subprocess.Popen(command, cwd=ROOT)
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob("*/*/000001.*")) and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    process.wait()
    killed = tmp_path / "four_way_5"
    assert tree(killed) != tree(drive)
    subprocess.run(command, cwd=ROOT, check=True)
    assert tree(killed) == tree(drive)


def test_a_generated_drive_has_the_paths_of_its_sensors(drive: Path) -> None:
    middle, raw = (DriveReader(drive, motion).read(1) for motion in ("middle", "raw"))
    fast = max(middle.agents, key=lambda agent: agent.speed)
    assert fast.speed > 3.0
    bent, straight = raw.agent(fast.agent_id).sweep, fast.sweep
    np.testing.assert_allclose(bent.world_points, straight.world_points, atol=2e-5)
    # The first and the last column are half a sweep away from the middle.
    moved = np.linalg.norm(bent.points - straight.points, axis=1).max()
    assert 0.4 * 0.1 * fast.speed < moved
    np.testing.assert_allclose(raw.agents[-1].sweep.points, middle.agents[-1].sweep.points, atol=1e-6)


def test_the_files_of_a_drive_give_the_frames_of_the_simulation_itself(drive: Path) -> None:
    """SUMO's own numbers, rounded as they are recorded, and the world of the file."""
    scenario, world = quick(), load_world(drive / "world.npz")
    with open_traffic(scenario, 5) as traffic:
        recording = record(traffic, world.static, scenario, 5, FRAMES, 0.2, body_mesh=world.body_mesh)
    assert same_frames(recording.frame(1), DriveReader(drive).read(1))


@pytest.mark.slow
def test_a_drive_is_made_again_from_its_log_and_its_world_alone(drive: Path, tmp_path: Path) -> None:
    """In a process that can import neither SUMO nor its maps."""
    code = (
        "import sys; sys.modules.update(dict.fromkeys(('libsumo', 'sumo', 'sumolib', 'traci')))\n"
        "import msgspec; from pathlib import Path; from dsrc.data.write import DriveSpec, make_drive\n"
        "from sim.scenario import Scenario\n"
        "spec = DriveSpec(msgspec.json.decode(sys.argv[1], type=Scenario), 5, 3, interval_s=0.2)\n"
        "make_drive(spec, Path(sys.argv[2]), recorded=Path(sys.argv[3]))"
    )
    scenario = msgspec.json.encode(quick()).decode()
    subprocess.run([sys.executable, "-c", code, scenario, str(tmp_path / "again"), str(drive)], cwd=ROOT, check=True)
    assert tree(tmp_path / "again") == tree(drive)


def test_a_log_has_its_scenario_without_defaults(drive: Path) -> None:
    scenario, about = log_settings(drive / "traffic.npz")
    assert scenario == quick() and about == {"seed": 5, "frames": FRAMES, "interval_s": 0.2}
    told = TrafficLog.load(drive / "traffic.npz").about["scenario"]
    assert "conflict" not in told and "shipped" not in told["network"] and told["agents"]["lidar"] == "debug-16"


def test_the_checksums_beside_a_drive_are_those_of_its_files(drive: Path) -> None:
    done = subprocess.run(["sha256sum", "--check", "--strict", "SHA256SUMS"], cwd=drive, capture_output=True, text=True)
    assert done.returncode == 0 and len(done.stdout.splitlines()) == 3 * 3 * 2 + 3
    assert not list(faulty_files(drive))


def test_another_seed_or_interval_never_mixes_into_a_drive(drive: Path) -> None:
    with pytest.raises(DataError, match=r"interval_s: expected 0.1 as asked for now, found 0.2"):
        generate(quick(), drive.parent, FRAMES, seed=5, interval_s=0.1)
    with pytest.raises(DataError, match=r"motion: expected 'end' as asked for now, found middle"):
        generate(quick(), drive.parent, FRAMES, seed=5, interval_s=0.2, motion="end")
    other = msgspec.structs.replace(quick(), warmup_s=31.0)
    with pytest.raises(DataError, match=r"scenario.warmup_s: expected 31.0 as asked for now, found 30.0"):
        generate(other, drive.parent, FRAMES, seed=5, interval_s=0.2)


def test_settings_out_of_range_are_refused_before_anything_is_made(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="frames: expected at least 1, found 0"):
        generate(quick(), tmp_path, 0)
    with pytest.raises(SettingsError, match="interval_s: expected a positive multiple"):
        generate(quick(), tmp_path, 1, interval_s=0.07)
    with pytest.raises(SettingsError, match="motion: expected a compensation, found stat; did you mean 'start'"):
        generate(quick(), tmp_path, 1, motion="stat")  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())
