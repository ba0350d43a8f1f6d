"""Corrupted datasets: the same bytes however they are made, and nothing but the sweeps changed."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from dsrc.data.datasets.convert import convert
from dsrc.data.datasets.corrupt import corrupt_dataset
from dsrc.data.drive_folder import read_settings
from dsrc.data.drives import list_drives, open_drives
from dsrc.data.formats.opv2v.reader import DriveReader
from dsrc.data.formats.opv2v.record import read_plan
from dsrc.data.write import write_drive
from dsrc.runs.executors import Pool
from dsrc.runs.lock import LOCK, locked
from dsrc.runs.study import reused
from sensors.corruptions import corrupt_frame, drive_seed
from sim.errors import DataError, SettingsError
from tests.dsrc.data import dair_tree
from tests.dsrc.data.toy import SETTINGS, ToySource, same_frames
from tests.paths import ROOT


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A split of two drives."""
    for name in ("one", "two"):
        write_drive(tmp_path / "data" / name, SETTINGS, ToySource().open)
    return tmp_path / "data"


@pytest.fixture
def foreign(data: Path) -> Path:
    """The same as another tool would have written it: no record, no protocol."""
    for path in data.rglob("*.yaml"):
        text = path.read_text()
        path.write_text(text.partition("\n")[2]) if text.startswith("testbed") else path.unlink()
    return data


def test_every_frame_is_that_of_corrupt_frame_with_the_seed_of_its_drive(data: Path, tmp_path: Path) -> None:
    drives = corrupt_dataset(data, tmp_path / "out", "motion_blur", severity=4, seed=5)
    assert drives == [tmp_path / "out" / "one", tmp_path / "out" / "two"] == list_drives(tmp_path / "out")
    for drive in drives:
        source, out = DriveReader(data / drive.name), DriveReader(drive)
        seed = drive_seed(5, drive.name)
        for i in range(5):
            assert same_frames(out.read(i), corrupt_frame(source.read(i), "motion_blur", 4, seed))


def test_a_compact_drive_is_corrupted_as_its_twin_and_stays_compact(data: Path, tmp_path: Path) -> None:
    compact = convert(data, tmp_path / "compact", "compact")
    one = corrupt_dataset(data, tmp_path / "a", "motion_blur", severity=4)
    two = corrupt_dataset(compact, tmp_path / "b", "motion_blur", severity=4)
    for plain, packed in zip(one, two, strict=True):
        assert len(list(packed.glob("*/*.compact"))) == 15 and not list(packed.glob("*/*.pcd"))
        assert all(same_frames(DriveReader(plain).read(i), DriveReader(packed).read(i)) for i in range(5))
    before, source = tree(tmp_path / "b"), tmp_path / "b/one/1000/000003.compact"
    source.unlink()
    corrupt_dataset(compact, tmp_path / "b", "motion_blur", severity=4)
    assert tree(tmp_path / "b") == before


def test_settings_of_the_severity_can_be_changed(data: Path, tmp_path: Path) -> None:
    (one, _) = corrupt_dataset(data, tmp_path / "out", "beam_missing", severity=1, set=("rings_of_64=20",))
    (five, _) = corrupt_dataset(data, tmp_path / "five", "beam_missing", severity=5)
    settings = [read_settings(drive)["corruptions"][-1]["settings"] for drive in (one, five)]
    assert settings[0] == {**settings[1], "rings_of_64": 20}
    for wrong, said in (("rings=3", "rings_of_64"), ("rings_of_64=many", "set"), ("rings_of_64=99", "0 to 64")):
        with pytest.raises(SettingsError, match=said):
            corrupt_dataset(data, tmp_path / "wrong", "beam_missing", set=(wrong,))
    assert not (tmp_path / "wrong").exists()


@pytest.mark.slow
def test_the_papers_snow_takes_its_sensors_calibration_from_the_command_line(data: Path, tmp_path: Path) -> None:
    focus = tmp_path / "hdl64.npz"
    np.savez(focus, focal_distance_m=np.full(64, 10.0), focal_slope=np.ones(64), min_intensity=np.zeros(64))
    words = {"family": "paper", "set": (f"calibration={focus}",)}
    (with_it, _) = corrupt_dataset(data, tmp_path / "with", "snow", **words)
    (without, _) = corrupt_dataset(data, tmp_path / "without", "snow", family="paper")
    points = [sum(len(a.sweep) for a in DriveReader(d).read(0).agents) for d in (with_it, without)]
    assert points[0] != points[1]


