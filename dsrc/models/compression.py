"""What of its maps an agent sends through a narrow channel: the tiles in which it is surest to see something, coarsely.

Any method that fuses maps and whose heads can read one agent's alone can be used so, without further training: `share`
of the tiles go out, those with the highest confidence of the sender's own detections, in numbers of `bits`. Choosing by
confidence is Where2comm's idea (arXiv 2209.12836, Section 4.2); here it is by number, so that a message has the size
that it was promised.
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
    """Return how many tiles a map has, along y and x."""
    return settings.grid.height // TILE_CELLS, settings.grid.width // TILE_CELLS


def tiles_sent(settings: ModelSettings) -> int:
    """Return how many of them an agent sends."""
    rows, columns = tiles(settings)
    return math.ceil(settings.share * rows * columns)


def message_bytes(settings: ModelSettings, values: int, channels: int) -> int:
    """Return the size of an agent's message.

    Args:
        settings: of the detector.
        values: numbers in its whole maps.
        channels: of all maps together.
    """
    rows, columns = tiles(settings)
    sent = values * settings.bits / 8 / settings.compress * tiles_sent(settings) / (rows * columns)
    which = rows * columns / 8 if settings.share < 1 else 0
    scales = 8 * channels if settings.bits == 8 else 0  # lowest and highest number of each channel
    return math.ceil(sent + which + scales)


def reduced(maps: Sequence[Tensor], confidence: Tensor | None, settings: ModelSettings) -> list[Tensor]:
    """Return the collaborators' maps as they arrive.

    Args:
        maps: (N, C, H, W) each.
        confidence: (N, h, w) of their own detections, any size that tiles divide; None when all tiles are sent.
        settings: of the detector.
    """
    coarse = [rounded(part, settings.bits) for part in maps]
    if confidence is None:
        return coarse
    chosen = best_tiles(confidence, tiles(settings), tiles_sent(settings))
    return [part * as_large(chosen, part) for part in coarse]


def best_tiles(confidence: Tensor, shape: tuple[int, int], count: int) -> Tensor:
    """Return the (N, rows, columns) bool tiles with the highest (N, h, w) confidences, `count` of each agent."""
    best = functional.adaptive_max_pool2d(confidence[:, None], shape).flatten(1)
    chosen = torch.zeros_like(best, dtype=torch.bool)
    return chosen.scatter_(1, best.topk(count, dim=1, sorted=False).indices, True).view(-1, *shape)


def rounded(x: Tensor, bits: int) -> Tensor:
    """Return (N, C, H, W) as numbers of 32, 16 or 8 bits hold it, those of 8 between each channel's extremes."""
    if bits == 32:
        return x
    if bits == 16:
        return x.half().to(x.dtype)
    low, high = x.amin((2, 3), keepdim=True), x.amax((2, 3), keepdim=True)
    step = ((high - low) / 255).clamp(min=torch.finfo(x.dtype).tiny)
    return torch.round((x - low) / step) * step + low


def as_large(tiles: Tensor, part: Tensor) -> Tensor:
    """Return (N, rows, columns) tiles as an (N, 1, H, W) mask of a map's cells."""
    factor = part.shape[-1] // tiles.shape[-1]
    return tiles.repeat_interleave(factor, 1).repeat_interleave(factor, 2)[:, None]
