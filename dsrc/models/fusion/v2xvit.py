"""V2X-ViT: vision transformer with separate weights for vehicles and roadside units."""

import math
from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor, nn

from dsrc.models.fusion.base import AgentLayout, Fusion, zeroed
from dsrc.models.fusion.warp import about_centre, in_cells, shifted
from dsrc.models.fusion.windows import Dropout, FeedForward, Residual, attention, cut, in_heads, padded, paste
from dsrc.models.settings import ModelSettings

# Legend: A agents of a sample, H W map, C channels, M heads, P Q channels of a head, T kinds of agents.


class V2XViT(Fusion):
    """Heterogeneous attention over agents, then windows of three sizes, (N, C, H, W) to (B, C, H, W).

    Source: V2X-ViT, arXiv 2203.10638, Section 3 and Figure 2: an embedding of each agent's delay (3.2), features moved
    to where the ego now is (STCM), then three blocks of heterogeneous multi-agent attention (HMSA, Equations 2 to 6),
    multi-scale windows of 4, 8 and 16 cells (MSwin) joined by split attention, and a feed-forward layer. Attention over
    agents is masked outside the other's map. A map that windows do not divide is padded with masked cells, and cropped
    again.

    Start: identity. Every block is residual and the ego's features are read: the last layer of each branch, and that of
    the delay, start at zero.

    Released (OpenCOOD): three channels of prior knowledge (speed, delay, kind) ride on the features; the layer that
    would read them is never called, so speed has no effect, and here only delay and kind exist. Absent agents are zeros
    without effect on others and are left out here, and the last block runs for the ego alone. Without delay nothing
    moves and all cells are visible. Samples carry no ages of messages, so the delay is 0 in trainings and evaluations.
    """

    place = "map"
    start = "identity"

    def __init__(
        self,
        channels: int,
        depth: int = 3,
        heads: int = 8,
        windows: tuple[tuple[int, int], ...] = ((4, 16), (8, 8), (16, 4)),
        hidden: int | None = None,
        dropout: float = 0.3,
        widths: tuple[int, ...] | None = None,
    ) -> None:
        """Make the blocks.

        Args:
            heads: heads of the attention over agents.
            windows: side and heads of each size of windows.
            hidden: width of the feed-forward layers; None is that of the maps.
            widths: heads times channels of a head, of the attention over agents and of each size of windows; None is
                that of the maps.
        """
        super().__init__()
        over_agents, *in_windows = widths or (channels,) * (1 + len(windows))
        self.delay = zeroed(nn.Linear(channels, channels))
        self.blocks = nn.ModuleList(
            nn.ModuleDict(
                {
                    "agents": AgentAttention(channels, heads, dropout, over_agents),
                    "windows": Residual(channels, MultiScaleWindows(channels, windows, dropout, in_windows)),
                    "feed": Residual(channels, FeedForward(channels, hidden or channels, dropout)),
                }
            )
            for _ in range(depth)
        )
        for module in self.blocks.modules():
            if isinstance(module, AgentAttention | WindowAttention):
                zeroed(module.out)
            elif isinstance(module, FeedForward):
                zeroed(module[-2])

    @classmethod
    def from_settings(cls, settings: ModelSettings) -> Self:
        """Make the fusion of a detector with these settings."""
        return cls(settings.shrink_channels, widths=settings.attention_widths)

    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        """Fuse the maps."""
        start, rows = 0, []
        for sample, group in enumerate(layout.split(features)):
            rows.append(self._ego(group, layout, sample, slice(start, start + len(group))))
            start += len(group)
        return torch.stack(rows)

    def _ego(self, group: Tensor, layout: AgentLayout, sample: int, rows: slice) -> Tensor:
        """Return the ego's (C, H, W) of one sample's (A, C, H, W)."""
        zeros = torch.zeros(len(group), dtype=torch.long, device=group.device)
        delay = zeros if layout.delay is None else layout.delay[rows]
        kind = zeros if layout.roadside is None else layout.roadside[rows].long()
        x = group + self.delay(delay_code(delay, group.shape[1]).to(group.dtype))[:, :, None, None]
        x, seen = self.moved(x, layout, sample)
        x = x.permute(0, 2, 3, 1)
        for number, block in enumerate(self.blocks, start=1):
            layers: nn.ModuleDict = block  # type: ignore[assignment]
            wanted = 1 if number == len(self.blocks) else len(x)
            x = layers["agents"](x, kind, seen, wanted)
            x = layers["feed"](layers["windows"](x))
        return x[0].permute(2, 0, 1)

    def moved(self, x: Tensor, layout: AgentLayout, sample: int) -> tuple[Tensor, Tensor | None]:
        """Return (A, C, H, W) in the ego's frame and the (A, H, W) mask of its cells that each agent's map covers."""
        if layout.pairwise is None:
            return x, None
        size = (x.shape[-2], x.shape[-1])
        motion = about_centre(in_cells(layout.pairwise[sample, : len(x), 0].double(), layout, size), size)
        seen = shifted(torch.ones_like(x[:, :1]), motion, "nearest")[:, 0] > 0
        return torch.cat([x[:1], shifted(x[1:], motion[1:])]) if len(x) > 1 else x, seen


