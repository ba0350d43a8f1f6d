"""Compression of transmitted maps: the most confident tiles alone, in numbers of fewer bits.

It works without further training for any method that fuses maps and whose heads can read one agent's alone: `share` of
the tiles are sent, those with the highest confidence of the sender's own detections, in numbers of `bits`. Selection by
confidence is Where2comm's (arXiv 2209.12836, Section 4.2); here the number of tiles is fixed, and so is the message's
size.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from dsrc.models.settings import ModelSettings

TILE_CELLS = 8
"""Side of a tile of a feature map, cells of the detector's input grid."""


def tiles(settings: ModelSettings) -> tuple[int, int]:
    """Return the numbers of tiles of a map along y and x."""
    return settings.grid.height // TILE_CELLS, settings.grid.width // TILE_CELLS


def tiles_sent(settings: ModelSettings) -> int:
    """Return the number of tiles that an agent sends."""
    rows, columns = tiles(settings)
    return math.ceil(settings.share * rows * columns)


def message_bytes(settings: ModelSettings, values: int, channels: int) -> int:
    """Return the size of an agent's message, bytes."""
    rows, columns = tiles(settings)
    sent = values * settings.bits / 8 / settings.compress * tiles_sent(settings) / (rows * columns)
    which = rows * columns / 8 if settings.share < 1 else 0
    scales = 8 * channels if settings.bits == 8 else 0  # lowest and highest number of each channel
    return math.ceil(sent + which + scales)


def reduced(maps: Sequence[Tensor], confidence: Tensor | None, settings: ModelSettings) -> list[Tensor]:
    """Reduce the collaborators' maps to what is transmitted.

    Args:
        maps: (N, C, H, W) each.
        confidence: (N, h, w) of their own detections, any size that tiles divide; None when all tiles are sent.
    """
    # A cell that is not sent stays empty: 0 is none of the steps of 8 bits where numbers are of both signs.
    coarse = [quantised(part, settings.bits) * (part != 0).any(1, keepdim=True) for part in maps]
    if confidence is None:
        return coarse
    chosen = best_tiles(confidence, tiles(settings), tiles_sent(settings))
    return [part * as_large(chosen, part) for part in coarse]


def best_tiles(confidence: Tensor, shape: tuple[int, int], count: int) -> Tensor:
    """Return the (N, rows, columns) mask of the `count` most confident tiles of each agent, from (N, h, w)."""
    best = functional.adaptive_max_pool2d(confidence[:, None], shape).flatten(1)
    chosen = torch.zeros_like(best, dtype=torch.bool)
    return chosen.scatter_(1, best.topk(count, dim=1, sorted=False).indices, True).view(-1, *shape)


def quantised(x: Tensor, bits: int) -> Tensor:
    """Round (N, C, H, W) to 32, 16 or 8 bits, 8 of them linear between each channel's extremes."""
    if bits == 32:
        return x
    if bits == 16:
        return x.half().to(x.dtype)
    low, high = x.amin((2, 3), keepdim=True), x.amax((2, 3), keepdim=True)
    step = ((high - low) / 255).clamp(min=torch.finfo(x.dtype).tiny)
    return torch.round((x - low) / step) * step + low


def as_large(tiles: Tensor, part: Tensor) -> Tensor:
    """Enlarge (N, rows, columns) tiles to an (N, 1, H, W) mask of a map's cells."""
    factor = part.shape[-1] // tiles.shape[-1]
    return tiles.repeat_interleave(factor, 1).repeat_interleave(factor, 2)[:, None]
