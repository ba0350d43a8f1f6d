"""Convolution blocks of a detector: double convolution, upsampling, decoder, compressor."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dsrc.models.layers.conv_norm import ConvSequence


def double_conv(
    inputs: int, outputs: int, kernel: int = 3, stride: int = 1, norm_momentum: float | None = None
) -> ConvSequence:
    """Make two convolutions with ReLUs; the first has the kernel and the stride, the second is 3 x 3.

    Args:
        norm_momentum: momentum of a batch norm after each convolution; None without norms, as in the released code.
    """

    def layer(fro: int, kernel: int, stride: int) -> tuple[nn.Module, ...]:
        convolution = nn.Conv2d(fro, outputs, kernel, stride, kernel // 2, bias=norm_momentum is None)
        norm = () if norm_momentum is None else (nn.BatchNorm2d(outputs, eps=1e-3, momentum=norm_momentum),)
        return convolution, *norm, nn.ReLU(inplace=True)

    return ConvSequence(*layer(inputs, kernel, stride), *layer(outputs, 3, 1))


def upsample(inputs: int, outputs: int, stride: int, momentum: float) -> ConvSequence:
    """Make a transposed convolution to `stride` times the resolution, with batch norm and ReLU."""
    return ConvSequence(
        nn.ConvTranspose2d(inputs, outputs, stride, stride=stride, bias=False),
        nn.BatchNorm2d(outputs, eps=1e-3, momentum=momentum),
        nn.ReLU(inplace=True),
    )


class Decoder(nn.ModuleList):
    """Decoder: one layer of `upsample` per stage."""

    def forward(self, stages: Sequence[Tensor]) -> Tensor:
        """Concatenate the stages at one resolution, (N, sum of channels, h, w)."""
        # Measured on CPUs: in channels-last order these layers are 40 % slower in single precision, and faster in
        # bfloat16, as on a GPU.
        kept = stages[0].is_cuda or torch.is_autocast_enabled("cpu")
        ordered = (stage if kept else stage.contiguous() for stage in stages)
        return torch.cat([up(stage) for up, stage in zip(self, ordered, strict=True)], dim=1)


class Compressor(nn.Module):
    """Channel compressor of transmitted maps: 3 x 3 convolutions with batch norm at the sender and the receiver.

    Source: OPV2V, arXiv 2109.07644, Section IV (compression, sharing and decompression).
    """

    def __init__(self, channels: int, ratio: int) -> None:
        """Make a compressor.

        Args:
            ratio: channels of the map per channel sent.
        """
        super().__init__()
        self.encode = ConvSequence(*_conv_norm(channels, channels // ratio))
        self.decode = ConvSequence(*_conv_norm(channels // ratio, channels), *_conv_norm(channels, channels))

    def forward(self, x: Tensor) -> Tensor:
        """Compress and decompress (N, C, H, W)."""
        return self.decode(self.encode(x))


def _conv_norm(inputs: int, outputs: int) -> tuple[nn.Module, ...]:
    return (
        nn.Conv2d(inputs, outputs, 3, padding=1),
        nn.BatchNorm2d(outputs, eps=1e-3, momentum=0.01),
        nn.ReLU(inplace=True),
    )