def delay_code(delay: Tensor, channels: int) -> Tensor:
    """Return (A, C) sinusoids of twice the (A,) delays in frames."""
    wave = torch.exp(torch.arange(0, channels, 2, device=delay.device) * -(math.log(10000.0) / channels))
    angle = 2.0 * delay[:, None] * wave
    return torch.stack([angle.sin(), angle.cos()], dim=-1).flatten(1)[:, :channels] / math.sqrt(channels)


class AgentAttention(nn.Module):
    """Per-cell attention over agents with weights by the kinds of both, Equations 2 to 6 of V2X-ViT.

    Norm first, residual.
    """

    def __init__(self, channels: int, heads: int, dropout: float, width: int, kinds: int = 2) -> None:
        super().__init__()
        each = width // heads
        self.heads, self.kinds, self.scale = heads, kinds, each**-0.5
        self.norm = nn.LayerNorm(channels)
        ends = (channels, width), (channels, width), (channels, width), (width, channels)
        self.query, self.key, self.value, self.out = (
            nn.ModuleList(nn.Linear(*sizes) for _ in range(kinds)) for sizes in ends
        )
        self.relation_score = nn.Parameter(torch.zeros(kinds**2, heads, each, each))
        self.relation_message = nn.Parameter(torch.zeros(kinds**2, heads, each, each))
        nn.init.xavier_uniform_(self.relation_score)
        nn.init.xavier_uniform_(self.relation_message)
        self.dropout = Dropout(dropout)

    def forward(self, x: Tensor, kind: Tensor, seen: Tensor | None, wanted: int) -> Tensor:
        """Attend.

        Args:
            x: (A, H, W, C).
            kind: (A,) int64, 0 for vehicles and 1 for roadside units.
            seen: (A, H, W) bool cells of the ego that an agent's map covers; None for all.
            wanted: number of first agents whose results are computed.

        Returns:
            (wanted, H, W, C).
        """
        height, width = x.shape[1:3]
        tokens = self.norm(x).flatten(1, 2)
        query = self._per_kind(self.query, tokens[:wanted], kind)
        key, value = (self._per_kind(layers, tokens, kind) for layers in (self.key, self.value))
        hidden = None if seen is None else ~seen.flatten(1).T[:, None, None]
        kinds = kind[:wanted].tolist()
        by_row: dict[int, Tensor] = {}
        for own_kind in sorted(set(kinds)):
            rows = [row for row, one in enumerate(kinds) if one == own_kind]
            relation = own_kind * self.kinds + kind
            related = torch.einsum("ampq,atmq->tmpa", self.relation_score[relation], key)
            message = torch.einsum("ampc,atmp->tmac", self.relation_message[relation], value)
            score = torch.matmul(query[rows].permute(1, 2, 0, 3), related) * self.scale
            if hidden is not None:
                score = score.masked_fill(hidden, -torch.inf)
            attended = torch.matmul(torch.softmax(score, dim=-1).to(message.dtype), message)
            by_row |= zip(rows, attended.unbind(2), strict=True)
        results = torch.stack([by_row[row] for row in range(wanted)])
        found = self._joined(self.out, results.flatten(2), kind)
        return x[:wanted] + self.dropout(found).unflatten(1, (height, width))

    def _per_kind(self, layers: nn.ModuleList, tokens: Tensor, kind: Tensor) -> Tensor:
        """Return (A, H W, M, P)."""
        return self._joined(layers, tokens, kind).unflatten(-1, (self.heads, -1))

    def _joined(self, layers: nn.ModuleList, tokens: Tensor, kind: Tensor) -> Tensor:
        """Apply the layer of its kind to each agent's tokens."""
        if len(kinds := set(kind[: len(tokens)].tolist())) == 1:
            return layers[kinds.pop()](tokens)
        return torch.stack([layers[int(k)](row) for row, k in zip(tokens, kind, strict=False)])


