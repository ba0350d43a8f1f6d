"""Batches made of points on a device are those that the host makes."""

from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch
from msgspec.structs import replace

from dsrc.models.detector import Detector
from dsrc.models.inputs.batch import Batch
from dsrc.models.inputs.labels import LabelSettings, released_labels
from dsrc.models.layers.encoder import Pillars
from dsrc.models.layers.reconstruction import SceneVoxels
from dsrc.models.settings import ModelSettings
from dsrc.models.storage.checkpoint import load_detector
from dsrc.training import datamodule
from dsrc.training.datamodule import Collate, DetectionData
from dsrc.training.losses import DistillSettings, total
from dsrc.training.module import DetectionModule
from dsrc.training.recipes import Augmentation, Recipe, Stage, of_method
from dsrc.training.resident.batch import ResidentBatches, reason_for_host
from dsrc.training.resident.plan import Plan, PlanCollate, ResidentSet
from dsrc.training.resident.store import ResidentPoints
from dsrc.training.samples import TrainingSet
from dsrc.training.train import train
from tests.dsrc.training.drive import write_drive
from tests.dsrc.training.operations import Operations
from tests.dsrc.training.runs import tiny

ALL = Augmentation(dropout=0.5, thinning=0.6, height_m=0.3)
SEED = 3


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drive(tmp_path_factory.mktemp("data"), 4) / "made_up"


def recipe_of(method: str = "dsrc", **changes: object) -> Recipe:
    return of_method(tiny(**{"augmentation": ALL, "batch_size": 2, **changes}), method)


def both(data: Path, recipe: Recipe, stage: Stage = "student", epoch: int = 1) -> tuple[Batch, Batch]:
    """Return a batch as the host makes it, and of resident points."""
    settings = recipe.settings(stage)
    training = DetectionData(recipe, settings, [data], None, SEED).training
    host = Collate(settings, recipe, training=True)([training[epoch, number] for number in range(3)])
    plan, points = planned(training, recipe, settings, epoch)
    return host, ResidentBatches(points, settings, recipe)(plan)


def planned(
    training: TrainingSet, recipe: Recipe, settings: ModelSettings, epoch: int = 1
) -> tuple[Plan, ResidentPoints]:
    """Return the plan of a batch and its points."""
    points = ResidentPoints(training.store, training.frames, "cpu")
    dataset = ResidentSet(training, points.frames, points.points)
    return PlanCollate(settings, recipe, dataset)([dataset[epoch, number] for number in range(3)]), points


def assert_same_pillars(found: Pillars | None, expected: Pillars | None) -> None:
    assert (found is None) == (expected is None)
    if found is None or expected is None:
        return
    assert found.padded
    points, pillars = len(expected.points), len(expected.coords)
    assert points > 100
    torch.testing.assert_close(found.points[:points], expected.points, rtol=0, atol=1e-5)
    for name, count in (("pillar", points), ("coords", pillars), ("count", pillars)):
        assert torch.equal(getattr(found, name)[:count], getattr(expected, name)), name
    assert found.clouds == expected.clouds
    assert not found.count[pillars:].any()
    assert (found.coords[pillars:, 0] == found.clouds).all()
    assert not found.points[points:].any()
    assert (found.count[found.pillar[points:]] == 0).all()


def assert_same_scene(found: SceneVoxels | None, expected: SceneVoxels | None) -> None:
    assert (found is None) == (expected is None)
    if found is None or expected is None:
        return
    assert found.real is not None
    voxel, offset = found.voxel[found.real], found.offset[found.real]
    order = np.lexsort(voxel.numpy().T[::-1])
    torch.testing.assert_close(voxel[order], expected.voxel, rtol=0, atol=0)
    torch.testing.assert_close(offset[order], expected.offset, rtol=0, atol=1e-6)


def assert_same(host: Batch, resident: Batch) -> None:
    assert (resident.keys, resident.agents) == (host.keys, host.agents)
    for pillars in ("student", "teacher", "objects", "view"):
        assert_same_pillars(getattr(resident, pillars), getattr(host, pillars))
    assert_same_scene(resident.scene, host.scene)
    assert host.targets is not None
    assert resident.targets is not None
    assert host.targets.positive.any()
    torch.testing.assert_close(resident.targets.positive, host.targets.positive)
    torch.testing.assert_close(resident.targets.regression, host.targets.regression, rtol=0, atol=1e-6)
    assert (host.foreground is None) == (resident.foreground is None)
    if host.foreground is not None and resident.foreground is not None:
        assert torch.equal(resident.foreground, host.foreground)
    assert host.roadside is not None
    assert resident.roadside is not None
    assert torch.equal(resident.roadside, host.roadside)


