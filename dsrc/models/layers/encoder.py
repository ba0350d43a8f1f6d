"""Pillar encoder: points to a dense bird's-eye feature map.

It reads the real points only (P rows and the pillar of each), never the (pillars, 32, channels) block of padded slots
that the published implementations allocate; the slots' effect on batch norm and maximum is a closed expression
(`padded_slots`).
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from dsrc.models.device import Movable
from dsrc.models.settings import ModelSettings
from dsrc.ops.grid import GridSpec

# Legend: P points, V pillars, N clouds, D point features, C channels, H W grid.

SPARE_ROWS = 1024
"""Rows for what is nowhere; in a single one, thousands of threads would wait for each other."""


@dataclass(frozen=True, slots=True, eq=False)
class Pillars(Movable):
    """Pillars of N clouds: points sorted by pillar.

    Attributes:
        points: (P, D) float32 x, y, z, intensity(, paint) in the ego LiDAR's frame; kept points only.
        pillar: (P,) int64 row of the point's pillar, ascending.
        coords: (V, 3) int64 cloud, row (y) and column (x) of the pillar.
        count: (V,) int64 points in the pillar, at least 1.
        clouds: N, empty clouds included.
        padded: the arrays are filled up to a capacity, since the host of a device does not know the numbers: points are
            followed by zeros in the last pillar, pillars by some of cloud N, row 0 and column 0 without points.
    """

    points: Tensor
    pillar: Tensor
    coords: Tensor
    count: Tensor
    clouds: int
    padded: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class PillarMap:
    """Bird's-eye map by its pillars: (N, C, H, W), zero in cells without points.

    Attributes:
        features: (V, C) of the pillars.
        coords: (V, 3) int64 cloud, row (y) and column (x) of the pillar.
        clouds: N.
        height: H.
        width: W.
        padded: some pillars are of cloud N and no part of the map, see `Pillars`.
    """

    features: Tensor
    coords: Tensor
    clouds: int
    height: int
    width: int
    padded: bool = False

    def dense(self, empty: Tensor | None = None) -> Tensor:
        """Return the map with all its cells.

        Args:
            empty: (C,) value of the cells without points; None for zero.
        """
        cloud, row, column = self.coords.unbind(1)
        cell = (cloud * self.height + row) * self.width + column
        shape = self.clouds * self.height * self.width, self.features.shape[1]
        if self.padded:
            # In the precision of the layers that follow, which would convert all cells.
            kind = cell.device.type
            half = torch.is_autocast_enabled(kind)
            features = self.features.to(torch.get_autocast_dtype(kind)) if half else self.features
            # The last rows take what is no part of the map.
            spare = shape[0] + torch.arange(len(cell), device=cell.device) % SPARE_ROWS
            cell = torch.where(cloud < self.clouds, cell, spare)
            cells = features.new_zeros((shape[0] + SPARE_ROWS, shape[1])).index_copy_(0, cell, features)
            return cells[: shape[0]].view(self.clouds, self.height, self.width, -1).permute(0, 3, 1, 2)
        if empty is None:
            cells = self.features.new_zeros(shape)
        else:
            # Row by row of the map: single cells of few channels take four times as long.
            cells = empty.repeat(self.width).expand(self.clouds * self.height, -1).contiguous().view(shape)
        cells.index_copy_(0, cell, self.features)
        # (N, H, W, C) seen as (N, C, H, W): already the memory order that CPU convolutions like best.
        return cells.view(self.clouds, self.height, self.width, -1).permute(0, 3, 1, 2)

    def halved(self) -> "PillarMap":
        """Return every second row and column, the first included."""
        kept = ((self.coords[:, 1] | self.coords[:, 2]) & 1 == 0).nonzero()[:, 0]
        coords = self.coords[kept]
        coords[:, 1:] //= 2
        return PillarMap(self.features[kept], coords, self.clouds, self.height // 2, self.width // 2)


class SlotNorm(nn.BatchNorm1d):
    """Batch norm of a linear layer's output, computed from the moments of its input.

    The moments are (D,) and (D, D), D = 10 or 11, whatever the number of points, and gradients flow through them to
    the layer's weight. Rows of zeros that stand for padded slots enter as a count.
    """

    def scale_shift(self) -> tuple[Tensor, Tensor]:
        """Return the (C,) scale and shift that normalise a layer's output by the running statistics."""
        mean, variance = self._running()
        scale = self.weight * torch.rsqrt(variance + self.eps)
        return scale, self.bias - mean * scale

    def statistics(
        self, x: Tensor, weight: Tensor, zeros: int | Tensor, real: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None]:
        """Return the (C,) mean and variance of `x @ weight.T`: in training of these rows, else the running ones.

        Args:
            x: (P, D) rows.
            weight: (C, D) of the linear layer.
            zeros: further rows of zeros to count.
            real: (P, 1) 1 for rows that count, 0 for rows of zeros that do not; None where all do.

        Returns:
            Mean, variance, and in training half of their slopes by the weight: (D,) and (C, D).
        """
        running_mean, running_variance = self._running()
        if not self.training:
            return running_mean, running_variance, None, None
        centre, spread, n = _moments(x, zeros, real)
        mean, slope = weight @ centre, weight @ spread
        variance = (slope * weight).sum(1)
        momentum = float(self.momentum or 0.0)
        running_mean.lerp_(mean, momentum)
        unbiased = n / (n - 1).clamp(min=1) if isinstance(n, Tensor) else n / max(n - 1, 1)
        running_variance.lerp_(variance * unbiased, momentum)
        return mean, variance, centre, slope

    def _running(self) -> tuple[Tensor, Tensor]:
        if self.running_mean is None or self.running_var is None:
            raise ValueError("SlotNorm needs running statistics")
        return self.running_mean, self.running_var


