"""How ground truth becomes what networks learn from; the defaults are ours, and the released code's are there too."""

from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from dsrc.models.inputs.teacher import Inside
from dsrc.ops.grid import GridSpec
from sim.boxes import Boxes


class Labels(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Choices in which the paper's text, its released code and we differ.

    Attributes:
        inside: which points belong to an object: those in its box, or in the box's axis-aligned hull as released, where
            an agent without objects has its whole cloud for one.
        foreground: cells on which the distillation looks: those with a `points` on an agent's objects, as released (up
            to a threshold of its teacher's features), or those whose centres lie in the labelled `boxes`, as the text
            has it.
        targets: anchors are responsible for a box by their true `overlap` with it, or by the `released` one, which adds
            a metre to all sides.
        ego_box: the ego's own body is an object where a collaborator has seen it, as in OpenCOOD.
        max_pillars: of a cloud in training, where that is fewer than the network's; None is the network's.
    """

    inside: Inside = "rotated"
    foreground: Literal["points", "boxes"] = "points"
    targets: Literal["overlap", "released"] = "overlap"
    ego_box: bool = False
    max_pillars: Annotated[int, Meta(ge=1)] | None = None


def released_labels() -> Labels:
    """Return the choices of the released code."""
    return Labels(inside="hull", targets="released", ego_box=True, max_pillars=32_000)


def cells_in_boxes(boxes: Sequence[Boxes], grid: GridSpec) -> NDArray[np.bool_]:
    """Return (N, H, W) whether the centre of a cell lies in one of an agent's boxes, seen from above."""
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
