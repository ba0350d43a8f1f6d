"""Trainings behind the tables, taken from the repository's history and checked by their SHA-256.

Detectors, settings and records of 68 trainings (109 MB) were tracked up to one commit and are in no later tree. Folders
that are there, such as trainings of one's own, are left as they are.

Usage:
    python -m studies.dsrc_paper.weights --out runs
"""

import argparse
import hashlib
import io
import subprocess
import tarfile
import tempfile
from pathlib import Path, PurePosixPath

from sim.errors import DataError, UserError, complaint

COMMIT = "02a53766b8f65e052687326d4144460645597f80"
PLACES = {"docs/results/dsrc-sim-small/kept": ".", "docs/closed_loop/detectors": "joined"}
"""Folders of the commit, and where their files go below `--out`."""
HASHES = Path(__file__).with_suffix(".sha256")
"""SHA-256 and path below `--out` of each file, as `sha256sum` writes them."""
REPOSITORY = Path(__file__).parents[2]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the run folders")
    options = parser.parse_args()
    try:
        taken = take(options.out)
    except UserError as error:
        parser.error(str(error))
    print(f"{len(taken)} folders in {options.out}: {', '.join(taken) or 'all were there'}")


def take(out: Path, repository: Path = REPOSITORY, commit: str = COMMIT, hashes: Path = HASHES) -> list[str]:
    """Write the folders of the trainings that are missing; return their names.

    Raises:
        DataError: the commit is not in the clone, or a file is missing or damaged; nothing is written then.
    """
    expected = dict(reversed(line.split(maxsplit=1)) for line in hashes.read_text(encoding="utf-8").splitlines())
    with tarfile.open(fileobj=io.BytesIO(_archive(repository, commit))) as archive:
        files = {_place(member.name): archive.extractfile(member).read() for member in archive if member.isfile()}
    for name, digest in expected.items():
        found = hashlib.sha256(files[name]).hexdigest() if name in files else "no such file"
        if found != digest:
            raise DataError(complaint(name, f"SHA-256 in commit {commit[:7]}", digest, found))
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out, prefix=".weights-") as folder:
        for name in expected:
            path = Path(folder) / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(files[name])
        missing = [path for path in sorted(Path(folder).iterdir()) if not (out / path.name).exists()]
        for path in missing:
            path.rename(out / path.name)
    return [path.name for path in missing]


def _place(name: str) -> str:
    """Return where a file of the commit goes below the output folder."""
    folder = next(folder for folder in PLACES if PurePosixPath(name).is_relative_to(folder))
    return (PurePosixPath(PLACES[folder]) / PurePosixPath(name).relative_to(folder)).as_posix()


def _archive(repository: Path, commit: str) -> bytes:
    """Return the folders of a commit as a tar archive."""
    git = ["git", "-C", str(repository)]
    if subprocess.run([*git, "cat-file", "-e", f"{commit}^{{tree}}"], capture_output=True).returncode:
        way = f"`git fetch --unshallow` or `git fetch origin {commit}` fetches it"
        raise DataError(f"{repository}: expected commit {commit[:7]} in the clone, found none; {way}")
    made = subprocess.run([*git, "archive", "--format=tar", commit, *PLACES], capture_output=True)
    if made.returncode:
        told = made.stderr.decode(errors="replace").strip().splitlines()[-1]
        raise DataError(f"{repository}: expected the trainings in commit {commit[:7]}, found: {told}")
    return made.stdout


if __name__ == "__main__":
    main()
