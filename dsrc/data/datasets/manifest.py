"""Manifest of a dataset: `manifest.json` with its drives, hashes of their settings and checksums."""

from pathlib import Path

import msgspec

from dsrc.data.jsonio import encode_json, read_json
from sim.errors import DataError, complaint
from sim.files import write_file

MANIFEST = "manifest.json"
VERSION = 1


class ManifestEntry(msgspec.Struct, frozen=True, kw_only=True):
    """Finished drive of a manifest.

    Attributes:
        drive: SPLIT/DRIVE.
        key: hash of its settings.
        lidars: presets of the agents, in their order.
        bytes: of all its files.
        sha256: of its `SHA256SUMS`, which covers every file.
    """

    drive: str
    key: str
    scenario: str
    seed: int
    frames: int
    agents: tuple[int, ...]
    lidars: tuple[str, ...]
    bytes: int
    sha256: str


class Manifest(msgspec.Struct, frozen=True, kw_only=True):
    """Manifest of a dataset.

    Attributes:
        version: of this file.
        drives: number of drives, finished or not.
        items: finished drives, in the order of the split file.
        failed: reasons of failed drives, by SPLIT/DRIVE.
    """

    version: int
    name: str
    description: str
    drives: int
    items: tuple[ManifestEntry, ...]
    failed: dict[str, str] = {}


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest of a dataset."""
    write_file(folder / MANIFEST, msgspec.json.format(encode_json(manifest), indent=1))


def read_manifest(folder: Path) -> Manifest | None:
    """Return the manifest of a dataset; None for a folder without one.

    Raises:
        DataError: it is damaged.
    """
    path = folder / MANIFEST
    if not path.is_file():
        return None
    manifest = read_json(path, Manifest)
    if manifest.version != VERSION:
        raise DataError(complaint(path, "version", str(VERSION), manifest.version))
    return manifest
