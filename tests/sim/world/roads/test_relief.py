"""Relief: no place is steeper or more curved than its bounds say, and the same seed draws the same one."""

import numpy as np
import pytest

from sim.world.roads.relief import MOTORWAY, TOWN, ReliefBounds, draw_relief

PLACES = np.random.default_rng(0).uniform(-2000.0, 2000.0, (4000, 2))


@pytest.mark.parametrize("bounds", [TOWN, MOTORWAY])
def test_no_place_is_steeper_or_more_curved_than_the_bounds(bounds: ReliefBounds) -> None:
    slopes = []
    for seed in range(20):
        relief = draw_relief(seed, bounds)
        assert relief.steepest <= bounds.steepest[1] + 1e-12 and relief.sharpest <= bounds.sharpest + 1e-12
        slope = np.hypot(*relief.gradient(PLACES).T)
        assert slope.max() <= relief.steepest
        step = 2.0 * np.array([0.6, 0.8])
        bend = relief.height(PLACES + step) - 2.0 * relief.height(PLACES) + relief.height(PLACES - step)
        assert np.abs(bend / 4.0).max() <= relief.sharpest * 1.001
        slopes.append(np.median(slope))
    # It is no plain either: half of a typical place slopes by a fifth of the largest slope and more.
    assert np.median(slopes) > 0.15 * bounds.steepest[0]


def test_the_gradient_is_that_of_the_height() -> None:
    relief = draw_relief(3, TOWN)
    for axis, step in enumerate(1e-3 * np.eye(2)):
        rise = (relief.height(PLACES + step) - relief.height(PLACES - step)) / 2e-3
        np.testing.assert_allclose(relief.gradient(PLACES)[:, axis], rise, atol=1e-8)


def test_equal_seeds_draw_equal_reliefs_and_others_differ() -> None:
    heights = [draw_relief(seed, TOWN).height(PLACES) for seed in (5, 5, 6)]
    assert heights[0].tobytes() == heights[1].tobytes() != heights[2].tobytes()
    assert 2.0 < np.ptp(heights[0]) < 100.0
