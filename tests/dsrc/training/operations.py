"""What PyTorch dispatches, and which of it makes the host wait for a device."""

from collections import Counter
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

WAITS = (
    *("aten.nonzero", "aten._local_scalar_dense", "aten.item", "aten.masked_select", "aten.unique", "aten._unique"),
    *("aten.bincount", "aten.equal", "aten.repeat_interleave.Tensor", "by a mask"),
)


class Operations(TorchDispatchMode):
    """Counts what PyTorch dispatches, the backward pass included."""

    def __init__(self) -> None:
        super().__init__()
        self.count: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count[str(func)] += 1
        # Rows of a mask are searched as by `nonzero`.
        rows = args[1] if str(func).startswith(("aten.index.", "aten.index_put")) else ()
        if any(isinstance(part, Tensor) and part.dtype == torch.bool for part in rows):
            self.count[f"by a mask: {func}"] += 1
        return func(*args, **(kwargs or {}))

    def waits(self) -> list[str]:
        return [name for name in self.count if name.startswith(WAITS)]