def _moments(x: Tensor, zeros: int | Tensor, real: Tensor | None) -> tuple[Tensor, Tensor, int | Tensor]:
    """Return the (D,) mean and (D, D) covariance of rows and zero rows, and their number.

    Centred first, so that float32 suffices; `real` as in `SlotNorm.statistics`.
    """
    # At least one, or a batch without a point would end in NaN.
    n = zeros + (len(x) if real is None else real.sum(dtype=torch.float64).clamp(min=1))
    mean = x.sum(0, dtype=torch.float64) / n
    centre = mean.to(x.dtype)
    centred = x - centre if real is None else (x - centre) * real
    spread = (centred.T @ centred).double()
    if isinstance(zeros, Tensor) or zeros:
        spread += zeros * torch.outer(mean, mean)
    return centre, (spread / n).to(x.dtype), n


def _linear_max(x: Tensor, weight: Tensor, pillar: Tensor, n_pillars: int, empty: float) -> tuple[Tensor, Tensor]:
    """Return the (P, C) values of a linear layer and their (V, C) maximum per pillar, `empty` in one without points."""
    values = x @ weight.T
    start = values.new_full((n_pillars, len(weight)), empty)
    return values, start.scatter_reduce(0, pillar[:, None].expand_as(values), values, "amax", include_self=False)


def _normed_max(
    x: Tensor,
    weight: Tensor,
    norm: SlotNorm,
    pillar: Tensor,
    n_pillars: int,
    zeros: int | Tensor,
    padded: Tensor | None,
    real: Tensor | None,
) -> tuple[Tensor, tuple[Tensor | None, ...]]:
    """Return the (V, C) maxima of `relu(norm(x @ weight.T))` per pillar, and what their gradient needs.

    Args:
        padded: (V, 1) bool pillars with a row of zeros; None for none.
        real: as in `SlotNorm.statistics`; pillars of no such row get numbers that mean nothing.
    """
    mean, variance, centre, slope = norm.statistics(x, weight, zeros, real)
    root = torch.rsqrt(variance + norm.eps)
    scale = norm.weight * root
    shift = norm.bias - mean * scale
    # The norm is monotonic per channel: take the extreme first and normalise V rows instead of P.
    # A scale of 0 counts as positive; ONNX has no copysign.
    sign = torch.sign(scale + 1e-30)
    values, best = _linear_max(x, weight * sign[:, None], pillar, n_pillars, -torch.inf if real is None else 0.0)
    extreme = best * sign
    out, hidden = torch.addcmul(shift, extreme, scale), None
    if padded is not None:
        # A zero row that pads the pillar enters the maximum with the norm of zero, which is the shift.
        hidden = padded & (out < shift)
        out = torch.where(hidden, shift, out)
    out.relu_()
    return out, (x, pillar, values, best, extreme, out, hidden, mean, root, scale, norm.weight, centre, slope)


