"""Trainings from the history: whole, absent in a shallow clone, or damaged."""

import hashlib
import subprocess
from pathlib import Path

import pytest

from sim.errors import DataError
from studies.dsrc_paper.weights import PLACES, take

FILES = {"kept/one_s0/student/detector.pt": b"weights", "kept/gates.json": b"[]", "detectors/two.pt": b"joined"}


def git(folder: Path, *words: str) -> str:
    """Return what git printed in a folder."""
    named = ("-c", "user.name=a", "-c", "user.email=a@b")
    done = subprocess.run(["git", "-C", folder, *named, *words], capture_output=True, text=True, check=True)
    return done.stdout.strip()


@pytest.fixture
def repository(tmp_path: Path) -> tuple[Path, str, Path]:
    """Repository whose last commit has no trainings any more, the commit that has them, and their hashes."""
    folder, hashes = tmp_path / "repository", tmp_path / "weights.sha256"
    lines = []
    for place, below in PLACES.items():
        for name, content in FILES.items():
            top, _, rest = name.partition("/")
            if place.endswith(top):
                path = folder / place / rest
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content)
                lines.append(f"{hashlib.sha256(content).hexdigest()}  {(Path(below) / rest).as_posix()}\n")
    hashes.write_text("".join(lines))
    git(folder, "init", "--quiet")
    git(folder, "add", ".")
    git(folder, "commit", "--quiet", "--message", "with")
    commit = git(folder, "rev-parse", "HEAD")
    git(folder, "rm", "-r", "--quiet", ".")
    git(folder, "commit", "--quiet", "--allow-empty", "--message", "without")
    return folder, commit, hashes


def test_trainings_come_from_the_history_and_own_ones_stay(repository: tuple[Path, str, Path], tmp_path: Path) -> None:
    out = tmp_path / "runs"
    assert take(out, *repository) == ["gates.json", "joined", "one_s0"]
    assert (out / "one_s0/student/detector.pt").read_bytes() == b"weights"
    assert (out / "joined/two.pt").read_bytes() == b"joined"
    (out / "one_s0/student/detector.pt").write_bytes(b"my own")
    (out / "gates.json").unlink()
    assert take(out, *repository) == ["gates.json"]
    assert (out / "one_s0/student/detector.pt").read_bytes() == b"my own"
    assert {path.name for path in out.iterdir()} == {"gates.json", "joined", "one_s0"}


def test_a_shallow_clone_says_what_to_fetch(repository: tuple[Path, str, Path], tmp_path: Path) -> None:
    folder, commit, hashes = repository
    git(tmp_path, "clone", "--quiet", "--depth", "1", f"file://{folder}", "shallow")
    with pytest.raises(DataError, match=rf"git fetch --unshallow` or `git fetch origin {commit}") as told:
        take(tmp_path / "runs", tmp_path / "shallow", commit, hashes)
    assert "\n" not in str(told.value) and not (tmp_path / "runs").exists()


def test_a_damaged_training_is_named_and_none_is_written(repository: tuple[Path, str, Path], tmp_path: Path) -> None:
    folder, commit, hashes = repository
    digest = hashlib.sha256(b"weights").hexdigest()
    hashes.write_text(hashes.read_text().replace(digest, "0" * 64))
    with pytest.raises(DataError, match=rf"^one_s0/student/detector.pt: .* expected {'0' * 64}, found {digest}"):
        take(tmp_path / "runs", folder, commit, hashes)
    assert not (tmp_path / "runs").exists()
