"""Products of bfloat16 tensors on a CPU without bfloat16: at the speed of float32, with the numbers of one that has it.

PyTorch computes them there in loops that take eight times as long as those of float32, and sum in bfloat16. Through
float32 the products are exact, the sums are of float32 and the result is rounded once, as with AVX512-BF16 and AMX.
"""

import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_map_only

from dsrc.models.device import BFLOAT16

Kernel = Callable[..., Any]


def half_products(wanted: bool) -> AbstractContextManager[None]:
    """Return a context for networks in bfloat16: `through_float32` where the CPU computes them and has no bfloat16.

    PyTorch below 2.9 cannot do so and takes its own loops.
    """
    missing = wanted and not BFLOAT16 and not torch.cuda.is_available()
    return through_float32() if missing and hasattr(torch.library, "get_kernel") else nullcontext()


@contextmanager
def through_float32() -> Iterator[None]:
    """Compute convolutions and matrix products of bfloat16 on CPUs through float32, in all threads of the process."""
    kernels = {name: torch.library.get_kernel(f"aten::{name}", "CPU").call_boxed for name in _THROUGH}
    with torch.library._scoped_library("aten", "IMPL") as library:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Warning only once for all operators", UserWarning)  # replaced on purpose
            for name, through in _THROUGH.items():
                library.impl(name, partial(through, kernels[name]), "CPU", with_keyset=True, allow_override=True)
        yield


def _product(kernel: Kernel, keys: Any, *inputs: Any, **named: Any) -> Any:
    if not _half(*inputs):
        return kernel(keys, *inputs, **named)
    return kernel(keys, *tree_map_only(Tensor, Tensor.float, inputs), **named).bfloat16()


def _convolution(kernel: Kernel, keys: Any, *inputs: Any) -> Any:
    x, weight, bias, *shape = inputs
    if not (_half(x) and _of_cells(x, weight, *shape)):
        return _product(kernel, keys, *inputs)
    cells, taken = _cells(x.float()), weight.float().flatten(1).t()
    out = cells @ taken if bias is None else torch.addmm(bias.float(), cells, taken)
    return _maps(out, x).bfloat16()


def _gradients(kernel: Kernel, keys: Any, *inputs: Any) -> Any:
    """Return the gradients of a convolution's input, weight and bias, None for those that are not wanted."""
    gradient, x, weight, bias, *shape, wanted = inputs
    if not _half(x):
        return kernel(keys, *inputs)
    gradient, x, weight = gradient.float(), x.float(), weight.float()
    if _of_cells(x, weight, *shape) and gradient.is_contiguous(memory_format=torch.channels_last):
        cells = _cells(gradient)
        of_input = _maps(cells @ weight.flatten(1), gradient) if wanted[0] else None
        of_weight = (cells.t() @ _cells(x)).view(weight.shape) if wanted[1] else None
        of_bias = cells.sum(0) if wanted[2] else None
    else:
        of_input = of_weight = of_bias = None
        if wanted[0]:
            of_input = kernel(keys, gradient, x, weight, bias, *shape, [True, False, False])[0]
        if wanted[1] or wanted[2]:
            # oneDNN takes half the time on AVX2 for the weights' where maps are contiguous, and more for the input's.
            flat = gradient.contiguous(), x.contiguous(), weight.contiguous()
            _, of_weight, of_bias = kernel(keys, *flat, bias, *shape, [False, *wanted[1:]])
    return tree_map_only(Tensor, Tensor.bfloat16, (of_input, of_weight, of_bias))


_THROUGH: dict[str, Kernel] = {
    "convolution": _convolution,
    "convolution_backward": _gradients,
    "mm": _product,
    "addmm": _product,
    "bmm": _product,
    "baddbmm": _product,
}


def _half(*inputs: Any) -> bool:
    return any(isinstance(x, Tensor) and x.dtype == torch.bfloat16 for x in inputs)


def _of_cells(x: Tensor, weight: Tensor, *shape: Any) -> bool:
    """Return whether a convolution takes each cell of channels-last maps by itself, as a matrix product does."""
    stride, padding, _, transposed, _, groups = shape
    alone = weight.shape[2:] == (1, 1) and max(stride) == 1 and max(padding) == 0
    return alone and not transposed and groups == 1 and x.is_contiguous(memory_format=torch.channels_last)


def _cells(maps: Tensor) -> Tensor:
    """(N*H*W, C) view of channels-last maps (N, C, H, W)."""
    return maps.permute(0, 2, 3, 1).flatten(0, 2)


def _maps(cells: Tensor, like: Tensor) -> Tensor:
    """Channels-last maps (N, C, H, W) of cells, with the N, H and W of other maps."""
    count, _, height, width = like.shape
    return cells.view(count, height, width, -1).permute(0, 3, 1, 2)
