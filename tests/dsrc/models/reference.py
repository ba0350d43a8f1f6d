"""Reads the golden files of the reference networks."""

import json
import re

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from dsrc.models.layers.encoder import Pillars
from dsrc.models.settings import ModelSettings
from dsrc.models.storage.names import renamed_state
from dsrc.ops.grid import GridSpec
from tests.paths import ROOT

FIXTURES = ROOT / "tests/fixtures/goldens/models"
GOLDENS = ROOT.parent / "shared/goldens/models"


def golden(name: str) -> tuple[dict[str, NDArray], dict]:
    """Return a golden's arrays and its notes; skip the test where the file is not at hand."""
    for folder in (FIXTURES, GOLDENS):
        if (folder / f"{name}.npz").exists():
            with np.load(folder / f"{name}.npz") as arrays:
                return dict(arrays), json.loads((folder / f"{name}.json").read_text())
    pytest.skip(f"golden {name} is not at hand")


def settings_of(config: dict, **changes: object) -> ModelSettings:
    """Return the settings of a golden's network: the released form."""
    return ModelSettings(
        grid=GridSpec(range_m=tuple(config["range"]), cell_m=config["voxel"][0]),
        padded_slots=True,
        pillar_channels=config["vfe"][0],
        stage_channels=tuple(config["num_filters"]),
        stage_blocks=tuple(config["layer_nums"]),
        decoder_channels=config["upsample_filters"][0],
        shrink_channels=config["shrink_dim"],
        reconstruction_cell_z_m=4.0,
        **changes,
    )


def pillars(features: NDArray, coords: NDArray, count: NDArray, clouds: int) -> Pillars:
    """Return the pillars of padded (V, 32, D) voxels with [cloud, z, y, x] coordinates."""
    real = np.arange(features.shape[1])[None] < count[:, None]
    rows = np.repeat(np.arange(len(count)), count)
    return Pillars(
        points=torch.from_numpy(features[real]),
        pillar=torch.from_numpy(rows),
        coords=torch.from_numpy(coords[:, [0, 2, 3]].astype(np.int64)),
        count=torch.from_numpy(count.astype(np.int64)),
        clouds=clouds,
    )


def state(arrays: dict[str, NDArray]) -> dict[str, torch.Tensor]:
    """Return the reference weights by the reference's names."""
    return {k.removeprefix("state/"): torch.from_numpy(v) for k, v in arrays.items() if k.startswith("state/")}


def matching(tensors: dict[str, torch.Tensor], rules: tuple) -> dict[str, torch.Tensor]:
    """Return tensors by our names; those that no rule (pattern, replacement) matches are never used there."""
    renamed = {}
    for name, tensor in tensors.items():
        for pattern, replacement in rules:
            if match := re.fullmatch(pattern, name):
                renamed[replacement(match) if callable(replacement) else match.expand(replacement)] = tensor
    return renamed


def close(found: torch.Tensor, expected: NDArray, tolerance: float = 3e-5) -> None:
    """Compare with a tolerance relative to the largest magnitude."""
    found = found.detach().numpy()
    assert found.shape == expected.shape
    worst = np.abs(found - expected).max()
    assert worst <= tolerance * np.abs(expected).max(), f"off by {worst / np.abs(expected).max():.2e}"


_RECONSTRUCTION = (
    (r"pcr\.out_conv\.(.*)", r"expand.\1"),
    (r"pcr\.generator_1\.(.*)", r"generate.\1"),
    (r"pcr\.gen_out_4\.0\.(.*)", r"offset.\1"),
    (r"pcr\.gen_mask_4\.0\.(.*)", r"occupancy.\1"),
)


def reconstruction_state(reference: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Rename the reference's tensors to those of a `Reconstruction`."""
    return renamed_state(reference, _RECONSTRUCTION)
