"""Anchors of many boxes, crowded ones too, as the host assigns them one after the other."""

import numpy as np
import pytest
import torch
from msgspec.structs import replace

from dsrc.models.settings import ModelSettings
from dsrc.ops.anchors import ANCHORS, Users, anchor_grid
from dsrc.ops.grid import GridSpec
from dsrc.ops.targets import assign_targets
from dsrc.training.resident.targets import Anchors
from sim.boxes import CLASSES

GRID = GridSpec(range_m=(-25.6, -12.8, -3.0, 25.6, 12.8, 1.0))


@pytest.mark.parametrize("users", ["vehicles", "vulnerable"])
def test_targets_are_those_of_the_host(users: Users) -> None:
    settings = replace(ModelSettings(grid=GRID), users=users)
    anchors, kinds = anchor_grid(GRID, settings.head_stride, users), ANCHORS[users]
    rng, positives = np.random.default_rng(7), 0
    longest = 12.0 if users == "vehicles" else 2.5
    for _ in range(25):
        count = rng.integers(0, 30, 3)
        boxes, fits = np.zeros((3, 30, 7)), np.zeros((3, 30, 2), bool)
        for sample, n in enumerate(count):
            place = rng.uniform([-27, -14, -2], [27, 14, 0], (n, 3))
            size = np.exp(rng.uniform(np.log([0.4, 0.3, 0.5]), np.log([longest, 3.0, 3.5]), (n, 3)))
            boxes[sample, :n] = np.concatenate([place, size, rng.uniform(-np.pi, np.pi, (n, 1))], axis=1)
            fits[sample, :n] = kinds.takes[rng.integers(0, len(CLASSES), n)]
        found = Anchors(settings, torch.device("cpu")).targets(torch.from_numpy(boxes), torch.from_numpy(fits))
        for sample, n in enumerate(count):
            expected = assign_targets(boxes[sample, :n], anchors, kinds.positive_iou, fits=fits[sample, :n])
            regression = expected.regression.copy()
            regression[..., 6::7] *= kinds.headed
            np.testing.assert_array_equal(found.positive[sample].numpy(), expected.positive)
            np.testing.assert_allclose(found.regression[sample].numpy(), regression, rtol=0, atol=1e-6)
            positives += int(expected.positive.sum())
    assert positives > 300
