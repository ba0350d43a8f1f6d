"""Attention fusion: each cell of the ego attends to the same cell of every agent."""

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from dsrc.models.device import on_device
from dsrc.models.fusion.base import AgentLayout, Fusion
from dsrc.models.fusion.warp import into_ego


class AttentionFusion(Fusion):
    """Per-cell scaled dot-product attention without parameters, (N, C, H, W) to (B, C, H, W).

    Source: AttFuse, OPV2V, arXiv 2109.07644, Section IV: query, key and value are the features themselves, the scale is
    the root of C. DSRC (arXiv 2412.10739, Figure 2) fuses its three scales so.

    Released: computed for all agents' rows, of which only the ego's is kept; here for the ego's alone.
    """

    def fuse(self, features: Tensor, layout: AgentLayout) -> Tensor:
        """Fuse one scale."""
        return attended(features, layout)


def attended(features: Tensor, layout: AgentLayout) -> Tensor:
    """Attend from the ego of each sample to its agents, (N, C, H, W) to (B, C, H, W)."""
    if layout.pairwise is not None:
        features = torch.cat([into_ego(group, layout, b) for b, group in enumerate(layout.split(features))])
    if torch.is_grad_enabled() and features.requires_grad:
        return _Attended.apply(features, layout.agents)
    return _attend(features, layout.agents)[0]


def _attend(features: Tensor, agents: tuple[int, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """Return the (B, C, H, W) result, the (B, L, H, W, C) features by sample and the (B, L, H, W, 1) weights."""
    # Channels last, the order of CPU convolutions: sums over the second axis take five times as long.
    x = features.permute(0, 2, 3, 1)
    absent = None
    if len(agents) == 1:  # in an export of an unknown number of agents
        x = x[None]
    else:
        rows, absent = _places(agents, features.device)
        x = (x if rows is None else x.index_select(0, rows)).unflatten(0, (len(agents), -1))
    scores = (x * x[:, :1]).sum(4, keepdim=True) / x.shape[4] ** 0.5
    if absent is not None:
        scores.masked_fill_(absent, -torch.inf)
    weights = torch.softmax(scores, dim=1)
    return (weights * x).sum(1).permute(0, 3, 1, 2), x, weights


@lru_cache(maxsize=256)
def _places(agents: tuple[int, ...], device: torch.device) -> tuple[Tensor | None, Tensor | None]:
    """Return the (B L,) rows of the samples' agents, and (B, L, 1, 1, 1) which are absent, for samples that differ.

    The ego's row stands for an absent agent.
    """
    most = max(agents)
    if min(agents) == most:
        return None, None
    rows, start = [], 0
    for count in agents:
        rows += [start + agent if agent < count else start for agent in range(most)]
        start += count
    absent = torch.arange(most) >= torch.tensor(agents)[:, None]
    return on_device(torch.tensor(rows), device), on_device(absent[:, :, None, None, None], device)


class _Attended(torch.autograd.Function):
    """`attended` with its gradient: fewer operations than those of its parts."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, agents: tuple[int, ...]) -> Tensor:
        out, x, weights = _attend(features, agents)
        ctx.save_for_backward(x, weights)
        ctx.agents, ctx.rows = agents, len(features)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        x, weights = ctx.saved_tensors
        out = gradients[0].permute(0, 2, 3, 1)[:, None]
        by_weight = (x * out).sum(4, keepdim=True).to(weights.dtype)
        by_score = torch.ops.aten._softmax_backward_data(by_weight, weights, 1, weights.dtype) / x.shape[4] ** 0.5
        gradient = torch.addcmul(weights * out, by_score, x[:, :1])
        gradient.select(1, 0).add_((by_score * x).sum(1))
        gradient = gradient.flatten(0, 1).to(x.dtype)
        rows, _ = _places(ctx.agents, x.device)
        if rows is not None:
            # An absent agent has no weight and no gradient: what it adds to the ego's row is 0.
            whole = gradient.new_zeros((ctx.rows, *gradient.shape[1:]))
            gradient = whole.index_add_(0, rows, gradient)
        return gradient.permute(0, 3, 1, 2), None