def test_only_the_agents_asked_for_are_corrupted(data: Path, tmp_path: Path) -> None:
    for who, changed in (("ego", {1000}), ("helpers", {1002, -1}), ("1002", {1002})):
        (drive, _) = corrupt_dataset(data, tmp_path / who, "beam_missing", severity=5, corrupted_agents=who)
        pairs = zip(DriveReader(data / "one").read(2).agents, DriveReader(drive).read(2).agents, strict=True)
        assert {a.agent_id for a, b in pairs if len(b.sweep) < len(a.sweep)} == changed
        assert DriveReader(drive).protocol["testbed"]["corruptions"][0]["who"] == who
    with pytest.raises(DataError, match=r"one: frame 0: corrupted_agents: expected ids among the agents .*, found 7"):
        corrupt_dataset(data, tmp_path / "none", "beam_missing", corrupted_agents="7")
    with pytest.raises(SettingsError, match="corrupted_agents: expected helpers"):
        corrupt_dataset(data, tmp_path / "none", "pose_error", corrupted_agents="ego")


def test_any_number_of_workers_writes_the_same_bytes(data: Path, tmp_path: Path) -> None:
    for workers in (1, 2):
        corrupt_dataset(data, tmp_path / str(workers), "fog", pool=Pool(workers))
    assert tree(tmp_path / "1") == tree(tmp_path / "2")


def test_lost_points_are_stored(data: Path, tmp_path: Path) -> None:
    (drive, _) = corrupt_dataset(data, tmp_path / "out", "beam_missing", severity=5)
    for before, after in zip(DriveReader(data / "one").read(2).agents, DriveReader(drive).read(2).agents, strict=True):
        assert after.sweep.lost == len(before.sweep) - len(after.sweep) > 0


def test_the_protocol_has_source_and_corruptions(data: Path, tmp_path: Path) -> None:
    (drive, _) = corrupt_dataset(data, tmp_path / "out", "crosstalk", severity=2, seed=9)
    (again, _) = corrupt_dataset(tmp_path / "out", tmp_path / "both", "beam_missing", severity=1)
    own = DriveReader(again).protocol["testbed"]
    first, second = own["corruptions"]
    assert (first["kind"], first["severity"], first["family"], first["seed"]) == ("crosstalk", 2, "physical", 9)
    assert first["settings"] and first["source"]["drive"] == "one" and len(first["source"]["sha256"]) == 64
    assert second["kind"] == "beam_missing"
    assert {k: v for k, v in own.items() if k in SETTINGS} == SETTINGS and sorted(own["agents"]) == [-1, 1000, 1002]
    assert len(DriveReader(drive).protocol["testbed"]["corruptions"]) == 1


def test_truth_plans_and_the_list_of_vehicles_stay(data: Path, tmp_path: Path) -> None:
    (drive, _) = corrupt_dataset(data, tmp_path / "out", "beam_missing", severity=5)
    before, after = (DriveReader(d).read(3) for d in (data / "one", drive))
    np.testing.assert_array_equal(before.truth.array, after.truth.array)
    np.testing.assert_array_equal(before.points_on, after.points_on)
    old, new = ((d / "1000" / "000003.yaml") for d in (data / "one", drive))
    np.testing.assert_allclose(read_plan(new), [[1.0, 2.0, 6.0]])
    assert old.read_text().partition("vehicles:")[2] == new.read_text().partition("vehicles:")[2]


def test_one_drive_becomes_one_drive(data: Path, tmp_path: Path) -> None:
    assert corrupt_dataset(data / "two", tmp_path / "foggy", "beam_missing") == [tmp_path / "foggy"]
    corrupt_dataset(data, tmp_path / "all", "beam_missing")
    assert tree(tmp_path / "foggy") == tree(tmp_path / "all" / "two")


