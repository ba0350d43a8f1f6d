"""Devices and threads of torch."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from typing import Self

import torch
from torch import Tensor


class Movable:
    """Base of dataclasses of tensors, and of other such dataclasses."""

    __slots__ = ()

    def to(self, device: torch.device | str) -> Self:
        """Move the tensors to a device."""
        parts = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        moved = {name: part.to(device) for name, part in parts.items() if isinstance(part, Tensor | Movable)}
        return replace(self, **moved)  # type: ignore[type-var]


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread: the number of threads changes the last digits of a network's numbers."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
