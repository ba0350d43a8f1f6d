"""Incomplete echo as published."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from sensors.corruptions.physics.levels import DEFAULT_SEVERITY, SEVERITIES
from sensors.corruptions.published import incomplete_echo
from sensors.corruptions.published.incomplete_echo import (
    PUBLISHED,
    SEMANTIC_KITTI,
    PaperIncompleteEcho,
    remaining_points,
)
from tests.sensors.corruptions.published.goldens import agrees, arrays, by_range, table
from tests.sensors.corruptions.street import same, spinning, street


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.mark.parametrize(("level", "ratio"), [("light", 0.75), ("moderate", 0.85), ("heavy", 0.95)])
def test_vehicles_lose_as_many_points_as_in_the_release(level: str, ratio: float) -> None:
    data, theirs = arrays("synth64"), table("incomplete_echo")[f"robo3d_semkitti_{level}_{ratio}/synth64"]
    left = [
        remaining_points(data["label"], SEMANTIC_KITTI, PUBLISHED[f"robo3d_{level}"], rng(seed)) for seed in range(20)
    ]
    for label, count in theirs["class_counts"].items():
        assert all((data["label"][kept] == int(label)).sum() == count["mean"] for kept in left)
    assert agrees([by_range(data["xyz"][kept]) for kept in left], theirs["range_hist"])
    assert agrees([data["intensity"][kept].mean() for kept in left], theirs["mean_intensity"])


def test_small_classes_are_spared() -> None:
    label = np.repeat([10, 11], [11, 10])
    left = remaining_points(label, SEMANTIC_KITTI, PaperIncompleteEcho(deleted=1.0), rng())
    assert left.tolist() == [False] * 11 + [True] * 10


def test_only_objects_lose_points_and_more_at_each_severity() -> None:
    sweep = street(spinning(16))
    sweep = replace(sweep, object_id=np.where(np.abs(sweep.points[:, 0] - 8) < 4, 1000, -1).astype(np.int32))
    left = [incomplete_echo.corrupt(sweep, PaperIncompleteEcho.severity(severity), rng()) for severity in SEVERITIES]
    world, objects = sweep[sweep.object_id < 0], int((sweep.object_id >= 0).sum())
    for severity, out in zip(SEVERITIES, left, strict=True):
        assert same(out[out.object_id < 0], world)
        deleted = PaperIncompleteEcho.severity(severity).deleted
        assert (out.object_id >= 0).sum() == objects - int(objects * deleted)
    kept = [{p.tobytes() for p in out.points} for out in left]
    assert all(a > b for a, b in itertools.pairwise(kept))
    assert PaperIncompleteEcho() == PaperIncompleteEcho.severity(DEFAULT_SEVERITY)
