"""Pillars on a device where there are no points."""

import torch

from dsrc.models.detector import Detector
from dsrc.training.resident.voxels import Cells, Clouds
from tests.dsrc.training.runs import tiny


def test_clouds_without_a_point_leave_the_norms_finite() -> None:
    settings = tiny().model
    cells, none = Cells(settings, torch.device("cpu")), torch.zeros(0, dtype=torch.int64)
    clouds = Clouds(torch.zeros(0, 4), none, none.bool(), (0, 0))
    pillars, scene = cells.pillars(clouds), cells.scene(clouds)
    assert (len(pillars.points), int(pillars.count.sum()), len(scene.voxel)) == (0, 0, 0)
    assert not cells.with_points(clouds).any()
    encoder = Detector(settings).train().encoder
    assert not encoder(pillars).any()
    assert all(torch.isfinite(value).all() for value in encoder.state_dict().values())