class _NormedMax(torch.autograd.Function):
    """`_normed_max` with its gradient, which needs no (P, C) index arithmetic.

    Points of a pillar that share a maximum all get its gradient.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, gamma: Tensor, beta: Tensor, *parts: Any) -> Tensor:
        out, saved = _normed_max(x, weight, *parts)
        ctx.save_for_backward(*saved)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        x, pillar, values, best, extreme, out, hidden, mean, root, scale, gamma, centre, slope = ctx.saved_tensors
        gradient = torch.ops.aten.threshold_backward(gradients[0], out, 0)
        of_shift = gradient.sum(0)
        if hidden is not None:
            gradient = gradient.masked_fill_(hidden, 0.0)
        of_scale = torch.addcmul((gradient * extreme).sum(0), mean, of_shift, value=-1)
        passed_over = values != best.index_select(0, pillar)
        of_values = (gradient * scale).index_select(0, pillar).masked_fill_(passed_over, 0.0)
        # Ten times faster on CPUs than its transpose.
        of_weight = (x.T @ of_values).T
        if centre is not None:
            of_variance = of_scale * gamma * root.pow(3)  # minus two of them
            of_weight = torch.addr(of_weight, of_shift * scale, centre, alpha=-1)
            of_weight.addcmul_(of_variance[:, None], slope, value=-1)
        return None, of_weight, of_scale * root, of_shift, *[None] * 6


class PillarEncoder(nn.Module):
    """Pillar feature network: linear layer per point, batch norm, ReLU, maximum per pillar, scatter to (N, C, H, W).

    Point features: x, y, z, intensity(, paint), offset to the mean of the pillar's points, offset to the pillar's
    centre. Source: PointPillars, arXiv 1812.05784; eps and momentum as in the released DSRC code.
    """

    cell: Tensor
    first: Tensor

    def __init__(self, settings: ModelSettings) -> None:
        super().__init__()
        self.grid: GridSpec = settings.grid
        low, cell = self.grid.range_m, self.grid.cell_m
        # In the order of coordinates: cloud, y, x.
        self.register_buffer("cell", torch.tensor([0.0, cell, cell]), persistent=False)
        first = [(low[2] + low[5]) / 2, low[1] + cell / 2, low[0] + cell / 2]
        self.register_buffer("first", torch.tensor(first), persistent=False)
        self.max_points = settings.max_points
        self.padded_slots = settings.padded_slots
        self.linear = nn.Linear(settings.point_features + 6, settings.pillar_channels, bias=False)
        self.norm = SlotNorm(settings.pillar_channels, eps=1e-3, momentum=settings.norm_momentum)

    def forward(self, pillars: Pillars) -> Tensor:
        """Return the (N, C, H, W) feature map; cells without points are zero."""
        return self.scatter(self.features(pillars), pillars)

    def features(self, pillars: Pillars) -> Tensor:
        """Return (V, C) features of the pillars."""
        n_pillars = pillars.coords.shape[0]  # which an export may leave open, and `len` not
        if n_pillars == 0:
            return pillars.points.new_zeros((0, self.linear.out_features))
        # The norm's statistics and the points' offsets need single precision, and there is little matrix work.
        with torch.autocast(pillars.points.device.type, enabled=False):
            points = self.augment(pillars)
            zeros: int | Tensor = 0
            padded = real = None
            if pillars.padded:
                real = (pillars.count > 0)[pillars.pillar, None].to(points.dtype)
                points = points * real
            if self.padded_slots:
                zeros = n_pillars * self.max_points - points.shape[0]
                if pillars.padded:
                    zeros = (pillars.count > 0).sum() * self.max_points - pillars.count.sum()
                padded = (pillars.count < self.max_points)[:, None]
            weight, norm = self.linear.weight, self.norm
            parts = norm, pillars.pillar, n_pillars, zeros, padded, real
            if torch.is_grad_enabled():
                return _NormedMax.apply(points, weight, norm.weight, norm.bias, *parts)
            return _normed_max(points, weight, *parts)[0]

    def augment(self, pillars: Pillars) -> Tensor:
        """Return (P, D + 6): the points with their offsets to the pillar's mean and centre."""
        xyz, rows = pillars.points[:, :3], pillars.pillar
        total = xyz.new_zeros((pillars.coords.shape[0], 3)).index_add_(0, rows, xyz)
        mean = total / (pillars.count.clamp(min=1) if pillars.padded else pillars.count)[:, None]
        reference = torch.cat([mean, self.centre(pillars)], dim=1)[rows]
        return torch.cat([pillars.points, xyz.repeat(1, 2) - reference], dim=1)

    def centre(self, pillars: Pillars) -> Tensor:
        """Return (V, 3) float32 centres of the pillars, m."""
        return (pillars.coords * self.cell + self.first).flip(1)

    def scatter(self, features: Tensor, pillars: Pillars) -> Tensor:
        """Place (V, C) features on the (N, C, H, W) grid."""
        return self.map_of(features, pillars).dense()

    def map_of(self, features: Tensor, pillars: Pillars) -> PillarMap:
        """Return the map of the (V, C) features of pillars."""
        return PillarMap(features, pillars.coords, pillars.clouds, self.grid.height, self.grid.width, pillars.padded)
