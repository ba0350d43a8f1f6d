"""Res2Net backbone: three stages, each at half the resolution of the one before.

Source: Res2Net, arXiv 1904.01169 (Gao et al.), in the form that DSRC uses: base width 26, scale 4, expansion 1, no
stem, every stage with stride 2.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

_SPLITS = 4


class Res2Block(nn.Module):
    """Res2Net bottleneck: 3 x 3 convolutions on channel splits, each added to the result of the one before.

    The first block of a stage halves the resolution: its splits stay independent and the last one is averaged.
    """

    def __init__(self, inputs: int, outputs: int, base_width: int, first: bool) -> None:
        super().__init__()
        width = outputs * base_width // 64
        stride = 2 if first else 1
        self.first = first
        self.conv1 = nn.Conv2d(inputs, width * _SPLITS, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width * _SPLITS)
        self.convs = nn.ModuleList(
            nn.Conv2d(width, width, 3, stride=stride, padding=1, bias=False) for _ in range(_SPLITS - 1)
        )
        self.bns = nn.ModuleList(nn.BatchNorm2d(width) for _ in range(_SPLITS - 1))
        self.conv3 = nn.Conv2d(width * _SPLITS, outputs, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(outputs)
        self.downsample = (
            nn.Sequential(nn.Conv2d(inputs, outputs, 1, bias=False), nn.BatchNorm2d(outputs)) if first else None
        )

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, inputs, H, W) to (N, outputs, H', W')."""
        splits = torch.relu_(self.bn1(self.conv1(x))).chunk(_SPLITS, dim=1)
        results: list[Tensor] = []
        for conv, norm, split in zip(self.convs, self.bns, splits[:-1], strict=True):
            entry = split if self.first or not results else results[-1] + split
            results.append(torch.relu(norm(conv(entry))))
        results.append(functional.avg_pool2d(splits[-1], 3, 2, 1) if self.first else splits[-1])
        # Every second pixel first, then the convolution: with a stride of its own, the weight gradient of a 1 x 1
        # convolution with few channels in channels-last order writes beyond its buffer (oneDNN 3.12, AVX-512).
        residual = x if self.downsample is None else self.downsample(x[:, :, ::2, ::2])
        return torch.relu(self.bn3(self.conv3(torch.cat(results, dim=1))) + residual)


class Res2Net(nn.Module):
    """Three stages of Res2 blocks."""

    def __init__(
        self, inputs: int, channels: tuple[int, int, int], blocks: tuple[int, int, int], base_width: int
    ) -> None:
        super().__init__()
        widths = (inputs, *channels)
        self.stages = nn.ModuleList(
            nn.Sequential(
                *(
                    Res2Block(widths[stage] if block == 0 else channels[stage], channels[stage], base_width, block == 0)
                    for block in range(blocks[stage])
                )
            )
            for stage in range(3)
        )
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the three scales (N, C_k, H / 2^k, W / 2^k), k = 1, 2, 3."""
        first = self.stages[0](x)
        second = self.stages[1](first)
        return first, second, self.stages[2](second)
