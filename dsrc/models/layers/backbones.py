"""Backbones: three stages, each at half the resolution of the one before; DSRC's is `res2net`."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from dsrc.models.layers.res2net import Res2Net
from dsrc.models.settings import ModelSettings


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
            nn.Sequential(nn.Conv2d(inputs, outputs, 1, bias=False), nn.BatchNorm2d(outputs)) if changed else None
        )
        self.stride = stride

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, inputs, H, W) to (N, outputs, H / stride, W / stride)."""
        out = self.bn2(self.conv2(torch.relu(self.bn1(self.conv1(x)))))
        # Every second pixel first, see `Res2Block`.
        residual = x if self.downsample is None else self.downsample(x[:, :, :: self.stride, :: self.stride])
        return torch.relu(out + residual)


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
        stages.append(nn.Sequential(*layers))
    return StagedBackbone(stages)


BACKBONES: dict[str, Callable[[ModelSettings], nn.Module]] = {
    "res2net": lambda s: Res2Net(s.pillar_channels, s.stage_channels, s.stage_blocks, s.base_width),
    "resnet": lambda s: resnet(s.pillar_channels, s.stage_channels, s.stage_blocks),
    "plain": lambda s: plain(s.pillar_channels, s.stage_channels, s.stage_blocks, s.norm_momentum),
}
