"""Backbones: three stages, each at half the resolution of the one before; DSRC's is `res2net`."""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsrc.models.layers.conv_norm import ConvSequence, conv_norm
from dsrc.models.settings import ModelSettings

_SPLITS = 4


class StagedBackbone(nn.Module):
    """Backbone of three stages."""

    def __init__(self, stages: list[nn.Module]) -> None:
        super().__init__()
        self.stages = nn.ModuleList(stages)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the three scales (N, C_k, H / 2^k, W / 2^k), k = 1, 2, 3, of (N, C, H, W)."""
        first = self.stages[0](x)
        second = self.stages[1](first)
        return first, second, self.stages[2](second)


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
            ConvSequence(nn.Conv2d(inputs, outputs, 1, bias=False), nn.BatchNorm2d(outputs)) if first else None
        )

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, inputs, H, W) to (N, outputs, H', W')."""
        splits = conv_norm(x, self.conv1, self.bn1).chunk(_SPLITS, dim=1)
        results: list[Tensor] = []
        for conv, norm, split in zip(self.convs, self.bns, splits[:-1], strict=True):
            entry = split if self.first or not results else results[-1] + split
            results.append(conv_norm(entry, conv, norm))  # type: ignore[arg-type]
        results.append(functional.avg_pool2d(splits[-1], 3, 2, 1) if self.first else splits[-1])
        # Every second pixel first, then the convolution: with a stride of its own, the weight gradient of a 1 x 1
        # convolution with few channels in channels-last order writes beyond its buffer (oneDNN 3.12, AVX-512).
        residual = x if self.downsample is None else self.downsample(x[:, :, ::2, ::2])
        return conv_norm(torch.cat(results, dim=1), self.conv3, self.bn3, residual=residual)


class Res2Net(StagedBackbone):
    """Three stages of Res2 blocks.

    Source: Res2Net, arXiv 1904.01169 (Gao et al.), in the form that DSRC uses: base width 26, scale 4, expansion 1, no
    stem, every stage with stride 2.
    """

    def __init__(
        self, inputs: int, channels: tuple[int, int, int], blocks: tuple[int, int, int], base_width: int
    ) -> None:
        widths = (inputs, *channels)
        super().__init__(
            [
                nn.Sequential(
                    *(
                        Res2Block(widths[k] if block == 0 else channels[k], channels[k], base_width, block == 0)
                        for block in range(blocks[k])
                    )
                )
                for k in range(3)
            ]
        )


class BasicBlock(nn.Module):
    """Basic residual block. Source: He et al., arXiv 1512.03385, Figure 5 left."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(outputs)
        changed = stride > 1 or inputs != outputs
        self.downsample = (
            ConvSequence(nn.Conv2d(inputs, outputs, 1, bias=False), nn.BatchNorm2d(outputs)) if changed else None
        )
        self.stride = stride

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, inputs, H, W) to (N, outputs, H / stride, W / stride)."""
        # Every second pixel first, see `Res2Block`.
        residual = x if self.downsample is None else self.downsample(x[:, :, :: self.stride, :: self.stride])
        return conv_norm(conv_norm(x, self.conv1, self.bn1), self.conv2, self.bn2, residual=residual)


def resnet(inputs: int, channels: tuple[int, int, int], blocks: tuple[int, int, int]) -> StagedBackbone:
    """Make stages of basic residual blocks, the first with stride 2. Source: CoAlign, arXiv 2211.07214, code."""
    widths = (inputs, *channels)
    return StagedBackbone(
        [
            nn.Sequential(
                BasicBlock(widths[k], channels[k], 2),
                *(BasicBlock(channels[k], channels[k], 1) for _ in range(blocks[k] - 1)),
            )
            for k in range(3)
        ]
    )


def plain(inputs: int, channels: tuple[int, int, int], blocks: tuple[int, int, int], momentum: float) -> StagedBackbone:
    """Make stages of `blocks` 3 x 3 convolutions after one of stride 2. Source: PointPillars, arXiv 1812.05784."""

    def layer(fro: int, to: int, stride: int) -> tuple[nn.Module, ...]:
        convolution = nn.Conv2d(fro, to, 3, stride=stride, padding=1, bias=False)
        return convolution, nn.BatchNorm2d(to, eps=1e-3, momentum=momentum), nn.ReLU(inplace=True)

    widths = (inputs, *channels)
    stages: list[nn.Module] = []
    for k in range(3):
        layers = [*layer(widths[k], channels[k], 2)]
        for _ in range(blocks[k]):
            layers += layer(channels[k], channels[k], 1)
        stages.append(ConvSequence(*layers))
    return StagedBackbone(stages)


BACKBONES: dict[str, Callable[[ModelSettings], nn.Module]] = {
    "res2net": lambda s: Res2Net(s.pillar_channels, s.stage_channels, s.stage_blocks, s.base_width),
    "resnet": lambda s: resnet(s.pillar_channels, s.stage_channels, s.stage_blocks),
    "plain": lambda s: plain(s.pillar_channels, s.stage_channels, s.stage_blocks, s.norm_momentum),
}
