import json
import shutil
import subprocess
from pathlib import Path

from dsrc.data.drives import drive_hashes
from dsrc.runs.provenance import commit, provenance
from sim.files import file_sha256
from tests.dsrc.evaluation.fakes import write_drives


def test_it_names_settings_seed_versions_and_data(tmp_path: Path) -> None:
    drives = write_drives(tmp_path / "a", drives=2, frames=1)
    made_by = provenance({"severity": 3}, 7, drive_hashes(drives))
    assert made_by["settings"] == {"severity": 3}
    assert made_by["seed"] == 7
    assert {"numpy", "torch", "powerboxes"} <= set(made_by["versions"])
    assert set(made_by["data"]) == {"drive_0", "drive_1"}
    json.dumps(made_by, allow_nan=False)


def test_the_hash_is_of_the_content_not_of_the_place(tmp_path: Path) -> None:
    (drive,) = write_drives(tmp_path / "a", drives=1, frames=1)
    copy = tmp_path / "b" / "drive_0"
    shutil.copytree(drive, copy)
    assert drive_hashes([drive]) == drive_hashes([copy])
    notes = next(copy.rglob("*.yaml"))
    notes.write_text(notes.read_text().replace("7.25", "7.26"))
    assert drive_hashes([drive]) != drive_hashes([copy])


def test_drives_of_one_name_each_have_their_hash(tmp_path: Path) -> None:
    drives = [*write_drives(tmp_path / "a", drives=1, frames=1), *write_drives(tmp_path / "b", drives=2, frames=2)]
    assert set(drive_hashes(drives)) == {"a/drive_0", "b/drive_0", "drive_1"}


def test_the_commit_is_known_in_a_repository_only(tmp_path: Path) -> None:
    assert commit(tmp_path) is None
    git = ["git", "-C", str(tmp_path), "-c", "user.name=t", "-c", "user.email=t@example.org"]
    subprocess.run([*git, "init", "-q"], check=True)
    (tmp_path / "file").write_text("one")
    subprocess.run([*git, "add", "file"], check=True)
    subprocess.run([*git, "commit", "-qm", "one"], check=True)
    clean = commit(tmp_path)
    assert len(clean) == 40
    (tmp_path / "file").write_text("two")
    assert commit(tmp_path) == f"{clean}-dirty"


def test_a_file_has_its_sha256(tmp_path: Path) -> None:
    (tmp_path / "x").write_bytes(b"abc")
    assert file_sha256(tmp_path / "x").startswith("ba7816bf8f01cfea")
