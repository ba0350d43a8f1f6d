import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from dsrc.data.formats.opv2v.reader import DriveReader
from dsrc.data.write import write_drive
from dsrc.runs.lock import LOCK, locked
from sensors.deskew import deskew_frame
from sim.errors import DataError, OutputError
from sim.files import overwriting
from sim.packed import write_arrays
from tests.dsrc.data.toy import SETTINGS, ToySource, same_frames, toy_frame
from tests.paths import ROOT


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    write_drive(tmp_path / "toy_3", SETTINGS, ToySource().open)
    return tmp_path / "toy_3"


def test_a_written_drive_reads_back_equal(drive: Path) -> None:
    reader = DriveReader(drive)
    assert reader.agents == (1000, 1002, -1)
    assert all(same_frames(reader.read(i), toy_frame(i)) for i in range(5))


def test_a_drive_holds_only_what_the_opv2v_tools_expect(drive: Path) -> None:
    assert sorted(p.name for p in drive.iterdir()) == [
        "-1",
        "1000",
        "1002",
        "SHA256SUMS",
        "data_protocol.yaml",
        "traffic.npz",
    ]
    names = sorted(p.name for p in (drive / "1000").iterdir())
    assert names == sorted(f"{i:06d}.{e}" for i in range(5) for e in ("pcd", "yaml"))


def test_two_runs_write_the_same_bytes(drive: Path, tmp_path: Path) -> None:
    write_drive(tmp_path / "again", SETTINGS, ToySource().open)
    assert tree(tmp_path / "again") == tree(drive)


def test_a_finished_drive_is_left_alone(drive: Path) -> None:
    before, source, seen = tree(drive), ToySource(), []
    write_drive(drive, SETTINGS, source.open, lambda done, total: seen.append((done, total)))
    assert source.made == [] and seen == [(5, 5)] and tree(drive) == before


def test_only_missing_frames_are_written_again(drive: Path) -> None:
    before, source = tree(drive), ToySource()
    (drive / "1002" / "000003.yaml").unlink()
    (drive / "1000" / ".000004.pcd.0123abcd.tmp").write_bytes(b"half")
    write_drive(drive, SETTINGS, source.open)
    assert source.made == [3] and tree(drive) == before


def test_a_log_of_unknown_settings_is_not_replayed(tmp_path: Path) -> None:
    write_arrays(tmp_path / "traffic.npz", {"version": np.array(3)})  # of another run
    write_drive(tmp_path, SETTINGS, ToySource().open)
    assert (tmp_path / "traffic.npz").read_bytes() == b"log"


def test_frames_of_another_program_are_not_replaced(tmp_path: Path) -> None:
    foreign = tmp_path / "toy_3/1000/000000.yaml"
    foreign.parent.mkdir(parents=True)
    foreign.write_text("vehicles: precious\n")
    with pytest.raises(OutputError, match=r"000000\.yaml: output: expected a new name, or a file that dsrc wrote"):
        write_drive(tmp_path / "toy_3", SETTINGS, ToySource().open)
    assert tree(tmp_path / "toy_3") == {"1000/000000.yaml": b"vehicles: precious\n"}
    with overwriting():
        write_drive(tmp_path / "toy_3", SETTINGS, ToySource().open)


def test_other_settings_are_refused_by_name(drive: Path) -> None:
    with pytest.raises(DataError, match=r"data_protocol.yaml: seed: expected 4 as asked for now, found 3"):
        write_drive(drive, {**SETTINGS, "seed": 4}, ToySource().open)


def test_a_drive_is_written_in_the_motion_asked_for_and_in_no_other_afterwards(tmp_path: Path) -> None:
    write_drive(tmp_path / "d", {**SETTINGS, "motion": "raw"}, ToySource().open)
    assert DriveReader(tmp_path / "d").protocol["testbed"]["motion"] == "raw"
    assert same_frames(DriveReader(tmp_path / "d").read(3), deskew_frame(toy_frame(3), "raw"))
    with pytest.raises(DataError, match=r"data_protocol.yaml: motion: expected 'middle' as asked for now, found raw"):
        write_drive(tmp_path / "d", SETTINGS, ToySource().open)


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    for place in (tmp_path / "taken" / "d", Path("/proc/nowhere/d")):
        with pytest.raises(DataError, match=f"{place}: cannot write in this folder: "):
            write_drive(place, SETTINGS, ToySource().open)


def test_a_second_run_in_the_same_folder_is_refused(tmp_path: Path) -> None:
    with locked(tmp_path), pytest.raises(DataError, match=f"process {os.getpid()} is writing this drive"):
        write_drive(tmp_path, SETTINGS, ToySource().open)
    assert not (tmp_path / LOCK).exists()


def test_a_dead_process_does_not_hold_the_folder(tmp_path: Path) -> None:
    (tmp_path / LOCK).write_text("999999\n")
    write_drive(tmp_path, SETTINGS, ToySource().open)
    assert not (tmp_path / LOCK).exists()


@pytest.mark.parametrize("wait_for", ["1000/000000.pcd", "-1/000002.yaml"])
def test_a_killed_run_resumes_to_the_same_bytes(drive: Path, tmp_path: Path, wait_for: str) -> None:
    killed = tmp_path / "killed"
    code = (
        "import sys; from pathlib import Path; from dsrc.data.write import write_drive;"
        "from tests.dsrc.data.toy import SETTINGS, ToySource;"
        "write_drive(Path(sys.argv[1]), SETTINGS, ToySource(0.05).open)"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(killed)], cwd=ROOT)
    deadline = time.monotonic() + 30
    while not (killed / wait_for).exists() and time.monotonic() < deadline:
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert (killed / LOCK).exists()
    write_drive(killed, SETTINGS, ToySource().open)
    assert tree(killed) == tree(drive)
