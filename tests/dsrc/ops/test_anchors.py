import numpy as np
import pytest

from dsrc.ops.anchors import anchor_grid
from dsrc.ops.coding import REFERENCE_ORDER
from dsrc.ops.grid import GridSpec
from sim.errors import SettingsError
from tests.paths import GOLDENS

GOLDEN = GOLDENS / "models" / "anchors.npz"
GRIDS = {
    "full_stride2": (GridSpec(), 2),
    "small_stride2": (GridSpec(range_m=(-25.6, -12.8, -3, 25.6, 12.8, 1)), 2),
    "small_stride4": (GridSpec(range_m=(-25.6, -12.8, -3, 25.6, 12.8, 1)), 4),
    "v2xvit_stride4": (GridSpec(range_m=(-140.8, -38.4, -3, 140.8, 38.4, 1)), 4),
}


@pytest.mark.parametrize("case", GRIDS)
def test_anchors_equal_the_released_ones(case):
    grid, stride = GRIDS[case]
    golden = np.load(GOLDEN)
    anchors = anchor_grid(grid, stride)
    np.testing.assert_allclose(anchors[0, :, 0, 0], golden[f"{case}/x"], atol=1e-12, rtol=0)
    np.testing.assert_allclose(anchors[:, 0, 0, 1], golden[f"{case}/y"], atol=1e-12, rtol=0)
    template = golden[f"{case}/template"][:, list(REFERENCE_ORDER)]
    np.testing.assert_allclose(anchors[0, 0, :, 2:], template[:, 2:], atol=1e-12, rtol=0)
    assert anchors.shape == (grid.height // stride, grid.width // stride, 2, 7)
    if f"{case}/all" in golden.files:
        np.testing.assert_allclose(anchors[..., REFERENCE_ORDER], golden[f"{case}/all"], atol=1e-12, rtol=0)


def test_anchors_sit_at_the_centres_of_the_output_cells():
    grid = GridSpec(range_m=(0, 0, -3, 8, 4, 1), cell_m=0.5)
    anchors = anchor_grid(grid)
    np.testing.assert_allclose(anchors[0, :, 0, 0], np.arange(8) + 0.5)
    np.testing.assert_allclose(anchors[:, 0, 0, 1], np.arange(4) + 0.5)


def test_a_grid_that_the_stride_does_not_divide_is_refused():
    with pytest.raises(SettingsError, match="multiple of 2"):
        anchor_grid(GridSpec(range_m=(0, 0, -3, 1.2, 4, 1)))
