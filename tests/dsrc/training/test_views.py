"""Samples that are also seen through corrupted sensors, and what ties the two views."""

from pathlib import Path

import numpy as np
import pytest
import torch
from msgspec.structs import replace

from dsrc.models.detector import Detector, NetworkOutput
from dsrc.models.inputs.batch import collate
from dsrc.models.layers.encoder import Pillars
from dsrc.training.datamodule import DetectionData
from dsrc.training.losses import consistency_loss
from dsrc.training.module import DetectionModule
from dsrc.training.recipes import Augmentation, Recipe
from tests.dsrc.training.drive import write_drive
from tests.dsrc.training.runs import tiny


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drive(tmp_path_factory.mktemp("data"), 3) / "made_up"


def corrupted(share: float, **changes: object) -> Recipe:
    return tiny(augmentation=Augmentation(corruption=share, kinds=("noise", "point_dropping")), **changes)


def samples(recipe: Recipe, data: Path) -> list:
    training = DetectionData(recipe, recipe.model, [data], None, seed=4).training
    return [training[epoch, number] for epoch in range(3) for number in range(3)]


def test_corruption_changes_what_is_seen_and_nothing_else(data: Path) -> None:
    for clean, sample in zip(samples(corrupted(0.0), data), samples(corrupted(1.0), data), strict=True):
        assert clean.corrupted == ()
        assert len(sample.corrupted) == len(sample.clouds) == len(clean.clouds)
        np.testing.assert_array_equal(sample.boxes.array, clean.boxes.array)
        for one, other in zip(sample.clouds, clean.clouds, strict=True):
            np.testing.assert_array_equal(one, other)
        assert not all(np.array_equal(one, other) for one, other in zip(sample.corrupted, sample.clouds, strict=True))


def test_so_many_samples_are_corrupted_as_are_asked_for(data: Path) -> None:
    share = np.mean([bool(sample.corrupted) for sample in samples(corrupted(0.5), data)])
    assert 0.2 < share < 0.8


def test_the_corrupted_clouds_turn_with_the_clean_ones(data: Path) -> None:
    recipe = tiny(augmentation=Augmentation(corruption=1.0, kinds=("point_dropping",)))
    for sample in samples(recipe, data):
        for left, whole in zip(sample.corrupted, sample.clouds, strict=True):
            assert len(left) < len(whole)
            assert {row.tobytes() for row in left} <= {row.tobytes() for row in whole}


@pytest.mark.parametrize("fusion", ["attention", "none", "early", "late"])
def test_a_student_sees_the_corrupted_clouds_or_both_and_its_teacher_the_clean_ones(data: Path, fusion: str) -> None:
    settings = replace(tiny().model, fusion=fusion)
    clean, dirty = (samples(corrupted(share), data)[:2] for share in (0.0, 1.0))
    before, instead, both = (
        collate(part, settings, True, both_views=two) for part, two in ((clean, True), (dirty, False), (dirty, True))
    )
    assert before.view is instead.view is None
    assert same(both.student, before.student)
    assert same(both.view, instead.student)
    assert not same(both.view, both.student)
    for batch in (instead, both):
        assert same(batch.teacher, before.teacher)
        assert torch.equal(batch.foreground, before.foreground)
        assert torch.equal(batch.scene.voxel, before.scene.voxel)
        assert torch.equal(batch.targets.positive, before.targets.positive)


def same(one: Pillars, other: Pillars) -> bool:
    return one.points.shape == other.points.shape and torch.equal(one.points, other.points)


def output(seed: int) -> NetworkOutput:
    make = torch.Generator().manual_seed(seed)
    cls, reg = (torch.randn(2, channels, 4, 4, generator=make).requires_grad_() for channels in (2, 14))
    return NetworkOutput((cls, cls, cls), cls, cls, reg)


def test_views_that_agree_cost_nothing_and_only_the_corrupted_one_is_moved() -> None:
    positive = torch.zeros(2, 4, 4, 2, dtype=torch.bool)
    positive[0, 1, 2, 0] = True
    clean, view = output(1), output(2)
    assert abs(consistency_loss(clean, clean, positive)) < 1e-5
    loss = consistency_loss(view, clean, positive)
    loss.backward()
    assert loss > 0
    assert clean.cls.grad is None
    assert (view.cls.grad != 0).all()  # ghosts in empty cells count
    assert view.reg.grad[:, :, 0].abs().max() == 0
    assert view.reg.grad[0, :7, 1, 2].abs().min() > 0


def test_the_tie_between_the_views_is_a_loss_of_its_weight(data: Path) -> None:
    values = []
    for weight in (1.0, 3.0):
        recipe = corrupted(1.0, consistency=weight)
        torch.manual_seed(0)
        settings = recipe.settings("plain")
        module = DetectionModule(recipe, Detector(settings)).eval()
        batch = collate(samples(recipe, data)[:2], settings, True, both_views=True)
        values.append(module.losses(batch)["consistency"].item())
    assert values[1] == pytest.approx(3 * values[0])
    assert values[0] > 0
    clean = collate(samples(corrupted(0.0), data)[:2], settings, True, both_views=True)
    assert module.losses(clean)["consistency"] == 0
