"""A training step: few operations, none that makes the host wait for the device, and gradients that are right."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from msgspec.structs import replace
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from dsrc.data.sample import make_sample
from dsrc.models.detector import Detector
from dsrc.models.fusion.attention import attended
from dsrc.models.fusion.base import AgentLayout
from dsrc.models.layers.half_weights import HalfWeights
from dsrc.training.datamodule import Collate
from dsrc.training.losses import _relative_error, detection_loss
from dsrc.training.module import DetectionModule
from dsrc.training.recipes import of_method, small
from dsrc.training.train import train
from tests.dsrc.training.drive import frame, write_drive
from tests.dsrc.training.runs import tiny

WAITS = ("aten.nonzero", "aten._local_scalar_dense", "aten.item", "aten.masked_select")


class Operations(TorchDispatchMode):
    """Counts what PyTorch dispatches, the backward pass included."""

    def __init__(self) -> None:
        super().__init__()
        self.count: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count[str(func)] += 1
        return func(*args, **(kwargs or {}))

    def waits(self) -> list[str]:
        return [name for name in self.count if name.startswith(WAITS)]


class Watch(pl.Callback):
    """Counts the operations of every step, from its zeroed gradients to its new weights."""

    def __init__(self) -> None:
        self.steps: list[Operations] = []

    def on_train_batch_start(self, *_: object) -> None:
        self.steps.append(Operations())
        self.steps[-1].__enter__()

    def on_train_batch_end(self, *_: object) -> None:
        self.steps[-1].__exit__(None, None, None)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drive(tmp_path_factory.mktemp("data"), 4)


@pytest.mark.parametrize("window", [1.0, 0.5])
@pytest.mark.parametrize("bfloat16", [False, True])
def test_no_step_waits_for_the_device(
    data: Path, tmp_path: Path, bfloat16: bool, window: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A device has no oneDNN, whose layers run a teacher on CPUs: there nothing waits.
    monkeypatch.setattr("dsrc.models.storage.deploy._ONEDNN", False)
    recipe = tiny(epochs=1, batch_size=1, bfloat16=bfloat16, reconstruction_window=window)
    teacher, watch = train(recipe, data, tmp_path / "teacher", "teacher"), Watch()
    train(recipe, data, tmp_path / "student", "student", teacher=teacher, callbacks=[watch])
    assert len(watch.steps) > 2
    # The losses of all are looked at in the last step of an epoch.
    assert [step.waits() for step in watch.steps[:-1]] == [[]] * (len(watch.steps) - 1)


def test_a_step_of_dsrc_is_few_operations() -> None:
    """It was 1,766 with single layers and losses that autograd takes apart."""
    recipe = of_method(replace(small(), bfloat16=True), "dsrc")
    student = recipe.settings("student")
    samples = [make_sample(frame(index), None, recipe.model.grid) for index in (0, 1)]
    module = DetectionModule(recipe, Detector(student), Detector(recipe.settings("teacher"))).train()
    batch = Collate(student, recipe, training=True)(samples)
    module.losses(batch)  # the first step prepares the teacher
    with Operations() as operations:
        torch.stack(list(module.losses(batch).values())).sum().backward()
    assert operations.count.total() < 1300
    assert not operations.waits()


@pytest.mark.parametrize("agents", [(2, 3, 1), (2, 2), (3,)])
def test_attention_and_its_gradient_are_those_of_each_sample_alone(agents: tuple[int, ...]) -> None:
    torch.manual_seed(1)
    x = torch.randn(sum(agents), 4, 2, 3, dtype=torch.float64, requires_grad=True)
    alone = [attended(part, AgentLayout((len(part),))) for part in x.detach().split(list(agents))]
    torch.testing.assert_close(attended(x, AgentLayout(agents)), torch.cat(alone))
    assert torch.autograd.gradcheck(lambda x: attended(x, AgentLayout(agents)), (x,))


def of_boxes(parts: tuple[Tensor, ...], which: int) -> Callable[[Tensor], Tensor]:
    cls, reg, positive, regression = parts
    if which == 0:
        return lambda x: detection_loss(x, reg, positive, regression)[0]
    return lambda x: detection_loss(cls, x, positive, regression)[1]


@pytest.mark.parametrize("which", [0, 1])
def test_the_gradients_of_detection_are_those_of_finite_differences(which: int) -> None:
    torch.manual_seed(2)
    cls, reg, regression = (
        torch.randn(shape, dtype=torch.float64) for shape in ((2, 2, 3, 4), (2, 14, 3, 4), (2, 3, 4, 14))
    )
    parts = cls, reg, torch.rand(2, 3, 4, 2) < 0.3, regression
    assert torch.autograd.gradcheck(of_boxes(parts, which), (parts[which].clone().requires_grad_(),))


def test_the_relative_error_is_that_of_the_masked_cells() -> None:
    torch.manual_seed(3)
    student, teacher = (torch.randn(2, 3, 4, 5, dtype=torch.float64) for _ in range(2))
    mask = (torch.rand(2, 1, 4, 5) < 0.4).double()
    chosen = mask.expand_as(student) > 0
    expected = (student - teacher)[chosen].square().mean() / (teacher[chosen].square().mean() + 1e-6)
    torch.testing.assert_close(_relative_error(student, teacher, mask), expected)
    assert torch.autograd.gradcheck(lambda x: _relative_error(x, teacher, mask), (student.requires_grad_(),))
    assert _relative_error(student, teacher, torch.zeros_like(mask)) == 0


def test_half_weights_have_single_gradients() -> None:
    torch.manual_seed(4)
    module, x = nn.Sequential(nn.Conv2d(2, 3, 1), nn.Conv2d(3, 2, 1)), torch.randn(1, 2, 4, 4)
    with torch.autocast("cpu", torch.bfloat16):
        expected = torch.autograd.grad(module(x).float().square().sum(), list(module.parameters()))
        HalfWeights(module)(x).float().square().sum().backward()
    for parameter, gradient in zip(module.parameters(), expected, strict=True):
        assert parameter.grad is not None
        assert parameter.grad.dtype == torch.float32
        torch.testing.assert_close(parameter.grad, gradient)
