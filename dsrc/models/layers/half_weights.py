"""Weights of convolutions in half precision: cast in one operation per step instead of two per layer."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from dsrc.models.layers.conv_norm import Conv


class HalfWeights:
    """Weights of a module's convolutions in bfloat16 whose gradients reach the single-precision ones.

    Fusion methods are left out: parts of them compute in single precision.
    """

    def __init__(self, module: nn.Module, flat: bool = False) -> None:
        """Choose the weights.

        Args:
            flat: the module's maps are (N, C, H, W), and on a CPU its weights make them channels-last: faster there,
                see `benchmarks`, and not measured on GPUs.
        """
        self.module = module
        self.weights = {
            f"{place}.{name}": weight
            for place, layer in module.named_modules()
            if isinstance(layer, Conv) and not place.startswith("fusion")
            for name, weight in layer.named_parameters()
            if weight.requires_grad
        }
        self.empty = [
            torch.empty_like(
                weight,
                dtype=torch.bfloat16,
                memory_format=torch.channels_last
                if flat and weight.ndim == 4 and not weight.is_cuda
                else torch.preserve_format,
            )
            for weight in self.weights.values()
        ]

    def __call__(self, *inputs: Any) -> Any:
        """Run the module with its weights in bfloat16."""
        cast = _Cast.apply(self.empty, *self.weights.values())
        return functional_call(self.module, dict(zip(self.weights, cast, strict=True)), inputs)


class _Cast(torch.autograd.Function):
    """Cast of many tensors to the types of `empty` and of their gradients back, each in one operation."""

    @staticmethod
    def forward(ctx: Any, empty: list[Tensor], *weights: Tensor) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        ctx.weights = weights
        return tuple(torch.ops.aten._foreach_copy.default(empty, list(weights)))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        known = [
            (weight, gradient) for weight, gradient in zip(ctx.weights, gradients, strict=True) if gradient is not None
        ]
        whole = iter(torch.ops.aten._foreach_copy.default([w for w, _ in known], [g for _, g in known]))
        return None, *(None if gradient is None else next(whole) for gradient in gradients)
