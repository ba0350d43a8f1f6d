import os
from pathlib import Path

import pytest

from dsrc.data import checksums
from dsrc.data.checksums import CHECKSUMS, Written, faulty_files, read_checksums, write_checksums
from dsrc.data.write import write_drive
from sim.errors import OutputError
from sim.files import file_sha256
from tests.dsrc.data.toy import SETTINGS, ToySource


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the files that are read for their checksum."""
    names: list[str] = []

    def noting(path: Path) -> str:
        names.append(path.name)
        return file_sha256(path)

    monkeypatch.setattr(checksums, "file_sha256", noting)
    return names


def test_frames_are_not_read_for_their_checksums(tmp_path: Path, read: list[str]) -> None:
    write_drive(tmp_path, SETTINGS, ToySource().open)
    assert read == ["data_protocol.yaml", "traffic.npz"]
    assert list(faulty_files(tmp_path)) == []


def test_frames_of_an_earlier_run_are_read(tmp_path: Path, read: list[str]) -> None:
    write_drive(tmp_path, SETTINGS, ToySource().open)
    whole = (tmp_path / CHECKSUMS).read_bytes()
    (tmp_path / "1000/000003.pcd").unlink()
    read.clear()
    write_drive(tmp_path, SETTINGS, ToySource().open)
    assert len(read) == 2 + 4 * 3 * 2
    assert (tmp_path / CHECKSUMS).read_bytes() == whole


def test_a_file_that_is_replaced_or_changed_after_it_was_written_is_read(tmp_path: Path, read: list[str]) -> None:
    written = Written()
    for name in ("kept", "replaced", "changed"):
        written.write(tmp_path / name, b"one")
    (tmp_path / "other").write_bytes(b"two")
    (tmp_path / "other").replace(tmp_path / "replaced")
    (tmp_path / "changed").write_bytes(b"two")
    os.utime(tmp_path / "changed", ns=(1, 1))
    write_checksums(tmp_path, written)
    assert read == ["changed", "replaced"]
    assert list(faulty_files(tmp_path)) == []
    assert len(set(read_checksums(tmp_path).values())) == 2


def test_a_write_that_fails_leaves_the_checksum_of_what_is_there(tmp_path: Path, read: list[str]) -> None:
    written = Written()
    (tmp_path / "precious").write_bytes(b"of another program")
    with pytest.raises(OutputError):
        written.write(tmp_path / "precious", b"ours")
    write_checksums(tmp_path, written)
    assert read == ["precious"] and list(faulty_files(tmp_path)) == []
