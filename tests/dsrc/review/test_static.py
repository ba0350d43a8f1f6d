"""The world of a drive is drawn, or said to be missing in a line."""

from typing import Any

import numpy as np
import pytest

from dsrc.review.static import static_parts
from sim.errors import DataError


@pytest.mark.parametrize("seed", [[1], None, float("inf"), "x"])
def test_a_seed_that_is_no_number_is_told(seed: Any) -> None:
    protocol = {"testbed": {"scenario": {"name": "four_way"}, "seed": seed}}
    with pytest.raises(DataError, match="roads and buildings are not drawn"):
        static_parts(protocol, np.zeros(3), np.zeros((1, 2)))
