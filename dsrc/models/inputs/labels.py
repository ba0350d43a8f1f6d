"""Label settings: how ground truth becomes training targets, by our rules or the released code's."""

from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from dsrc.models.inputs.teacher import Inside
from dsrc.ops.grid import GridSpec
from sim.boxes import Boxes


class LabelSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Label settings, in which the paper's text, its released code and ours differ.

    Attributes:
        inside: points of an object: those in its box, or in the box's axis-aligned hull as released, where an agent
            without objects has its whole cloud for one.
        foreground: cells of the distillation: those with a point on an agent's objects (`points`), as released (up to a
            threshold of its teacher's features), or those with their centre in a labelled box (`boxes`), as the text.
        targets: overlap by which anchors are positive: the true one, or the `released` one, which adds a metre to all
            sides.
        ego_box: the ego's own body is an object where a collaborator has seen it, as in OpenCOOD.
        min_points: points that an agent has on what it has seen: boxes of which no agent has as many are no ground
            truth of a training. With 5, as benchmarks of real roads count them, a network does not learn to guess.
        max_pillars: pillars per cloud in training, where fewer than the network's; None is the network's.
    """

    inside: Inside = "rotated"
    foreground: Literal["points", "boxes"] = "points"
    targets: Literal["overlap", "released"] = "overlap"
    ego_box: bool = False
    min_points: Annotated[int, Meta(ge=1)] = 1
    max_pillars: Annotated[int, Meta(ge=1)] | None = None


def released_labels() -> LabelSettings:
    """Return the label settings of the released code."""
    return LabelSettings(inside="hull", targets="released", ego_box=True, max_pillars=32_000)


def cells_in_boxes(boxes: Sequence[Boxes], grid: GridSpec) -> NDArray[np.bool_]:
    """Return the (N, H, W) mask of cells with their centre in one of an agent's boxes, seen from above."""
    mask = np.zeros((len(boxes), grid.height, grid.width), bool)
    low = np.array(grid.range_m[:2])
    for row, own in enumerate(boxes):
        for corners, (x, y), (length, width), yaw in zip(
            own.corners()[:, :4, :2], own.center[:, :2], own.size[:, :2], own.yaw, strict=True
        ):
            first = np.clip(np.floor((corners.min(0) - low) / grid.cell_m).astype(int), 0, None)
            last = np.ceil((corners.max(0) - low) / grid.cell_m).astype(int)
            columns = np.arange(first[0], min(last[0], grid.width))
            rows = np.arange(first[1], min(last[1], grid.height))
            dx = low[0] + (columns + 0.5) * grid.cell_m - x
            dy = (low[1] + (rows + 0.5) * grid.cell_m - y)[:, None]
            along, across = dx * np.cos(yaw) + dy * np.sin(yaw), dy * np.cos(yaw) - dx * np.sin(yaw)
            inside = (np.abs(along) <= length / 2) & (np.abs(across) <= width / 2)
            mask[row, first[1] : first[1] + len(rows), first[0] : first[0] + len(columns)] |= inside
    return mask
