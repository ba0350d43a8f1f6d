"""Backbones: three stages, each at half the resolution of the one before; DSRC's is `res2net`."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsrc.models.layers.conv_norm import ConvSequence, ahead, back, conv_norm, grouped, joinable, weights
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
        return _res2(self, x, lambda *parts: (conv_norm(*parts), ()))[0]

    def pairs(self) -> list[Any]:
        """Return the convolutions with their norms: of the splits, of the entry, of the end, of the shortcut."""
        ends = [(self.conv1, self.bn1), (self.conv3, self.bn3)]
        shortcut = [] if self.downsample is None else [tuple(self.downsample)]
        return [*zip(self.convs, self.bns, strict=True), *ends, *shortcut]


def _res2(block: Res2Block, x: Tensor, layer: Callable[..., tuple[Tensor, Any]]) -> tuple[Tensor, list[Any]]:
    """Return a block's output, and what its layers save, in the order of its pairs."""
    *inner, enter, leave = block.pairs()[: _SPLITS + 1]
    wide, entered = layer(x, *enter)
    splits = wide.chunk(_SPLITS, dim=1)
    results: list[Tensor] = []
    saved: list[Any] = []
    for pair, split in zip(inner, splits[:-1], strict=True):
        result, parts = layer(split if block.first or not results else results[-1] + split, *pair)
        results.append(result)
        saved.append(parts)
    results.append(functional.avg_pool2d(splits[-1], 3, 2, 1) if block.first else splits[-1])
    # Every second pixel first, then the convolution: with a stride of its own, the weight gradient of a 1 x 1
    # convolution with few channels in channels-last order writes beyond its buffer (oneDNN 3.12, AVX-512).
    shortcut = (x, None) if block.downsample is None else layer(x[:, :, ::2, ::2], *block.downsample, False)
    out, left = layer(torch.cat(results, dim=1), *leave, True, shortcut[0])
    return out, [*saved, entered, left, *([] if block.downsample is None else shortcut[1:])]


def _res2_back(
    block: Res2Block, gradient: Tensor, saved: Sequence[Any], wanted: bool
) -> tuple[Tensor, list[tuple[Tensor | None, ...]]]:
    """Return the gradients of a block's input, if wanted, and of the weights of its pairs."""
    pairs = block.pairs()
    of_weights: list[Any] = [None] * len(pairs)

    def through(gradient: Tensor, place: int, wants_input: bool = True) -> tuple[Tensor, Tensor]:
        conv, norm = pairs[place]
        after, of_input, of_weights[place] = back(gradient, saved[place], conv, norm, wants_input)
        return after, of_input

    entry, end, shortcut = _SPLITS - 1, _SPLITS, _SPLITS + 1
    after, joined = through(gradient, end)
    parts = list(joined.chunk(_SPLITS, dim=1))
    for split in reversed(range(_SPLITS - 1)):
        _, parts[split] = through(parts[split], split)
        if split and not block.first:
            parts[split - 1] = parts[split - 1] + parts[split]
    if block.first:
        pooled = saved[entry][-1].chunk(_SPLITS, dim=1)[-1]
        parts[-1] = torch.ops.aten.avg_pool2d_backward(parts[-1], pooled, [3], [2], [1], False, True, None)
    _, of_x = through(torch.cat(parts, dim=1), entry, wanted)
    beside = after if block.downsample is None else through(after, shortcut, wanted)[1]
    if wanted:
        (of_x if block.downsample is None else of_x[:, :, ::2, ::2]).add_(beside)
    return of_x, of_weights


class _Res2(torch.autograd.Function):
    """Res2 blocks in training with their gradients: slices and sums of splits need no records of their own."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, blocks: Sequence[Res2Block], *weights: Tensor) -> Tensor:
        saved: list[Any] = []
        for block in blocks:
            x, parts = _res2(block, x, ahead)
            saved += parts
        ctx.save_for_backward(*(part for parts in saved for part in parts))
        ctx.blocks = blocks
        return x

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        gradient, saved = gradients[0], grouped(ctx.saved_tensors)
        of_weights: list[tuple[Tensor | None, ...]] = []
        for number, block in reversed(list(enumerate(ctx.blocks))):
            count = len(block.pairs())
            own, saved = saved[-count:], saved[:-count]
            gradient, of_block = _res2_back(block, gradient, own, number > 0 or ctx.needs_input_grad[0])
            of_weights = [*of_block, *of_weights]
        return gradient, None, *(part for parts in of_weights for part in parts)


class Res2Stage(nn.Sequential):
    """Res2 blocks of one resolution, in training as one layer."""

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, inputs, H, W) to (N, outputs, H / 2, W / 2)."""
        blocks: list[Any] = list(self)
        pairs = [pair for block in blocks for pair in block.pairs()]
        if joinable(*(norm for _, norm in pairs)):
            return _Res2.apply(x, blocks, *(weight for pair in pairs for weight in weights(*pair)))
        return super().forward(x)


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
                Res2Stage(
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
