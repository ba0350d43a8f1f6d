"""Window attention over the cells of all agents, shared by CoBEVT, ERMVP and V2X-ViT."""

import torch
from torch import Tensor, nn
from torch.nn import functional

# Legend: A agents, H W map, w side of a window, G windows, C channels, L most agents.


class Dropout(nn.Dropout):
    """Dropout by random bytes on a CPU, in a quarter of the time; the share is the nearest multiple of 1 / 256.

    Where that is 0 or 1, and on other devices, it is PyTorch's own.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Drop values in training, and scale the others up."""
        dropped = round(256 * self.p)
        if not self.training or not 0 < dropped < 256 or x.device.type != "cpu":
            return super().forward(x)
        words = torch.empty((x.numel() + 7) // 8, dtype=torch.int64, device=x.device).random_(-(2**63), None)
        kept = words.view(torch.uint8)[: x.numel()].view(x.shape) >= dropped
        return x * kept.to(x.dtype).mul_(256 / (256 - dropped))


class FeedForward(nn.Sequential):
    """Feed-forward layers: linear, GELU, linear, with dropout."""

    def __init__(self, channels: int, hidden: int, dropout: float) -> None:
        super().__init__(
            nn.Linear(channels, hidden),
            nn.GELU(),
            Dropout(dropout),
            nn.Linear(hidden, channels),
            Dropout(dropout),
        )


class Residual(nn.Module):
    """Residual layer with norm first."""

    def __init__(self, channels: int, inner: nn.Module) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(channels)
        self.inner = inner

    def forward(self, x: Tensor, *args: Tensor | None) -> Tensor:
        """Map (..., C) to (..., C)."""
        return x + self.inner(self.norm(x), *args)


class AgentWindows(nn.Module):
    """Multi-head window attention over all agents' cells, with a learned bias per relative place and agent.

    Args:
        agents: L, number of agents that a bias is learned for.
        window: side of a window, cells.
        spread: windows of cells spread evenly over the map, not of neighbours.
    """

    def __init__(
        self, channels: int, heads: int, agents: int, window: int, dropout: float, spread: bool = False
    ) -> None:
        super().__init__()
        self.heads, self.window, self.spread = heads, window, spread
        self.place: Tensor
        self.qkv = nn.Linear(channels, 3 * channels, bias=False)
        self.out = nn.Linear(channels, channels, bias=False)
        self.dropout = Dropout(dropout)
        self.bias = nn.Parameter(torch.randn((2 * agents - 1) * (2 * window - 1) ** 2, heads) * 0.02)
        self.register_buffer("place", relative_place(agents, window), persistent=False)

    def forward(self, x: Tensor, valid: Tensor | None) -> Tensor:
        """Attend in (A, H, W, C) normalised features; `valid` (A, H, W) masks the keys, None for all."""
        tokens = cut(x, self.window, self.spread)
        query, key, value = in_heads(self.qkv(tokens), 3, self.heads)
        mask = window_mask(self.bias, self.place, len(x), self.window, valid, self.spread)
        found = attention(query, key, value, mask)
        joined = self.dropout(self.out(found.transpose(1, 2).flatten(2)))
        return paste(joined, tuple(x.shape), self.window, self.spread)


def attention(query: Tensor, key: Tensor, value: Tensor, mask: Tensor) -> Tensor:
    """Return (G, heads, T, P) values by softmax of the scores of queries and keys, to which a mask is added.

    In no row is all of the mask -inf. In a training on a CPU it is written out: there PyTorch's own goes through single
    precision for a mask with a gradient, and looks for queries without any key.
    """
    if query.device.type != "cpu" or not torch.is_grad_enabled():
        return functional.scaled_dot_product_attention(query, key, value, attn_mask=mask)
    scores = torch.matmul(query * query.shape[-1] ** -0.5, key.transpose(-1, -2)) + mask
    return torch.matmul(torch.softmax(scores, dim=-1).to(value.dtype), value)


def relative_place(agents: int, window: int) -> Tensor:
    """Return the (L w^2, L w^2) row of the bias table for each pair of cells: difference of agent, row and column."""
    axes = [torch.arange(n) for n in (agents, window, window)]
    place = torch.stack(torch.meshgrid(*axes, indexing="ij")).flatten(1)
    agent, row, column = place[:, :, None] - place[:, None]
    side = 2 * window - 1
    return ((agent + agents - 1) * side + row + window - 1) * side + column + window - 1


def window_mask(bias: Tensor, place: Tensor, agents: int, window: int, valid: Tensor | None, spread: bool) -> Tensor:
    """Return the (1 or G, heads, A w^2, A w^2) bias and mask that is added to the scores of A agents' cells."""
    cells = agents * window**2
    added = bias[place[:cells, :cells]].permute(2, 0, 1)[None]
    if valid is None:
        return added
    seen = cut(valid[..., None], window, spread)[:, None, None, :, 0]
    # A window without valid cells keeps its scores: its cells are cropped later, and must not become NaN.
    seen = seen | ~seen.any(-1, keepdim=True)
    return added.masked_fill(~seen, -torch.inf)


def in_heads(x: Tensor, parts: int, heads: int) -> list[Tensor]:
    """Split (G, T, parts C) into (G, heads, T, C / heads) each."""
    return [part.unflatten(-1, (heads, -1)).transpose(1, 2) for part in x.chunk(parts, dim=-1)]


def cut(x: Tensor, window: int, spread: bool = False) -> Tensor:
    """Cut (A, H, W, C) into (G, A w^2, C) windows."""
    agents, height, width, channels = x.shape
    if spread:
        parts = x.reshape(agents, window, height // window, window, width // window, channels).permute(2, 4, 0, 1, 3, 5)
    else:
        parts = x.reshape(agents, height // window, window, width // window, window, channels).permute(1, 3, 0, 2, 4, 5)
    return parts.reshape(-1, agents * window**2, channels)


def paste(parts: Tensor, shape: tuple[int, ...], window: int, spread: bool = False) -> Tensor:
    """Join windows of `cut` to the (A, H, W, C) map."""
    agents, height, width, channels = shape
    rows, columns = height // window, width // window
    x = parts.reshape(rows, columns, agents, window, window, channels)
    return x.permute((2, 3, 0, 4, 1, 5) if spread else (2, 0, 3, 1, 4, 5)).reshape(shape)


def padded(x: Tensor, multiple: int) -> tuple[Tensor, Tensor | None]:
    """Pad (A, H, W, C) with zeros to multiples of cells; the (A, H', W') mask of real cells is None without padding."""
    agents, height, width, _ = x.shape
    below, right = -height % multiple, -width % multiple
    if not below and not right:
        return x, None
    valid = torch.zeros((agents, height + below, width + right), dtype=torch.bool, device=x.device)
    valid[:, :height, :width] = True
    return functional.pad(x, (0, 0, 0, right, 0, below)), valid
