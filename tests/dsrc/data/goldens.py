"""The goldens that the tests of this folder read."""

import io
import tarfile
from pathlib import Path

import numpy as np
from numpy.lib.npyio import NpzFile

from tests.paths import GOLDENS


def load(name: str) -> NpzFile:
    return np.load(GOLDENS / f"{name}.npz", allow_pickle=False)


def unpack(name: str, folder: Path) -> Path:
    """Unpack the tree of a golden archive into a folder and return the tree."""
    with tarfile.open(fileobj=io.BytesIO((GOLDENS / f"{name}.tar.gz").read_bytes())) as archive:
        archive.extractall(folder, filter="data")
    return folder / name


def unpack_opv2v_mini(folder: Path) -> Path:
    return unpack("opv2v_mini", folder)


def ours(boxes: np.ndarray) -> np.ndarray:
    """Turn x y z h w l yaw in CARLA's left-handed frame into x y z l w h yaw in ours."""
    return boxes[:, [0, 1, 2, 5, 4, 3, 6]] * [1, -1, 1, 1, 1, 1, -1]


def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the largest difference per column of boxes, yaw modulo pi."""
    difference = a - b
    difference[:, 6] = np.mod(difference[:, 6] + np.pi / 2, np.pi) - np.pi / 2
    return np.abs(difference).max(axis=0, initial=0.0)
