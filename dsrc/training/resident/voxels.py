"""Pillars, foreground and voxels of clouds on a device: what `dsrc.ops.pillars` finds, without waiting for the numbers.

How many points and pillars there are is known on the device alone. So the arrays have the size that they can have at
most, and what is beyond the real rows is marked: see `Pillars.padded` and `SceneVoxels.real`.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from dsrc.models.layers.encoder import SPARE_ROWS, Pillars
from dsrc.models.layers.reconstruction import SceneVoxels
from dsrc.models.settings import ModelSettings

# Legend: P points, N clouds, H W grid, D point features.


@dataclass(frozen=True, slots=True, eq=False)
class Clouds:
    """N clouds in one array, one after the other, each with points that are none.

    Attributes:
        points: (P, D) float32 x, y, z, intensity(, paint).
        cloud: (P,) int64 cloud of each, ascending.
        inside: (P,) bool points that are meant; the others have left the range, or belong to no object.
        sizes: (N,) rows of each cloud.
    """

    points: Tensor
    cloud: Tensor
    inside: Tensor
    sizes: tuple[int, ...]


def rows_of(table: Tensor, row: Tensor) -> Tensor:
    """Return the (K, D) rows of a table of few columns, element by element: by rows, a GPU starts a block for each."""
    return table[row[:, None], torch.arange(table.shape[1], device=row.device)]


class Cells:
    """Cells of a grid of pillars on a device."""

    def __init__(self, settings: ModelSettings, device: torch.device) -> None:
        self.settings, grid = settings, settings.grid
        self.width, self.height = grid.width, grid.height
        self.low = torch.tensor(grid.range_m[:3], device=device)
        self.size = torch.tensor([grid.cell_m, grid.cell_m, grid.range_m[5] - grid.range_m[2]], device=device)
        self.shape = torch.tensor([grid.width, grid.height, 1], device=device)
        # In double precision, as the reconstruction's targets are on the host.
        self.low_fine = torch.tensor(grid.range_m[:3], dtype=torch.float64, device=device)
        scene = [grid.cell_m, grid.cell_m, settings.reconstruction_cell_z_m]
        self.size_fine = torch.tensor(scene, dtype=torch.float64, device=device)
        layers = round((grid.range_m[5] - grid.range_m[2]) / settings.reconstruction_cell_z_m)
        self.last_fine = torch.tensor([grid.width - 1, grid.height - 1, layers - 1], device=device)

    def pillars(self, clouds: Clouds) -> Pillars:
        """Sort points into pillars, first come, first served: the rows of `pillars_of`, and padding after them."""
        count_of, most = len(clouds.sizes), self.settings.max_pillars
        cells = self.height * self.width
        place = ((clouds.points[:, :3] - self.low) / self.size).floor()
        inside = clouds.inside & ((place >= 0) & (place < self.shape)).all(1)
        column, row = place[:, 0].long(), place[:, 1].long()
        nowhere = count_of * cells
        key = torch.where(inside, (clouds.cloud * self.height + row) * self.width + column, nowhere)
        key, order = key.sort(stable=True)  # cell by cell, in a cell in order of arrival
        number = torch.arange(len(key), device=key.device)
        first = torch.ones_like(key, dtype=torch.bool)
        first[1:] = key[1:] != key[:-1]
        # Searches of what is sorted: a running maximum, or a sum by index, takes milliseconds on a GPU.
        start, end = torch.searchsorted(key, key), torch.searchsorted(key, key, right=True)
        opens = (first & (key < nowhere)).long()
        opened = torch.zeros_like(opens).index_copy_(0, order, opens)  # in order of arrival again
        capacity = [min(size, cells, most) for size in clouds.sizes]
        if any(min(size, cells) > most for size in clouds.sizes):
            rank = opened.cumsum(0)
            each = key.new_zeros(count_of).index_add_(0, clouds.cloud, opened)
            opened = opened * (rank - (each.cumsum(0) - each)[clouds.cloud] <= most)
        of_start = order[start]
        kept = (key < nowhere) & (number - start < self.settings.max_points) & (opened[of_start] > 0)
        spare = sum(capacity) + number % SPARE_ROWS  # pillars of no cloud
        pillar = torch.where(kept, opened.cumsum(0)[of_start] - 1, spare)
        opener = kept & first
        count = key.new_zeros(sum(capacity) + SPARE_ROWS)
        opened_at = torch.where(opener, pillar, spare)
        count.index_copy_(0, opened_at, torch.where(opener, (end - start).clamp(max=self.settings.max_points), 0))
        # Points go to the places that they have on the host: pillar by pillar, then those that are none.
        none = (~kept).long()
        target = torch.where(kept, (count.cumsum(0) - count)[pillar] + number - start, kept.sum() + none.cumsum(0) - 1)
        points = rows_of(clouds.points, order) * kept[:, None]
        cell = torch.full_like(count, nowhere)
        cell.index_copy_(0, opened_at, torch.where(opener, key, nowhere))
        coords = torch.stack([cell // cells, cell // self.width % self.height, cell % self.width], dim=1)
        return Pillars(
            points=torch.empty_like(points).index_copy_(0, target, points),
            pillar=torch.empty_like(pillar).index_copy_(0, target, pillar),
            coords=coords,
            count=count,
            clouds=count_of,
            padded=True,
        )

    def with_points(self, clouds: Clouds) -> Tensor:
        """Return the (N, H, W) bool cells with a point; points on the far faces count in the last cells."""
        place = (clouds.points[:, :2].double() - self.low_fine[:2]) / self.size_fine[:2]
        column, row = place.clamp(min=0).minimum(self.last_fine[:2]).long().unbind(1)
        nowhere = len(clouds.sizes) * self.height * self.width
        cell = torch.where(clouds.inside, (clouds.cloud * self.height + row) * self.width + column, nowhere)
        found = torch.zeros(nowhere + 1, dtype=torch.bool, device=cell.device).index_fill_(0, cell, True)
        return found[:-1].view(-1, self.height, self.width)

    def scene(self, merged: Clouds) -> SceneVoxels:
        """Return occupied voxels and means of all their points, a row for each point; `real` are those of the first."""
        xyz = merged.points[:, :3].double()
        place = (xyz - self.low_fine) / self.size_fine
        at = place.clamp(min=0).minimum(self.last_fine).long()
        x, y, z = at.unbind(1)
        bins = self.settings.reconstruction_bins
        nowhere = len(merged.sizes) * bins * self.height * self.width
        flat = ((merged.cloud * bins + z) * self.height + y) * self.width + x
        number = torch.arange(len(flat), device=flat.device)
        cell = torch.where(merged.inside, flat, nowhere + number % SPARE_ROWS)
        sums = xyz.new_zeros((nowhere + SPARE_ROWS, 4))
        sums.index_add_(0, cell, torch.cat([xyz, torch.ones_like(xyz[:, :1])], dim=1))
        first = cell.new_full((nowhere + SPARE_ROWS,), len(cell)).scatter_reduce_(0, cell, number, "amin")
        mean = sums[cell, :3] / sums[cell, 3:]
        centre = (at + 0.5) * self.size_fine + self.low_fine
        return SceneVoxels(
            torch.stack([merged.cloud, z, y, x], dim=1),
            (mean - centre).float(),
            len(merged.sizes),
            merged.inside & (first[cell] == number),
        )