class MultiScaleWindows(nn.Module):
    """Multi-scale window attention per agent, joined by split attention: MSwin of V2X-ViT."""

    def __init__(
        self, channels: int, windows: tuple[tuple[int, int], ...], dropout: float, widths: Sequence[int]
    ) -> None:
        super().__init__()
        self.branches = nn.ModuleList(
            WindowAttention(channels, size, heads, dropout, width)
            for (size, heads), width in zip(windows, widths, strict=True)
        )
        self.squeeze = nn.Linear(channels, channels, bias=False)
        self.norm = nn.LayerNorm(channels)
        self.split = nn.Linear(channels, channels * len(windows), bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Map (A, H, W, C) to (A, H, W, C)."""
        parts = [branch(x) for branch in self.branches]
        whole = torch.stack([part.mean((1, 2)) for part in parts]).sum(0)
        weight = self.split(torch.relu(self.norm(self.squeeze(whole)))).unflatten(-1, (len(parts), -1)).softmax(1)
        joined = parts[0] * weight[:, 0, None, None]
        for k, part in enumerate(parts[1:], start=1):
            joined = torch.addcmul(joined, part, weight[:, k, None, None])
        return joined


class WindowAttention(nn.Module):
    """Multi-head attention within windows of each agent's map; all heads share one bias table."""

    def __init__(self, channels: int, window: int, heads: int, dropout: float, width: int) -> None:
        super().__init__()
        self.window, self.heads = window, heads
        self.place: Tensor
        self.qkv = nn.Linear(channels, 3 * width, bias=False)
        self.out = nn.Linear(width, channels)
        self.dropout = Dropout(dropout)
        self.bias = nn.Parameter(torch.randn(2 * window - 1, 2 * window - 1) * 0.02)
        place = torch.stack(torch.meshgrid(torch.arange(window), torch.arange(window), indexing="ij")).flatten(1)
        # Offset of the key's cell from the query's.
        self.register_buffer("place", place[:, None] - place[:, :, None] + window - 1, persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Map (A, H, W, C) to (A, H, W, C)."""
        agents, height, width, _ = x.shape
        filled, valid = padded(x, self.window)
        # One agent's map below the other's: no window spans two.
        below = (1, agents * filled.shape[1], *filled.shape[2:])
        tokens = cut(filled.reshape(below), self.window)
        query, key, value = in_heads(self.qkv(tokens), 3, self.heads)
        mask = self.bias[self.place[0], self.place[1]][None, None]
        if valid is not None:
            seen = cut(valid[:1, ..., None], self.window)[:, None, None, :, 0]
            mask = mask.masked_fill(~seen, -torch.inf).repeat(agents, 1, 1, 1)
        found = attention(query, key, value, mask)
        joined = found.transpose(1, 2).flatten(2)
        whole = paste(joined, (*below[:3], joined.shape[-1]), self.window).view(*filled.shape[:3], -1)
        return self.dropout(self.out(whole[:, :height, :width]))
