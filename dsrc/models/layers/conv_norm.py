"""Convolution, batch norm, shortcut and ReLU as one layer while training, in as few operations as they need.

The numbers are those of the single layers. What goes is what PyTorch does between them: maps of their own, counters and
records for the backward pass, each of them an operation that the host has to dispatch.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

Conv = nn.Conv2d | nn.Conv3d | nn.ConvTranspose2d | nn.ConvTranspose3d
Norm = nn.BatchNorm2d | nn.BatchNorm3d
Layer = tuple[Conv, Norm, bool]
"""Convolution, norm, and whether a ReLU follows."""
_aten = torch.ops.aten
_SAVED = 7


def conv_norm(x: Tensor, conv: Conv, norm: Norm, relu: bool = True, residual: Tensor | None = None) -> Tensor:
    """Return `relu(norm(conv(x)) + residual)`.

    Args:
        x: (N, C, ...) maps.
        residual: a map of the output's shape; None for none.
    """
    if joinable(norm):
        return _ConvNorms.apply(x, residual, [(conv, norm, relu)], *weights(conv, norm))
    out = norm(conv(x))
    if residual is not None:
        out += residual
    return out.relu_() if relu else out


class ConvSequence(nn.Sequential):
    """Sequence of layers which joins a convolution with the batch norm and the ReLU that follow it."""

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, C, ...)."""
        layers, at = list(self), 0
        run: list[Layer] = []
        while at < len(layers):
            layer, after = layers[at], [*layers[at + 1 : at + 3], None, None]
            if isinstance(layer, Conv) and isinstance(after[0], Norm) and joinable(after[0]):
                run.append((layer, after[0], isinstance(after[1], nn.ReLU)))
                at += 3 if run[-1][2] else 2
            else:
                x = layer(_joined(x, run))
                run = []
                at += 1
        return _joined(x, run)


def _joined(x: Tensor, run: list[Layer]) -> Tensor:
    """Map (N, C, ...) by layers in training."""
    return _ConvNorms.apply(x, None, run, *(w for conv, norm, _ in run for w in weights(conv, norm))) if run else x


def count_batch(module: nn.Module) -> None:
    """Count a batch in the norms below a module that are in training, all in one operation."""
    norms = (m for m in module.modules() if isinstance(m, nn.modules.batchnorm._BatchNorm) and m.training)
    counts = [n.num_batches_tracked for n in norms if n.num_batches_tracked is not None and n.momentum is not None]
    if counts:
        torch._foreach_add_(counts, 1)


def joinable(*norms: nn.Module) -> bool:
    """Return whether batch norms take the statistics of the batch and average them, so that `ahead` computes them."""
    return all(isinstance(norm, Norm) and norm.training and norm.momentum is not None for norm in norms)


def ahead(
    x: Tensor, conv: Conv, norm: Norm, relu: bool = True, residual: Tensor | None = None
) -> tuple[Tensor, tuple[Tensor | None, ...]]:
    """Return `conv_norm` in training without a record of autograd, and the tensors for `back`."""
    kind = x.device.type
    dtype = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else conv.weight.dtype
    x, kernel = x.to(dtype), conv.weight.to(dtype)
    between = _aten.convolution(x, kernel, None if conv.bias is None else conv.bias.to(dtype), *_shape(conv))
    statistics = norm.running_mean, norm.running_var
    momentum: Any = norm.momentum  # None is left to the layers themselves
    parts = between, norm.weight, norm.bias, *statistics, True, momentum, norm.eps
    out, mean, deviation = torch.native_batch_norm(*parts)
    if residual is not None:
        out.add_(residual)
    if relu:
        out.relu_()
    return out, (x, kernel, between, norm.weight, mean, deviation, out if relu else None)


def grouped(saved: Sequence[Any]) -> list[tuple[Any, ...]]:
    """Return the saved tensors of several layers, layer by layer."""
    return [tuple(saved[start : start + _SAVED]) for start in range(0, len(saved), _SAVED)]


def back(
    gradient: Tensor, saved: Sequence[Any], conv: Conv, norm: Norm, wants_input: bool = True
) -> tuple[Tensor, Any, tuple[Tensor | None, ...]]:
    """Return the gradients of the residual, of the input (None if not wanted), and of `weights`."""
    x, kernel, between, scale, mean, deviation, out = saved
    after = gradient if out is None else _aten.threshold_backward(gradient, out, 0)
    inner, *of_norm = _aten.native_batch_norm_backward(
        after, between, scale, None, None, mean, deviation, True, norm.eps, [True, True, True]
    )
    bias = None if conv.bias is None else list(conv.bias.shape)
    wanted = [wants_input, True, bias is not None]
    of_input, of_kernel, of_bias = _aten.convolution_backward(inner, x, kernel, bias, *_shape(conv), wanted)
    return after, of_input, (of_kernel, of_bias, *of_norm)


def weights(conv: Conv, norm: Norm) -> tuple[Tensor | None, ...]:
    """Return the weights of the two layers in the order of their gradients."""
    return conv.weight, conv.bias, norm.weight, norm.bias


def _shape(conv: Conv) -> tuple[Any, ...]:
    sides = (list(side) for side in (conv.stride, conv.padding, conv.dilation))
    return *sides, conv.transposed, list(conv.output_padding), conv.groups


class _ConvNorms(torch.autograd.Function):
    """Convolutions with norms in training, one after the other, with their gradients."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, residual: Tensor | None, layers: Sequence[Layer], *weights: Tensor) -> Tensor:
        saved: list[Tensor | None] = []
        for number, (conv, norm, relu) in enumerate(layers, start=1):
            x, parts = ahead(x, conv, norm, relu, residual if number == len(layers) else None)
            saved += parts
        ctx.save_for_backward(*saved)
        ctx.layers = layers
        return x

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        gradient, saved = gradients[0], grouped(ctx.saved_tensors)
        residual, of_weights = None, []
        for number, (conv, norm, _) in reversed(list(enumerate(ctx.layers))):
            wanted = number > 0 or ctx.needs_input_grad[0]
            after, gradient, of_layer = back(gradient, saved[number], conv, norm, wanted)
            of_weights.append(of_layer)
            residual = after if residual is None else residual
        of_residual = residual if ctx.needs_input_grad[1] else None
        return gradient, of_residual, None, *(part for parts in reversed(of_weights) for part in parts)
