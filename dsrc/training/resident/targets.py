"""Target assignment on a device: what `dsrc.ops.targets.assign_targets` finds, for all samples and anchors at once."""

import torch
from torch import Tensor

from dsrc.models.inputs.batch import Targets
from dsrc.models.settings import ModelSettings
from dsrc.ops.anchors import ANCHORS, anchor_grid
from dsrc.ops.coding import REFERENCE_ORDER

# Legend: B samples, n boxes of a sample, h w output grid.

_TIE = 1e-6
_ROUNDS = 3
"""Rounds in which boxes without an anchor take their last resort. A box can lose all of its anchors by that, and then
takes its own last resort, by which another can lose all of its; more than two in a row would overlap."""


class Anchors:
    """Anchors of a network on a device."""

    def __init__(self, settings: ModelSettings, device: torch.device) -> None:
        kinds = ANCHORS[settings.users]
        grid = anchor_grid(settings.grid, settings.head_stride, settings.users, settings.anchor_lwh)
        self.boxes, self.least, self.headed = (
            torch.from_numpy(part).to(device) for part in (grid, kinds.positive_iou, kinds.headed)
        )
        self.order = REFERENCE_ORDER if settings.box_order == "hwl" else tuple(range(7))
        cell = self.boxes[0, 0]
        self.low = _hulls(cell)[0] - cell[:, :2]
        diagonal = cell[:, 3:5].square().sum(1).sqrt()
        self.units = torch.stack([diagonal, diagonal, cell[:, 5]], dim=1)

    def targets(self, boxes: Tensor, fits: Tensor) -> Targets:
        """Return the targets of B samples, with `targets="overlap"`.

        Args:
            boxes: (B, n, 7) float64 x, y, z, l, w, h, yaw; n is at least 1.
            fits: (B, n, 2) bool whether a box may have each anchor of a cell, neither where a sample has fewer boxes.
        """
        owner = self._owners(boxes, fits)
        positive = owner >= 0
        rows = owner.clamp(min=0).flatten(1)[..., None].expand(-1, -1, 7)
        own = boxes.gather(1, rows).view(*owner.shape, 7)
        moved = (own[..., :3] - self.boxes[..., :3]) / self.units
        size = (own[..., 3:6] / self.boxes[..., 3:6]).log()
        yaw = (own[..., 6:] - self.boxes[..., 6:]) * self.headed[:, None]
        deltas = torch.cat([moved, size, yaw], dim=-1).unbind(-1)
        regression = torch.stack([deltas[column] for column in self.order], dim=-1)
        regression = torch.where(positive[..., None], regression, 0.0).float()
        return Targets(positive, regression.flatten(3))

    def _owners(self, boxes: Tensor, fits: Tensor) -> Tensor:
        """Return the (B, h, w, 2) int64 rows of the anchors' boxes, -1 for none."""
        iou = self._overlaps(boxes) * fits[:, :, None, None]
        number = torch.arange(boxes.shape[1], device=boxes.device)[:, None, None, None]
        best = iou.amax(1)
        first = torch.where(iou == best[:, None], number, boxes.shape[1]).amin(1)
        owner = torch.where((best >= self.least) & (best > 0), first, -1)
        most = iou.amax((2, 3, 4), keepdim=True)
        nearest = (iou >= most - _TIE) & (iou > 0)
        own, taken = owner[:, None] == number, torch.zeros_like(nearest)
        for _ in range(_ROUNDS):
            resort = nearest & ~(own & ~taken).flatten(2).any(2)[..., None, None, None]
            # What earlier boxes take, as they are served in turn.
            taken = resort.byte().cummax(1).values.bool().roll(1, dims=1)
            taken[:, 0] = False
        last = torch.where(resort, number, -1).amax(1)
        return torch.where(last >= 0, last, owner)

    def _overlaps(self, boxes: Tensor) -> Tensor:
        """Return the (B, n, h, w, 2) float64 IoU of boxes and anchors, both turned to the nearest axis."""
        low, high = _hulls(boxes)
        shared, areas = [], []
        for axis, centres in enumerate((self.boxes[0, :, 0, 0], self.boxes[:, 0, 0, 1])):
            start, end = centres[:, None] + self.low[:, axis], centres[:, None] - self.low[:, axis]
            lows, highs = low[..., axis, None, None], high[..., axis, None, None]
            shared.append((end.minimum(highs) - start.maximum(lows)).clamp(min=0))
            areas.append((highs - lows, -2 * self.low[:, axis]))
        inner = shared[0][:, :, None] * shared[1][:, :, :, None]
        (box_x, anchor_x), (box_y, anchor_y) = areas
        union = (box_x * box_y)[:, :, None] + anchor_x * anchor_y - inner
        return inner / union


def _hulls(boxes: Tensor) -> tuple[Tensor, Tensor]:
    """Return the (..., 2) lower and upper corners of (..., 7) boxes whose headings are rounded to 90 degrees."""
    along_y = ((boxes[..., 6:] / (torch.pi / 2)).round() % 2) == 1
    half = 0.5 * torch.where(along_y, boxes[..., 3:5].flip(-1), boxes[..., 3:5])
    return boxes[..., :2] - half, boxes[..., :2] + half
