"""Devices and threads of torch."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from typing import Any, Self

import torch
from torch import Tensor

BFLOAT16 = torch.backends.mkldnn.is_available() and bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
"""Whether the processor computes convolutions in bfloat16."""


class Movable:
    """Base of dataclasses of tensors, and of other such dataclasses."""

    __slots__ = ()

    def to(self, device: torch.device | str, non_blocking: bool = False) -> Self:
        """Move the tensors to a device; pinned ones beside what it computes, if not blocking."""
        return self._changed(lambda part: part.to(device, non_blocking=non_blocking))

    def pin_memory(self) -> Self:
        """Move the tensors to memory that a GPU reads by itself; called by PyTorch's loaders."""
        return self._changed(lambda part: part.pin_memory())

    def _changed(self, change: Callable[[Any], Any]) -> Self:
        parts = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        changed = {name: change(part) for name, part in parts.items() if isinstance(part, Tensor | Movable)}
        return replace(self, **changed)  # type: ignore[type-var]


def on_device(tensor: Tensor, device: torch.device) -> Tensor:
    """Move a tensor; to a GPU from pinned memory, or the host would wait for it."""
    return (tensor.pin_memory() if device.type == "cuda" else tensor).to(device, non_blocking=True)


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread: the number of threads changes the last digits of a network's numbers."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