def test_trees_of_other_tools_can_be_corrupted(foreign: Path, tmp_path: Path) -> None:
    (drive, _) = corrupt_dataset(foreign, tmp_path / "out", "motion_blur")
    before, after = (DriveReader(d).read(1) for d in (foreign / "one", drive))
    assert [a.agent_id for a in after.agents] == [1000, 1002, -1]
    np.testing.assert_allclose(before.truth.array, after.truth.array)
    assert after.agents[0].sweep.fate.all() and before.time_s == after.time_s
    assert DriveReader(drive).protocol["testbed"]["frames"] == 5


def test_a_split_of_a_dair_tree_is_no_folder_and_can_be_corrupted(tmp_path: Path) -> None:
    root = dair_tree.make(tmp_path)
    made = corrupt_dataset(root / "val", tmp_path / "out", "motion_blur")
    assert made == [tmp_path / "out" / drive.name for drive in list_drives(root / "val")]


def test_a_batch_may_be_named_beside_the_tree_that_a_download_has(tmp_path: Path) -> None:
    dair_tree.make(tmp_path / "download")
    assert corrupt_dataset(tmp_path / "download" / "12", tmp_path / "out", "motion_blur") == [tmp_path / "out"]
    assert len(open_drives(tmp_path / "out")) == 1


def test_a_finished_run_is_left_alone_and_only_missing_frames_are_made(data: Path, tmp_path: Path) -> None:
    out, seen = tmp_path / "out", []
    (drive, _) = corrupt_dataset(data, out, "beam_missing")
    before, times = tree(out), {p: p.stat().st_mtime_ns for p in out.rglob("*.pcd")}
    (drive / "1002" / "000003.yaml").unlink()
    (drive / "1000" / ".000004.pcd.0123abcd.tmp").write_bytes(b"half")
    corrupt_dataset(data, out, "beam_missing", progress=lambda done, total: seen.append((done, total)))
    assert tree(out) == before
    changed = sorted(p.relative_to(drive).as_posix() for p, t in times.items() if p.stat().st_mtime_ns != t)
    assert changed == ["-1/000003.pcd", "1000/000003.pcd", "1002/000003.pcd"]
    assert seen == [(4, 10), (5, 10), (10, 10)]


@pytest.mark.parametrize(
    ("change", "field"),
    [({"severity": 4}, "severity"), ({"seed": 1}, "seed"), ({"corruption": "crosstalk"}, "kind")],
)
def test_a_folder_of_other_settings_is_refused_by_name(data: Path, tmp_path: Path, change: dict, field: str) -> None:
    settings = {"corruption": "beam_missing", "severity": 3, "seed": 0}
    corrupt_dataset(data, tmp_path / "out", **settings)
    with pytest.raises(DataError, match=rf"data_protocol.yaml: corruptions\[0\].{field}: expected"):
        corrupt_dataset(data, tmp_path / "out", **{**settings, **change})


