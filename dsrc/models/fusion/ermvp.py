"""ERMVP: fusion of sampled and merged cells of the collaborators."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsrc.models.fusion.base import AgentLayout, stacked_maps
from dsrc.models.fusion.cobevt import WindowFusion
from dsrc.models.fusion.warp import into_ego
from dsrc.models.fusion.windows import (
    AgentWindows,
    Dropout,
    FeedForward,
    Residual,
    attention,
    cut,
    in_heads,
    paste,
    relative_place,
    window_mask,
)
from dsrc.models.settings import ModelSettings

# Legend: A agents, K sampled cells, T clusters, H W map, w side of a window, C channels.


class ERMVP(WindowFusion):
    """Sampled cells, merged by density, fused by window and global-query attention, (N, C, H, W) to (B, C, H, W).

    Source: ERMVP, Zhang et al., CVPR 2024, Section 3: a collaborator sends the fifth of its cells that scores best,
    joined into a fifth as many clusters (hierarchical feature sampling); the receiver puts each cluster's mean where
    its cells were, zeros elsewhere; its own map stays whole. Three blocks of attention among all agents' cells in 4 x 4
    windows and of attention with queries from the whole map fuse them (attentive feature fusion). The paper's
    calibration of poses and its interaction of agents and ego were never published and are left out.

    Start: identity. The others' maps arrive sparse and normalised, unreadable for a head. The ego's map, times `keep`
    (1 per channel at first, 0 in the published network), is added to the result of the linear layer, which starts at
    zero.

    Released: the merged map is made and thrown away, whole maps are fused and nothing is saved; clusters are weighted
    by the numbers of their cells instead of their scores; absent agents are zero maps as in CoBEVT, and grid attention
    layers are never called. `released` has the first three; else the sampled cells are fused, by their scores. The
    published normalisation scales after the softmax, here too.
    """

    start = "identity"
    multiple = 4  # the queries see the map at a quarter of its resolution, in windows too

    def __init__(
        self,
        channels: int,
        agents: int = 5,
        depth: int = 3,
        heads: int = 8,
        window: int = 4,
        hidden: int | None = None,
        dropout: float = 0.1,
        sampled: float = 0.2,
        merged: float = 0.2,
        released: bool = False,
    ) -> None:
        """Make the sampler and the blocks.

        Args:
            hidden: width of the feed-forward layers; None is that of the maps.
            sampled: share of the cells that are sent.
            released: fuse whole maps as the published code does.
        """
        super().__init__(agents, window, released)
        self.sampler = Sampler(channels, sampled, merged, by_number=released)
        self._build(
            channels,
            (
                {
                    "near": Residual(channels, AgentWindows(channels, heads, agents, window, dropout)),
                    "near_forward": Residual(channels, FeedForward(channels, hidden or channels, dropout)),
                    "whole": Residual(channels, GlobalQuery(channels, heads, agents, window, dropout)),
                    "whole_forward": Residual(channels, FeedForward(channels, hidden or channels, dropout)),
                }
                for _ in range(depth)
            ),
        )

    @classmethod
    def values_sent(cls, settings: ModelSettings) -> int:
        """Return the numbers of the clusters' channels, and per sampled cell its place and its cluster."""
        if settings.released:
            return super().values_sent(settings)
        sampled = int(settings.grid.width * settings.grid.height // settings.map_stride**2 * 0.2)
        return math.ceil(sampled * 0.2) * settings.shrink_channels + 2 * sampled

    def send(self, maps: Sequence[Tensor], layout: AgentLayout, network: object = None) -> list[Tensor]:
        """Return the egos' maps unchanged and the collaborators' sampled cells, merged."""
        if self.released:
            return list(maps)
        groups = layout.split(maps[0])
        sparse = [torch.cat([g[:1], self.sampler(g[1:])]) if len(g) > 1 else g for g in groups]
        return [torch.cat(sparse)]

    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        """Fuse the maps."""
        groups = layout.split(features)
        learned = [self.head(self.attend(into_ego(group, layout, b))) for b, group in enumerate(groups)]
        return self.keep[:, None, None] * stacked_maps([group[0] for group in groups]) + torch.stack(learned)


class Sampler(nn.Module):
    """Sampler of a map: scores cells, keeps the best, merges them into clusters."""

    def __init__(self, channels: int, sampled: float, merged: float, by_number: bool) -> None:
        super().__init__()
        self.sampled, self.merged, self.by_number = sampled, merged, by_number
        self.score = nn.Sequential(nn.Conv2d(channels, channels, 1), nn.ReLU(), nn.Conv2d(channels, 1, 1))

    def forward(self, features: Tensor) -> Tensor:
        """Return (A, C, H, W) maps of the sampled cells, each with its cluster's mean; zeros elsewhere."""
        tokens, cells, score = self.tokens(features)
        cluster = density_clusters(tokens.detach(), math.ceil(tokens.shape[1] * self.merged))
        weight = cells.to(tokens.dtype) if self.by_number else score
        merged = self.means(tokens, cluster, weight)
        restored = merged.gather(1, cluster[..., None].expand(-1, -1, tokens.shape[2]))
        sparse = torch.zeros_like(features).flatten(2)
        place = cells[:, None].expand(-1, features.shape[1], -1)
        return sparse.scatter(2, place, restored.transpose(1, 2)).view_as(features)

    def tokens(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (A, K, C) normalised features times their scores, (A, K) cells and (A, K) scores, best first."""
        channels = features.shape[1]
        score = torch.sigmoid(self.score(features)).flatten(1)
        kept = int(score.shape[1] * self.sampled)
        cells = score.detach().argsort(dim=1, descending=True, stable=True)[:, :kept]
        best = score.gather(1, cells)
        normed = functional.layer_norm(features.flatten(2).transpose(1, 2), (channels,))
        return normed.gather(1, cells[..., None].expand(-1, -1, channels)) * best[..., None], cells, best

    def means(self, tokens: Tensor, cluster: Tensor, weight: Tensor) -> Tensor:
        """Return (A, T, C) weighted means of (A, K, C) tokens."""
        count = math.ceil(tokens.shape[1] * self.merged)
        total = weight.new_zeros((len(weight), count)).scatter_add(1, cluster, weight) + 1e-6
        share = weight / total.gather(1, cluster)
        index = cluster[..., None].expand_as(tokens)
        return tokens.new_zeros((len(tokens), count, tokens.shape[2])).scatter_add(1, index, tokens * share[..., None])


def density_clusters(tokens: Tensor, count: int, neighbours: int = 10) -> Tensor:
    """Return the (A, K) cluster of each of (A, K, C) tokens.

    Centres are dense and far from denser tokens; every token joins the nearest centre. Source: Du et al., Study on
    density peaks clustering based on k-nearest neighbors, Knowledge-Based Systems 99, 2016.
    """
    agents, kept, channels = tokens.shape
    distance = torch.cdist(tokens, tokens) / channels**0.5
    nearest = distance.topk(min(neighbours, kept), dim=-1, largest=False).values
    density = (-nearest.square().mean(-1)).exp()
    denser = density[:, None] > density[:, :, None]
    farthest = distance.flatten(1).amax(1)[:, None, None]
    apart = torch.where(denser, distance, farthest).amin(-1)
    centre = (apart * density).topk(count, dim=-1).indices
    cluster = distance.gather(1, centre[..., None].expand(-1, -1, kept)).argmin(1)
    return cluster.scatter(1, centre, torch.arange(count, device=tokens.device).expand(agents, count))


class GlobalQuery(nn.Module):
    """Window attention with one set of queries for all windows, from the whole map at a quarter of its size."""

    def __init__(self, channels: int, heads: int, agents: int, window: int, dropout: float) -> None:
        super().__init__()
        self.heads, self.window = heads, window
        self.place: Tensor
        self.shorten = nn.Sequential(Shorten(channels), Shorten(channels))
        self.key_value = nn.Linear(channels, 2 * channels)
        self.out = nn.Linear(channels, channels, bias=False)
        self.dropout = Dropout(dropout)
        self.bias = nn.Parameter(torch.randn((2 * agents - 1) * (2 * window - 1) ** 2, heads) * 0.02)
        self.register_buffer("place", relative_place(agents, window), persistent=False)

    def forward(self, x: Tensor, valid: Tensor | None) -> Tensor:
        """Map (A, H, W, C) to (A, H, W, C); `valid` (A, H, W) masks the keys, None for all."""
        short = self.shorten(x.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
        tokens = cut(short, self.window)
        among = torch.softmax(tokens @ tokens.transpose(1, 2), dim=-1) * tokens.shape[-1] ** -0.5
        query = (among @ tokens).mean(0).unflatten(-1, (self.heads, -1)).transpose(0, 1)
        key, value = in_heads(self.key_value(cut(x, self.window)), 2, self.heads)
        mask = window_mask(self.bias, self.place, len(x), self.window, valid, False)
        found = attention(query.expand_as(key), key, value, mask)
        joined = self.dropout(self.out(found.transpose(1, 2).flatten(2)))
        return paste(joined, tuple(x.shape), self.window)


class Shorten(nn.Module):
    """Downsampling by two. Source: GC ViT, arXiv 2206.09959, Figure 4 (fused MBConv, then pooling)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.around = nn.Conv2d(channels, channels, 3, padding=1, groups=channels, bias=False)
        self.squeeze = nn.Linear(channels, channels // 4, bias=False)
        self.excite = nn.Linear(channels // 4, channels, bias=False)
        self.across = nn.Conv2d(channels, channels, 1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Map (A, C, H, W) to (A, C, H / 2, W / 2)."""
        y = functional.gelu(self.around(x))
        weight = torch.sigmoid(self.excite(functional.gelu(self.squeeze(y.mean((2, 3))))))
        return functional.max_pool2d(x + self.across(y * weight[:, :, None, None]), 3, 2, 1)
