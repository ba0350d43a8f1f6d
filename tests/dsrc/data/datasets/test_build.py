"""Datasets: the same bytes for any workers and interruptions, and never two processes in one folder."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from dsrc.data.checksums import CHECKSUMS
from dsrc.data.datasets import build
from dsrc.data.datasets.build import generate_dataset, record_dataset
from dsrc.data.datasets.manifest import MANIFEST, read_manifest
from dsrc.data.datasets.spec import expand, find_split_file, read_dataset
from dsrc.runs.executors import Pool
from dsrc.runs.lock import locked
from sim.catalog.load import ROOT as SCENARIOS
from sim.errors import DataError, ScenarioError, SettingsError, UserError
from sim.files import file_sha256
from tests.paths import ROOT

SMALL = """
name = "small"
[[split.train]]
scenarios = ["quick.toml"]
seeds = [0, 1]
frames = [2]
vehicles = [2]
lidars = ["debug-16"]
roadside = false
[[split.test]]
scenarios = ["quick.toml"]
seeds = [2]
frames = [3]
vehicles = [2]
lidars = ["debug-16"]
roadside = false
"""


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def write(folder: Path, text: str = SMALL) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    shipped = (SCENARIOS / "four_way" / "scenario.toml").read_text()
    (folder / "quick.toml").write_text(shipped.replace("warmup_s = 60.0", "warmup_s = 20.0"))
    (folder / "split.toml").write_text(text)
    return folder / "split.toml"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small dataset, made by this process."""
    folder = tmp_path_factory.mktemp("small")
    return generate_dataset(write(folder), folder / "out", pool=Pool(1))


def test_a_dataset_has_its_splits_its_manifest_and_its_cards(made: Path) -> None:
    assert sorted(p.name for p in made.iterdir()) == [MANIFEST, "test", "test.card", "train", "train.card"]
    assert sorted(p.name for p in (made / "train").iterdir()) == ["quick_0", "quick_1"]
    manifest = read_manifest(made)
    assert manifest is not None and manifest.name == "small" and manifest.drives == 3 and not manifest.failed
    assert [entry.drive.split("/")[0] for entry in manifest.items] == ["train", "train", "test"]
    for entry in manifest.items:
        assert entry.sha256 == file_sha256(made / entry.drive / CHECKSUMS)
        assert len(entry.agents) == 2 and entry.lidars == ("debug-16", "debug-16")
    assert len({entry.key for entry in manifest.items}) == 3


@pytest.mark.slow
def test_two_workers_write_the_same_bytes_as_one(made: Path, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    generate_dataset(write(tmp_path), tmp_path / "out", pool=Pool(2), progress=lambda *p: seen.append(p))
    assert tree(tmp_path / "out") == tree(made)
    assert seen[-1] == (7, 7) and seen == sorted(seen)


def test_a_finished_dataset_is_left_alone_and_a_lost_file_is_made_again(made: Path) -> None:
    before = tree(made)
    lost = next((made / "train").glob("*/*/000001.pcd"))
    when = {path: path.stat().st_mtime_ns for path in made.rglob("*.pcd")}
    lost.unlink()
    generate_dataset(made.parent / "split.toml", made, pool=Pool(1))
    assert tree(made) == before
    again = {path: path.stat().st_mtime_ns for path in made.rglob("*.pcd")}
    assert {path for path in when if again[path] != when[path]} <= set(lost.parent.parent.glob("*/000001.pcd"))


@pytest.mark.slow
def test_one_split_alone_leaves_the_entries_of_the_others(made: Path, tmp_path: Path) -> None:
    for split in ("test", "train"):
        generate_dataset(write(tmp_path), tmp_path / "out", splits=(split,), pool=Pool(1))
    assert tree(tmp_path / "out") == tree(made)
    with pytest.raises(SettingsError, match="expected a split of small, found tost; did you mean 'test'"):
        generate_dataset(tmp_path / "split.toml", tmp_path / "out", splits=("tost",), pool=Pool(1))


def start(source: Path, out: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "dsrc", "dataset", "build", str(source), "--out", str(out), "--workers", "2"]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def wait_for(found: Iterator[object], process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + 120
    while next(found) is None and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)


def first(out: Path, pattern: str) -> Iterator[Path | None]:
    while True:
        yield next(out.glob(pattern), None)


@pytest.mark.slow
def test_a_killed_driver_loses_nothing(made: Path, tmp_path: Path) -> None:
    process = start(write(tmp_path), tmp_path / "out")
    wait_for(first(tmp_path / "out", "*/*/*/000000.pcd"), process)
    process.kill()
    process.wait()
    assert process.stderr is not None
    process.stderr.close()
    assert tree(tmp_path / "out") != tree(made)
    generate_dataset(tmp_path / "split.toml", tmp_path / "out", pool=Pool(1))
    assert tree(tmp_path / "out") == tree(made)


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="finds the workers in /proc")
@pytest.mark.slow
def test_a_killed_worker_is_replaced(made: Path, tmp_path: Path) -> None:
    process = start(write(tmp_path), tmp_path / "out")
    wait_for(first(tmp_path / "out", "*/*/*/000000.pcd"), process)
    lock = next((tmp_path / "out").glob("*/*/.lock"))
    worker = int(lock.read_text())
    assert worker != process.pid
    os.kill(worker, signal.SIGKILL)
    assert process.wait(timeout=200) == 0, process.communicate()[1]
    assert process.stderr is not None
    process.stderr.close()
    assert tree(tmp_path / "out") == tree(made)