@pytest.mark.parametrize("method", ["dsrc", "attfuse", "dsrc-alone", "no-collaboration", "early"])
def test_batches_of_resident_points_are_those_of_the_host(data: Path, method: str) -> None:
    for epoch in range(2):
        assert_same(*both(data, recipe_of(method), epoch=epoch))


@pytest.mark.parametrize(
    "changes",
    [
        {"augmentation": Augmentation(flip=False, rotation_deg=0.0, scale=0.0, random_ego=False, dropout=0.0)},
        {"consistency": 1.0},
        {"labels": LabelSettings(foreground="boxes", max_pillars=60)},
        {"distill": DistillSettings(teacher_norms="moving")},
    ],
)
def test_settings_of_a_recipe_hold_for_resident_points_too(data: Path, changes: dict[str, object]) -> None:
    host, resident = both(data, recipe_of(**changes))
    assert_same(host, resident)
    assert (host.view is not None) == ("consistency" in changes)
    assert (host.objects is not None) == ("distill" in changes)


@pytest.mark.parametrize(
    "changes",
    [{"sdd": False}, {"pcp": False}, {"box_order": "hwl", "padded_slots": True, "max_points": 3}, {"max_agents": 2}],
)
@pytest.mark.parametrize("stage", ["teacher", "student"])
def test_settings_of_a_model_hold_for_resident_points_too(data: Path, stage: Stage, changes: dict[str, object]) -> None:
    recipe = recipe_of()
    model: ModelSettings = replace(recipe.model, **changes)
    assert_same(*both(data, replace(recipe, model=model), stage))


def module_of(recipe: Recipe, weights: int = 1) -> DetectionModule:
    torch.manual_seed(weights)
    return DetectionModule(recipe, Detector(recipe.settings("student")), Detector(recipe.settings("teacher"))).train()


Named = dict[str, torch.Tensor]


def losses_and_gradients(recipe: Recipe, batch: Batch, weights: int) -> tuple[Named, Named]:
    module = module_of(recipe, weights)
    torch.manual_seed(2)
    losses = module.losses(batch)
    module.backward(total(losses.values()))
    return {name: value.detach() for name, value in losses.items()}, {
        name: weight.grad for name, weight in module.named_parameters() if weight.grad is not None
    }


def alike(found: Named, expected: Named) -> bool:
    """Whether tensors of the same names differ by at most 1e-5 in their norms."""
    assert found.keys() == expected.keys()
    return all((found[name] - value).norm() <= 1e-5 * max(1.0, float(value.norm())) for name, value in expected.items())


