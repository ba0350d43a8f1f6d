"""Bird's-eye grid of a detector."""

import math

import msgspec

MOST_CELLS = 5e7
"""Most cells of a grid: 2.8 km squared of the paper's."""


class GridSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Bird's-eye grid of a detector, in the ego LiDAR's frame.

    Attributes:
        range_m: (x_min, y_min, z_min, x_max, y_max, z_max), m.
        cell_m: side of a pillar, m.
    """

    range_m: tuple[float, float, float, float, float, float] = (-140.8, -40.0, -3.0, 140.8, 40.0, 1.0)
    cell_m: float = 0.4

    def __post_init__(self) -> None:
        ends = zip(self.range_m[:3], self.range_m[3:], strict=True)
        if not (self.cell_m > 0 and all(low < high for low, high in ends)):
            raise ValueError(f"grid: expected a positive cell and minima below maxima, found {self}")
        x, y = self.range_m[3] - self.range_m[0], self.range_m[4] - self.range_m[1]
        if (
            not all(map(math.isfinite, (*self.range_m, self.cell_m)))
            or x / self.cell_m * (y / self.cell_m) > MOST_CELLS
        ):
            raise ValueError(f"grid: expected at most {MOST_CELLS:g} cells, found {self}")

    @property
    def width(self) -> int:
        """Cells along x."""
        return round((self.range_m[3] - self.range_m[0]) / self.cell_m)

    @property
    def height(self) -> int:
        """Cells along y."""
        return round((self.range_m[4] - self.range_m[1]) / self.cell_m)