def test_two_drivers_never_write_one_dataset(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with locked(tmp_path / "out"), pytest.raises(DataError, match=f"process {os.getpid()} is writing this dataset"):
        generate_dataset(write(tmp_path), tmp_path / "out", pool=Pool(1))


def test_other_settings_or_another_dataset_are_refused_before_anything_is_made(made: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"manifest.json: name: expected 'other' as asked for now, found small"):
        generate_dataset(write(tmp_path, SMALL.replace('"small"', '"other"')), made, pool=Pool(1))
    with pytest.raises(DataError, match=r"quick_0/data_protocol.yaml: frames: expected 4"):
        generate_dataset(write(tmp_path, SMALL.replace("[2]\nv", "[4]\nv", 1)), made, pool=Pool(1))


def test_a_failed_drive_is_named_and_the_others_are_made(tmp_path: Path) -> None:
    wrong = SMALL.replace("vehicles = [2]", "vehicles = [300]", 1)
    with pytest.raises(DataError, match=r"train/quick_0: .*expected 300 cars.*\(2 of 3 drives"):
        generate_dataset(write(tmp_path, wrong), tmp_path / "out", pool=Pool(1), cards=False)
    manifest = read_manifest(tmp_path / "out")
    assert manifest is not None and list(manifest.failed) == [f"train/quick_{k}" for k in (0, 1)]
    assert [entry.drive for entry in manifest.items] == ["test/quick_2"]
    # Another split alone leaves what is known of the failed drives.
    generate_dataset(tmp_path / "split.toml", tmp_path / "out", splits=("test",), pool=Pool(1), cards=False)
    assert read_manifest(tmp_path / "out") == manifest


@pytest.mark.slow
def test_recordings_are_not_replaced_by_drives_nor_by_a_simulation_that_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    two = 'recorded = "recorded"\n' + SMALL.replace("seeds = [0, 1]", "seeds = [0]")
    source = write(tmp_path, two)
    record_dataset(source)
    before = tree(tmp_path / "recorded")
    assert len(before) == 4
    with pytest.raises(SettingsError, match="out: expected a folder apart from the recordings"):
        generate_dataset(source, tmp_path / "recorded", cards=False)
    assert tree(tmp_path / "recorded") == before
    with pytest.raises(SettingsError, match=r"world: expected 1, on whose ground .*quick_0 was recorded, found 2"):
        generate_dataset(write(tmp_path, two.replace("seeds = [0]", "seeds = [0]\nworld = 2")), tmp_path / "out")
    with pytest.raises(SettingsError, match=r"parked_per_km: expected 0, as .*quick_0 was recorded, found 50"):
        generate_dataset(
            write(tmp_path, two.replace("seeds = [0]", "seeds = [0]\nparked_per_km = 50.0")), tmp_path / "out"
        )
    write(tmp_path, two)
    killed = next(path for path in (tmp_path / "recorded").rglob("*.npz")).parent / ".recording-killed"
    killed.mkdir()
    (killed / "traffic.npz").write_bytes(b"half")
    record_dataset(source)
    assert tree(tmp_path / "recorded") == before and not killed.exists()

    def failing(*args: object, **named: object) -> None:
        raise DataError("no simulation")

    monkeypatch.setattr(build, "open_simulated", failing)
    with pytest.raises(DataError, match="no simulation"):
        record_dataset(source)
    assert tree(tmp_path / "recorded") == before


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "seeds = [0, 1]",
            "seed = [0, 1]",
            r"split.toml: split.train\[0\]: expected known keys only, found key 'seed'; did",
        ),
        ("seeds = [0, 1]", "seeds = []", r"split.toml: split.train\[0\].seeds: expected array of length >= 1"),
        ("seeds = [0, 1]", "seeds = [0, -1]", r"split.toml: split.train\[0\].seeds\[1\]: expected int >= 0"),
        ("frames = [2]", 'frames = "many"', r"split.toml: split.train\[0\].frames: expected array, found many"),
        ("frames = [2]", "frames = [9000]", r"split.train\[0\]: frames: expected a drive of at most"),
        ('"debug-16"', '"debug-61"', r"agents.lidar: expected a LiDAR preset, found debug-61; did"),
        ("quick.toml", "lta_truck", r"split.train\[0\]: vehicles: expected none, as lta_truck names who .*, found 2"),
        (
            "quick.toml",
            "four_wya",
            r"split.train\[0\]: scenarios: unknown scenario 'four_wya'; did you mean 'four_way'",
        ),
        (
            "seeds = [2]",
            "seeds = [1]",
            r"split.test\[0\]: seeds: expected seeds that only test has.*which train has too",
        ),
        ("seeds = [0, 1]", "seeds = [0, 0]", r"split.train\[0\]: seeds: expected drives of different names"),
        ('name = "small"', "name = 3", r"split.toml: name: expected str, found 3"),
        ('name = "small"', "name = ", r"split.toml: not a readable TOML file"),
    ],
)
def test_a_wrong_toml_is_named_by_file_and_field(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = write(tmp_path, SMALL.replace(old, new, 1))
    with pytest.raises(UserError, match=message) as caught:
        expand(read_dataset(path), path)
    assert "\n" not in str(caught.value)


def test_lists_multiply_and_their_values_are_in_the_names(tmp_path: Path) -> None:
    path = write(tmp_path, SMALL.replace("vehicles = [2]", "vehicles = [2, 3]", 1))
    items = expand(read_dataset(path), path)
    assert [item.name for item in items[:4]] == [f"quick_{s}_{v}v" for s in (0, 1) for v in (2, 3)]
    assert [item.spec.scenario.agents.vehicles for item in items[:4]] == [2, 3, 2, 3]
    assert len({item.key for item in items}) == 5


def test_a_dataset_is_distinguished_from_a_scenario(tmp_path: Path) -> None:
    path = write(tmp_path)
    assert find_split_file(path) == path and find_split_file(tmp_path) == path
    assert find_split_file("dsrc-sim") is not None
    assert find_split_file("four_way") is None and find_split_file(tmp_path / "none.toml") is None
    with pytest.raises(ScenarioError, match="no_such"):
        expand(read_dataset(write(tmp_path, SMALL.replace("quick.toml", "no_such"))), path)


def test_the_manifest_of_a_stranger_is_no_stack_trace(tmp_path: Path) -> None:
    (tmp_path / MANIFEST).write_text(json.dumps({"version": 1, "items": 3}))
    with pytest.raises(DataError, match=f"{MANIFEST}: "):
        read_manifest(tmp_path)


@pytest.mark.slow
def test_two_workers_of_ray_write_the_same_bytes_as_one_process(made: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="the package ray is not installed: pip install ray")
    write(tmp_path)
    command = [sys.executable, "-m", "dsrc", "dataset", "build", "split.toml", "--out", "out", "--executor", "ray"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([*command, "--workers", "2"], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert tree(tmp_path / "out") == tree(made)