@pytest.mark.parametrize("padded_slots", [False, True])
@pytest.mark.parametrize("window", [1.0, 0.5])
def test_losses_and_gradients_are_those_of_the_host(
    data: Path, window: float, padded_slots: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    # One way to run the teacher: oneDNN's layers take pillars alone.
    monkeypatch.setattr("dsrc.models.storage.deploy._ONEDNN", False)
    recipe = recipe_of(reconstruction_window=window)
    recipe = replace(recipe, model=replace(recipe.model, padded_slots=padded_slots))
    host, resident = both(data, recipe)

    def near(weights: int) -> bool:
        (losses, expected), (others, found) = (
            losses_and_gradients(recipe, batch, weights) for batch in (host, resident)
        )
        assert alike(others, losses)
        assert any(value.abs().max() > 1e-3 for value in expected.values())
        return alike(found, expected)

    # Rounding may turn a ReLU or a maximum the other way, and gradients with it: not in every network.
    assert any(map(near, range(4, 8)))


def test_no_step_waits_for_the_device(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dsrc.models.storage.deploy._ONEDNN", False)
    recipe = recipe_of(reconstruction_window=0.5, consistency=1.0)
    settings = recipe.settings("student")
    plan, points = planned(DetectionData(recipe, settings, [data], None, SEED).training, recipe, settings)
    make, module = ResidentBatches(points, settings, recipe), module_of(recipe)
    module.losses(make(plan))  # the first step prepares the teacher
    with Operations() as operations:
        module.backward(total(module.losses(make(plan)).values()))
    assert operations.count.total() > 300
    assert not operations.waits()


def test_a_step_takes_place_on_a_device_that_has_no_numbers(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """PyTorch's device `meta` knows shapes alone.

    There no tensor can be looked at or copied to the host, no shape depends on data, and no tensor of the host can take
    part.
    """
    monkeypatch.setattr("dsrc.models.storage.deploy._ONEDNN", False)
    # Of all devices this one alone has no automatic precision.
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())
    monkeypatch.setattr(torch, "is_autocast_enabled", lambda *_: False)
    recipe = recipe_of(reconstruction_window=0.5, consistency=1.0)
    settings = recipe.settings("student")
    plan, points = planned(DetectionData(recipe, settings, [data], None, SEED).training, recipe, settings)
    assert plan.draws is not None
    points.points, points.device = [part.to("meta") for part in points.points], torch.device("meta")
    batch = ResidentBatches(points, settings, recipe)(plan.to("meta"))
    assert batch.view is not None
    assert batch.view.points.is_meta
    module = module_of(recipe).to("meta")
    losses = module.losses(batch)
    assert {"cls", "reg", "dae", "daf", "dap", "rec_mask", "rec_offset", "consistency"} <= losses.keys()
    module.backward(total(losses.values()))
    assert all(weight.grad is None or weight.grad.is_meta for weight in module.parameters())


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({}, None),
        ({"augmentation": Augmentation(corruption=0.1)}, "augmentation.corruption"),
        ({"augmentation": Augmentation(sizes=0.1)}, "augmentation.sizes"),
        ({"augmentation": Augmentation(intensity=0.1)}, "augmentation.intensity"),
        ({"labels": released_labels()}, "labels.inside"),
    ],
)
def test_some_settings_keep_points_with_the_host(changes: dict[str, object], why: str | None) -> None:
    recipe = recipe_of(**changes)
    assert reason_for_host(recipe, recipe.settings("student")) == why


def test_crowding_keeps_points_with_the_host() -> None:
    recipe = recipe_of()
    changes = {"augmentation": Augmentation(crowding=0.1), "model": replace(recipe.model, height="ground")}
    recipe = replace(recipe, **changes)
    # Of a network of any heights.
    assert reason_for_host(recipe, recipe_of().settings("student")) == "augmentation.crowding"


@pytest.mark.parametrize(
    ("method", "name", "value"),
    [
        ("late", "fusion", "late"),
        ("attfuse", "height", "ground"),
        ("attfuse", "own_frame", True),
        ("attfuse", "left_handed", True),
        ("attfuse", "intensity_steps", 255),
    ],
)
def test_some_networks_keep_points_with_the_host(method: str, name: str, value: object) -> None:
    settings: ModelSettings = replace(recipe_of(method).model, **{name: value})
    assert reason_for_host(recipe_of(method), settings) == name


def test_a_training_with_resident_points_ends_with_the_weights_of_the_host(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    recipe = recipe_of(epochs=2, validate_every=2, validation_share=0.3, half=False)
    expected = load_detector(train(recipe, data.parent, tmp_path / "host", "plain")).state_dict()
    made: list[Batch] = []
    call = ResidentBatches.__call__
    monkeypatch.setattr(ResidentBatches, "__call__", lambda self, plan: made.append(call(self, plan)) or made[-1])
    monkeypatch.setattr(datamodule, "RESIDENT", ("cpu",))
    monkeypatch.setattr(datamodule, "free_bytes", lambda _: 10**9)
    caplog.set_level("INFO", "dsrc.training.datamodule")
    found = load_detector(train(recipe, data.parent, tmp_path / "resident", "plain")).state_dict()
    assert len(made) == 2
    assert "points of 3 frames go to cpu" in caplog.text
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, rtol=0, atol=1e-4, msg=name)


def test_points_that_do_not_fit_stay_with_the_host(
    data: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    recipe = recipe_of()
    loaders = DetectionData(recipe, recipe.model, [data], None, SEED)
    monkeypatch.setattr(datamodule, "RESIDENT", ("cpu",))
    monkeypatch.setattr(datamodule, "free_bytes", lambda _: 200_000)
    caplog.set_level("INFO", "dsrc.training.datamodule")
    assert loaders._on_device(torch.device("cpu")) is None
    assert "points stay with the host: their 0.0 GB beside 0.0 GB free" in caplog.text
