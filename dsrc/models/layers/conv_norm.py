"""Convolution, batch norm, shortcut and ReLU as one layer while training, in as few operations as they need.

The numbers are those of the single layers. What goes is what PyTorch does between them: maps of their own, counters and
records for the backward pass, each of them an operation that the host has to dispatch.
"""

from typing import Any

import torch
from torch import Tensor, nn

Conv = nn.Conv2d | nn.Conv3d | nn.ConvTranspose2d | nn.ConvTranspose3d
Norm = nn.BatchNorm2d | nn.BatchNorm3d
_aten = torch.ops.aten


def conv_norm(x: Tensor, conv: Conv, norm: Norm, relu: bool = True, residual: Tensor | None = None) -> Tensor:
    """Return `relu(norm(conv(x)) + residual)`.

    Args:
        x: (N, C, ...) maps.
        residual: a map of the output's shape; None for none.
    """
    if norm.training and norm.momentum is not None:
        return _ConvNorm.apply(x, conv.weight, conv.bias, norm.weight, norm.bias, residual, conv, norm, relu)
    out = norm(conv(x))
    if residual is not None:
        out += residual
    return out.relu_() if relu else out


class ConvSequence(nn.Sequential):
    """Sequence of layers which joins a convolution with the batch norm and the ReLU that follow it."""

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, C, ...)."""
        layers, at = list(self), 0
        while at < len(layers):
            layer, after = layers[at], [*layers[at + 1 : at + 3], None, None]
            if isinstance(layer, Conv) and isinstance(after[0], Norm):
                relu = isinstance(after[1], nn.ReLU)
                x = conv_norm(x, layer, after[0], relu)
                at += 3 if relu else 2
            else:
                x = layer(x)
                at += 1
        return x


def count_batch(module: nn.Module) -> None:
    """Count a batch in the norms below a module that are in training, all in one operation."""
    norms = (m for m in module.modules() if isinstance(m, nn.modules.batchnorm._BatchNorm) and m.training)
    counts = [n.num_batches_tracked for n in norms if n.num_batches_tracked is not None and n.momentum is not None]
    if counts:
        torch._foreach_add_(counts, 1)


class _ConvNorm(torch.autograd.Function):
    """`conv_norm` in training, with its gradient."""

    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        weight: Tensor,
        bias: Tensor | None,
        scale: Tensor,
        shift: Tensor,
        residual: Tensor | None,
        conv: Conv,
        norm: Norm,
        relu: bool,
    ) -> Tensor:
        kind = x.device.type
        dtype = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else weight.dtype
        x, kernel = x.to(dtype), weight.to(dtype)
        ctx.shape = (
            list(conv.stride),
            list(conv.padding),
            list(conv.dilation),
            conv.transposed,
            list(conv.output_padding),
            conv.groups,
        )
        between = _aten.convolution(x, kernel, None if bias is None else bias.to(dtype), *ctx.shape)
        statistics = norm.running_mean, norm.running_var
        momentum: Any = norm.momentum  # None is left to the layers themselves
        out, mean, deviation = torch.native_batch_norm(between, scale, shift, *statistics, True, momentum, norm.eps)
        if residual is not None:
            out.add_(residual)
        if relu:
            out.relu_()
        ctx.save_for_backward(x, kernel, between, scale, mean, deviation, *((out,) if relu else ()))
        ctx.norm, ctx.bias = norm, None if bias is None else list(bias.shape)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        x, kernel, between, scale, mean, deviation, *out = ctx.saved_tensors
        after = _aten.threshold_backward(gradients[0], out[0], 0) if out else gradients[0]
        inner, scale_gradient, shift_gradient = _aten.native_batch_norm_backward(
            after, between, scale, None, None, mean, deviation, True, ctx.norm.eps, [True, True, True]
        )
        wanted = [ctx.needs_input_grad[0], True, ctx.bias is not None]
        x_gradient, weight_gradient, bias_gradient = _aten.convolution_backward(
            inner, x, kernel, ctx.bias, *ctx.shape, wanted
        )
        residual = after if ctx.needs_input_grad[5] else None
        return x_gradient, weight_gradient, bias_gradient, scale_gradient, shift_gradient, residual, None, None, None
