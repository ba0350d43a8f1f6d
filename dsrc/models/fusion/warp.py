"""Warping of feature maps from one agent's frame to another's.

Two conventions are in use, and weights expect the one that they were trained with. `into_ego` puts the centres of the
outer cells half a cell inside the map's edge and is right in metres; `shifted` puts them on the edge, so that a map of
W cells is stretched by W / (W - 1), and turns about the corner between the middle cells.
"""

import torch
from torch import Tensor
from torch.nn import functional

from dsrc.models.fusion.base import AgentLayout


def planar(matrix: Tensor, centre_m: tuple[float, float]) -> Tensor:
    """Return the (..., 2, 3) planar motions of (..., 4, 4) transforms between the centres of maps."""
    centre = matrix.new_tensor(centre_m)
    turn = matrix[..., :2, :2]
    shift = matrix[..., :2, 3] + turn @ centre - centre
    return torch.cat([turn, shift[..., None]], dim=-1)


def normalised(matrix: Tensor, extent_m: tuple[float, float], centre_m: tuple[float, float] = (0.0, 0.0)) -> Tensor:
    """Return (..., 2, 3) transforms in map coordinates from -1 to 1, from (..., 4, 4) in metres."""
    half = matrix.new_tensor(extent_m) / 2
    motion = planar(matrix, centre_m)
    return torch.cat([motion[..., :2] * half / half[:, None], motion[..., 2:] / half[:, None]], dim=-1)


def into_ego(group: Tensor, layout: AgentLayout, sample: int) -> Tensor:
    """Warp one sample's (A, C, H, W) maps to its ego's frame, zero outside a map."""
    if layout.pairwise is None:
        return group
    agents = len(group)
    # Place of a cell of the ego's map in each agent's.
    agent_from_ego = layout.pairwise[sample, 0, :agents].double()
    theta = normalised(agent_from_ego, layout.extent_m, layout.centre_m).to(group.dtype)
    grid = functional.affine_grid(theta, list(group.shape), align_corners=False)
    return functional.grid_sample(group, grid, align_corners=False)


def in_cells(matrix: Tensor, layout: AgentLayout, size: tuple[int, int]) -> Tensor:
    """Return (..., 2, 3) motions in cells of (H, W) maps, from (..., 4, 4) in metres."""
    height, width = size
    motion = planar(matrix, layout.centre_m)
    cell = motion.new_tensor([layout.extent_m[0] / width, layout.extent_m[1] / height])
    return torch.cat([motion[..., :2], motion[..., 2:] / cell[:, None]], dim=-1)


def about_centre(motion: Tensor, size: tuple[int, int]) -> Tensor:
    """Return (..., 2, 3) motions in cells that turn about a map's centre, from motions about its first cell."""
    height, width = size
    centre = motion.new_tensor([width / 2, height / 2])
    turn = motion[..., :2]
    return torch.cat([turn, (motion[..., 2] + centre - turn @ centre)[..., None]], dim=-1)


def shifted(features: Tensor, motion: Tensor, mode: str = "bilinear") -> Tensor:
    """Move (A, C, H, W) maps by (A, 2, 3) motions in cells, zero outside a map."""
    height, width = features.shape[-2:]
    back = torch.linalg.inv(motion[..., :2].double())
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    cell = torch.stack([x, y], dim=-1).to(back)
    source = (cell - motion[:, None, None, :, 2]) @ back.transpose(1, 2)[:, None]
    grid = 2 * source / source.new_tensor([max(width - 1, 1), max(height - 1, 1)]) - 1
    return functional.grid_sample(features, grid.to(features.dtype), mode=mode, align_corners=True)
