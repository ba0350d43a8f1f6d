"""Tensor files of others: PyTorch's archives, read within bounds and without running code from them."""

import warnings
import zipfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sim.errors import CheckpointError, complaint
from sim.reading import check_regular

LARGEST_BYTES = 1 << 32
"""Most bytes of a file; the largest published one has 300 MB."""
_LARGEST_INDEX = 1 << 26
"""Most bytes of the pickle that lists an archive's tensors."""
_MOST_MEMBERS = 100_000


def read_tensors(path: Path, what: str, hint: str = "") -> Any:
    """Return the content of a file of `torch.save`: tensors and plain values alone.

    Args:
        hint: end of the message about a file that cannot be read.

    Raises:
        CheckpointError: the file is missing, damaged, holds objects that are no data, or unpacks to more than it has.
    """
    try:
        check_regular(path, what, CheckpointError, LARGEST_BYTES)
    except CheckpointError:
        if not path.exists():
            raise CheckpointError(f"{path}: no such checkpoint file") from None
        raise
    try:
        if zipfile.is_zipfile(path):
            _check_archive(path, what)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a pickle that it refuses in the next line
            return torch.load(path, map_location="cpu", weights_only=True)
    except CheckpointError:
        raise
    except Exception:  # torch's reader raises many types for damaged files
        raise CheckpointError(complaint(path, "file", what, "something else or damaged", hint)) from None


def is_plain(tensor: object) -> bool:
    """Return whether a value is a dense tensor whose numbers are all in memory: no view that repeats a few."""
    if not isinstance(tensor, Tensor) or tensor.layout != torch.strided or tensor.device.type != "cpu":
        return False
    if tensor.is_quantized or tensor.is_complex():
        return False
    return tensor.numel() * tensor.element_size() <= tensor.untyped_storage().nbytes()


def _check_archive(path: Path, what: str) -> None:
    """Refuse an archive that unpacks to more than it has: `torch.save` compresses nothing."""
    size = path.stat().st_size
    with zipfile.ZipFile(path) as archive:
        infos = archive.infolist()
    if len(infos) > _MOST_MEMBERS or sum(info.file_size for info in infos) > size:
        raise CheckpointError(complaint(path, "file", f"{what} that is not compressed", "more bytes when unpacked"))
    index = max((info.file_size for info in infos if info.filename.endswith("data.pkl")), default=0)
    if index > _LARGEST_INDEX:
        raise CheckpointError(complaint(path, "data.pkl", f"at most {_LARGEST_INDEX} bytes", f"{index} bytes"))
