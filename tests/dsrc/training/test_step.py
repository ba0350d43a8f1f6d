"""A training step: few operations, none that makes the host wait for the device, and gradients that are right."""

from collections.abc import Callable
from pathlib import Path

import lightning.pytorch as pl
import pytest
import torch
from msgspec.structs import replace
from torch import Tensor, nn

from dsrc.data.sample import make_sample
from dsrc.models.detector import Detector, NetworkOutput
from dsrc.models.fusion.attention import attended
from dsrc.models.fusion.base import AgentLayout
from dsrc.models.layers.half_products import half_products
from dsrc.models.layers.half_weights import HalfWeights
from dsrc.ops.grid import GridSpec
from dsrc.training.datamodule import Collate
from dsrc.training.losses import _prediction_error, _relative_errors, detection_loss, total
from dsrc.training.module import DetectionModule, as_laid_out
from dsrc.training.recipes import of_method, small
from dsrc.training.train import train
from tests.dsrc.training.drive import frame, write_drive
from tests.dsrc.training.operations import Operations
from tests.dsrc.training.runs import tiny


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


@pytest.mark.parametrize(
    ("bfloat16", "window"),
    [
        (False, 1.0),
        pytest.param(True, 0.5, marks=pytest.mark.slow),
        pytest.param(False, 0.5, marks=pytest.mark.slow),
        pytest.param(True, 1.0, marks=pytest.mark.slow),
    ],
)
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


def test_a_step_of_dsrc_is_few_operations(monkeypatch: pytest.MonkeyPatch) -> None:
    """They were 1,766 with single layers and losses that autograd takes apart; half of them are the aim."""
    # As on a device: a teacher in oneDNN's layers dispatches more where the processor has bfloat16.
    monkeypatch.setattr("dsrc.models.storage.deploy._ONEDNN", False)
    model = replace(small().model, grid=GridSpec(range_m=(-12.8, -9.6, -3.0, 12.8, 9.6, 2.6)))
    recipe = of_method(replace(small(), model=model, bfloat16=True), "dsrc")
    student = recipe.settings("student")
    samples = [make_sample(frame(index), None, recipe.model.grid) for index in (0, 1)]
    module = DetectionModule(recipe, Detector(student), Detector(recipe.settings("teacher"))).train()
    batch = Collate(student, recipe, training=True)(samples)
    assert batch.targets.positive.any()
    module.losses(batch)  # the first step prepares the teacher
    with Operations() as operations:
        module.backward(total(module.losses(batch).values()))
    assert operations.count.total() <= 1766 // 2
    assert not operations.waits()


def test_the_gradients_of_a_step_are_those_of_the_backward_pass(data: Path) -> None:
    recipe = tiny(bfloat16=False)
    detector, teacher = Detector(recipe.settings("student")), Detector(recipe.settings("teacher"))
    module = DetectionModule(recipe, detector, teacher).train()
    sample = make_sample(frame(0), None, recipe.model.grid)
    batch = Collate(detector.settings, recipe, training=True)([sample])
    found: list[list[Tensor | None]] = []
    for backward in (Tensor.backward, module.backward):
        module.zero_grad()
        torch.manual_seed(5)
        backward(total(module.losses(batch).values()))
        found.append([weight.grad for weight in module.parameters()])
    torch.testing.assert_close(found[0], found[1])
    assert any(gradient is not None and gradient.any() for gradient in found[1])
    for weight, gradient in zip(module.parameters(), found[1], strict=True):
        assert gradient is None or as_laid_out(gradient, weight) is gradient


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
    torch.testing.assert_close(_relative_errors((student,), (teacher,), [mask])[0], expected)
    assert torch.autograd.gradcheck(lambda x: _relative_errors((x,), (teacher,), [mask]), (student.requires_grad_(),))
    assert _relative_errors((student,), (teacher,), [torch.zeros_like(mask)])[0] == 0


def test_the_error_of_predictions_and_its_gradient_are_those_of_its_parts() -> None:
    torch.manual_seed(5)
    cls, taught_cls, reg, taught_reg = (
        torch.randn(2, channels, 3, 4, dtype=torch.float64) for channels in (2, 2, 14, 14)
    )
    positive, where = torch.rand(2, 3, 4, 2) < 0.3, (torch.rand(2, 1, 3, 4) < 0.5).double()

    def error(cls: Tensor, reg: Tensor) -> Tensor:
        maps = (cls, cls, cls)
        parts = NetworkOutput(maps, cls, cls, reg), NetworkOutput(maps, cls, taught_cls, taught_reg)
        return _prediction_error(*parts, positive, where)

    p, q = torch.sigmoid(taught_cls), torch.sigmoid(cls)
    divergence = (p * (p / q).log() + (1 - p) * ((1 - p) / (1 - q)).log()) * where
    apart = (reg - taught_reg).unflatten(1, (2, 7)).square().mean(2) * positive.permute(0, 3, 1, 2)
    count = positive.flatten(1).sum(1)
    expected = ((divergence + 0.5 * apart).flatten(1).sum(1) / count).mean()
    torch.testing.assert_close(error(cls, reg), expected)
    assert torch.autograd.gradcheck(error, (cls.requires_grad_(), reg.requires_grad_()))


@pytest.mark.parametrize("flat", [False, True])
def test_half_weights_have_single_gradients(flat: bool) -> None:
    torch.manual_seed(4)
    module, x = nn.Sequential(nn.Conv2d(2, 3, 3), nn.Conv2d(3, 2, 3)), torch.randn(1, 2, 8, 8)
    # PyTorch's own loops for a processor without bfloat16 sum in it, in another order for channels-last maps.
    with half_products(True), torch.autocast("cpu", torch.bfloat16):
        expected = torch.autograd.grad(module(x).float().square().sum(), list(module.parameters()))
        out = HalfWeights(module, flat)(x)
        assert out.is_contiguous(memory_format=torch.channels_last) == flat
        out.float().square().sum().backward()
    for parameter, gradient in zip(module.parameters(), expected, strict=True):
        assert parameter.grad is not None
        assert parameter.grad.dtype == torch.float32
        torch.testing.assert_close(parameter.grad, gradient)