def test_a_run_that_other_code_began_goes_on_only_when_asked(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    corrupt_dataset(data, out, "beam_missing", severity=5)
    before, (code, _) = tree(out), [read_settings(out / name)["corruptions"][0]["code"] for name in ("one", "two")]
    (out / "one/1000/000003.yaml").unlink()
    monkeypatch.setattr("dsrc.data.datasets.corrupt.code_hash", lambda entry: "0" * 64)
    for given in ((), (tmp_path / "nowhere",)):
        with pytest.raises(DataError, match=r"corruptions\[0\].code: expected '0000.*--reuse|nowhere: reuse: expected"):
            corrupt_dataset(data, out, "beam_missing", severity=5, reuse=given)
    with pytest.raises(DataError, match=r"corruptions\[0\].severity: expected 4"):
        corrupt_dataset(data, out, "beam_missing", severity=4, reuse=(out,))
    for place in (out, tmp_path / "anew"):
        corrupt_dataset(data, place, "beam_missing", severity=5, reuse=(out,))
        assert reused(place / "two") == {f"-1/{number:06d}.yaml": code for number in range(1, 5)}
        assert read_settings(place / "one")["corruptions"][0]["code"] == "0" * 64
        now = tree(place)
        assert now.keys() - before.keys() == {"one/reused.json", "two/reused.json"}
        assert {name for name in before if now[name] != before[name]} == {
            f"{name}/data_protocol.yaml" for name in ("one", "two")
        }


def test_another_source_under_the_same_name_is_refused(data: Path, tmp_path: Path) -> None:
    corrupt_dataset(data, tmp_path / "out", "beam_missing")
    write_drive(tmp_path / "other" / "one", {**SETTINGS, "seed": 4}, ToySource().open)
    with pytest.raises(DataError, match=r"data_protocol.yaml: "):
        corrupt_dataset(tmp_path / "other", tmp_path / "out", "beam_missing")


def test_a_clean_drive_is_not_written_into_a_corrupted_one(data: Path, tmp_path: Path) -> None:
    (drive, _) = corrupt_dataset(data, tmp_path / "out", "beam_missing")
    with pytest.raises(DataError, match=r"corruptions\[0\]"):
        write_drive(drive, SETTINGS, ToySource().open)


def test_an_unfinished_drive_names_the_command_that_resumes_it(data: Path, tmp_path: Path) -> None:
    (drive, _) = corrupt_dataset(data, tmp_path / "out", "beam_missing")
    for path in drive.glob("*/000004.*"):
        path.unlink()
    with pytest.raises(DataError, match=r"found 4; run dsrc corrupt again"):
        DriveReader(drive)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"corruption": "fogg"}, "did you mean 'fog'"),
        ({"corruption": "clean"}, "corruption"),
        ({"severity": 6}, "1 to 5"),
        ({"family": "papers"}, "did you mean 'paper'"),
        ({"seed": -1}, "seed"),
        ({"pool": Pool(0)}, "workers"),
    ],
)
def test_a_wrong_setting_is_named_before_anything_is_written(
    data: Path, tmp_path: Path, wrong: dict, message: str
) -> None:
    with pytest.raises(SettingsError, match=message):
        corrupt_dataset(data, tmp_path / "out", **{"corruption": "fog", **wrong})
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("out", ["data", "data/one", "data/foggy", "."])
def test_a_dataset_is_not_written_into_itself(data: Path, tmp_path: Path, out: str) -> None:
    before = tree(data)
    with pytest.raises(SettingsError, match="a place apart from"):
        corrupt_dataset(data, tmp_path / out, "fog")
    assert tree(data) == before


@pytest.mark.parametrize("workers", [1, 2])
def test_a_sweep_that_cannot_be_corrupted_is_named(foreign: Path, tmp_path: Path, workers: int) -> None:
    for path in foreign.rglob("*.pcd"):
        head, _, body = path.read_bytes().partition(b"DATA binary\n")
        path.write_bytes(head.replace(b"ring", b"line") + b"DATA binary\n" + body)
    with pytest.raises(DataError, match=r"data/one: frame 0: agent 1000: "):
        corrupt_dataset(foreign, tmp_path / "out", "beam_missing", pool=Pool(workers))


def test_a_folder_in_use_is_refused(data: Path, tmp_path: Path) -> None:
    with locked(tmp_path / "out" / "one"), pytest.raises(DataError, match=f"process {os.getpid()} is writing"):
        corrupt_dataset(data, tmp_path / "out", "beam_missing")


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_killed_run_resumes_to_the_same_bytes_and_leaves_no_worker(tmp_path: Path, workers: int) -> None:
    write_drive(tmp_path / "data" / "long", {**SETTINGS, "frames": 60}, ToySource().open)
    corrupt_dataset(tmp_path / "data", tmp_path / "whole", "beam_missing")
    code = (
        "import sys; from pathlib import Path; from dsrc.data.datasets.corrupt import corrupt_dataset;"
        "from dsrc.runs.executors import Pool;"
        "corrupt_dataset(Path(sys.argv[1]), Path(sys.argv[2]), 'beam_missing', pool=Pool(int(sys.argv[3])))"
    )
    out = tmp_path / "killed"
    command = [sys.executable, "-c", code, str(tmp_path / "data"), str(out), str(workers)]
    process = subprocess.Popen(command, cwd=ROOT, start_new_session=True)
    deadline = time.monotonic() + 60
    while not (out / "long" / "1000" / "000002.yaml").exists() and time.monotonic() < deadline:
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert (out / "long" / LOCK).exists()
    while _alive(process.pid) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not _alive(process.pid)
    assert len(tree(out)) < len(tree(tmp_path / "whole"))
    corrupt_dataset(tmp_path / "data", out, "beam_missing", pool=Pool(workers))
    assert tree(out) == tree(tmp_path / "whole")


def _alive(group: int) -> bool:
    """Whether a process of this group is left."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True
