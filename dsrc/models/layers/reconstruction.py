"""Point cloud reconstruction: the merged clouds of all agents from the fused feature.

Used in training only. The paper's form: ten vertical bins of 0.4 m, an occupancy per 0.4 m cube and the offset of its
mean point from its centre. (The released code's target has a single 4 m bin; `reconstruction_cell_z_m` = 4 gives it.)
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsrc.models.device import Movable
from dsrc.models.layers.conv_norm import ConvSequence, count_batch
from dsrc.models.settings import ModelSettings


@dataclass(frozen=True, slots=True, eq=False)
class SceneVoxels(Movable):
    """Reconstruction target: occupied voxels of B merged clouds.

    Attributes:
        voxel: (K, 4) int64 sample, z, y, x.
        offset: (K, 3) float32 mean point minus voxel centre, m.
        samples: B.
        real: (K,) bool voxels that are meant, each once; None for all. The others fill a capacity.
    """

    voxel: Tensor
    offset: Tensor
    samples: int
    real: Tensor | None = None


class Reconstruction(nn.Module):
    """Reconstruction head: occupancy logits and point offsets of a voxel grid at the input's resolution."""

    def __init__(self, settings: ModelSettings) -> None:
        super().__init__()
        self.bins = settings.reconstruction_bins
        column, hidden = settings.reconstruction_channels
        self.expand = ConvSequence(
            nn.Conv2d(settings.shrink_channels, column * (self.bins // 2), 1),
            nn.BatchNorm2d(column * (self.bins // 2)),
            nn.GELU(),
        )
        self.generate = ConvSequence(
            nn.Conv3d(column, hidden, 1),
            nn.BatchNorm3d(hidden),
            nn.ReLU(inplace=True),
            nn.ConvTranspose3d(hidden, hidden, 4, stride=2, padding=1),
            nn.BatchNorm3d(hidden),
            nn.ReLU(inplace=True),
        )
        self.offset = nn.Conv3d(hidden, 3, 1)
        self.occupancy = nn.Conv3d(hidden, 1, 1)

    def forward(self, fused: Tensor, voxel: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Return (B, 1, D, H, W) occupancy logits, and (K, 3) offsets at K voxels; losses compare no others.

        Args:
            fused: (B, C, h, w).
            voxel: (K,) samples, z, y and x of the voxels.
        """
        count_batch(self)
        batch, _, height, width = fused.shape
        if not fused.is_cuda:
            fused = fused.contiguous()  # the order of its volume on CPUs
        column = self.expand(fused).reshape(batch, -1, self.bins // 2, height, width)
        if column.is_cuda:
            # In the other order, each channel's batch norm has one block of threads alone.
            column = column.contiguous(memory_format=torch.channels_last_3d)
        return self.heads(self.generate(column), voxel)

    def heads(self, volume: Tensor, voxel: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Return what `forward` does, for (B, C, D, H, W) features."""
        b, z, y, x = voxel
        if volume.is_contiguous(memory_format=torch.channels_last_3d):
            # Both at all voxels, in one matrix product: numbers are gathered there, not features.
            weight = torch.cat([self.occupancy.weight, self.offset.weight]).flatten(1)
            bias = torch.cat([_bias(self.occupancy), _bias(self.offset)])
            both = functional.linear(volume.movedim(1, -1), weight, bias)
            return both[..., :1].movedim(-1, 1), both[..., 1:][b, z, y, x]
        weight = self.offset.weight.flatten(1)
        return self.occupancy(volume), functional.linear(volume[b, :, z, y, x], weight, self.offset.bias)


def _bias(layer: nn.Conv3d) -> Tensor:
    assert layer.bias is not None
    return layer.bias


def windowed(fused: Tensor, scene: SceneVoxels, share: float) -> tuple[Tensor, tuple[Tensor, ...], Tensor | None]:
    """Crop the fused feature and the scene to a random window.

    Args:
        fused: (B, C, h, w) fused feature.
        scene: its voxels, two by two to a cell of the feature.
        share: share of the feature's height and width; 1 returns both unchanged.

    Returns:
        (B, C, h', w') feature; (K,) samples, z, y and x of the voxels in the window, of those outside at its edge; (K,)
        bool which are real and inside, None for all. To leave out the others, the host would have to wait for the
        device.
    """
    if share == 1:
        return fused, scene.voxel.unbind(1), scene.real
    sizes = [max(round(size * share), 1) for size in fused.shape[-2:]]
    draws = [torch.randint(whole - size + 1, ()) for whole, size in zip(fused.shape[-2:], sizes, strict=True)]
    (top, left), (height, width) = (int(draw.numpy()) for draw in draws), sizes
    b, z, y, x = scene.voxel.unbind(1)
    y, x = y - 2 * top, x - 2 * left
    near_y, near_x = y.clamp(0, 2 * height - 1), x.clamp(0, 2 * width - 1)
    cut = _Cut.apply(fused, top, left, height, width)
    inside = (near_y == y) & (near_x == x)
    return cut, (b, z, near_y, near_x), inside if scene.real is None else inside & scene.real


class _Cut(torch.autograd.Function):
    """Window of a map whose gradient keeps the map's order in memory: sums with one of another order are slow."""

    @staticmethod
    def forward(ctx: Any, whole: Tensor, top: int, left: int, height: int, width: int) -> Tensor:
        ctx.shape, ctx.stride = whole.shape, whole.stride()
        ctx.window = ..., slice(top, top + height), slice(left, left + width)
        return whole[ctx.window].clone()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        whole = gradients[0].new_empty_strided(ctx.shape, ctx.stride).zero_()
        whole[ctx.window] = gradients[0]
        return whole, None, None, None, None


def reconstruction_losses(
    head: Callable[[Tensor, Sequence[Tensor]], tuple[Tensor, Tensor]],
    fused: Tensor,
    scene: SceneVoxels,
    window: float = 1.0,
) -> tuple[Tensor, Tensor]:
    """Return the occupancy and the offset loss.

    The occupied voxels' cross entropy is weighted by N_background / N_foreground, as in the released code. (Equation 7
    is printed with that weight on the whole sum, which balances nothing.) The offset loss is Equation 8.

    Args:
        head: the `Reconstruction`.
        fused: (B, C, h, w) fused feature of the student.
        window: share of the feature's height and width that is reconstructed, at a random place.
    """
    fused, voxel, inside = windowed(fused, scene, window)
    logits, offsets = head(fused, voxel)
    logits = logits.float()
    b, z, y, x = voxel
    *_, depth, height, width = logits.shape
    cell = ((b * depth + z) * height + y) * width + x
    target = torch.zeros_like(logits)
    # An offset of exactly 0 counts as absent, as released.
    valid = scene.offset != 0
    if inside is None:
        count = torch.full((), float(len(cell)), device=target.device)
        target.view(-1).index_fill_(0, cell, 1.0)
    else:
        kept = inside.to(target.dtype)
        count = kept.sum()
        target.view(-1).index_add_(0, cell, kept)
        valid &= inside[:, None]
    weight = (target.numel() - count) / count.clamp(min=1)
    mask_loss = functional.binary_cross_entropy_with_logits(logits, target, pos_weight=weight)
    error = (offsets.float() - scene.offset).abs()
    return mask_loss, (error * valid).sum() / valid.sum().clamp(min=1)
