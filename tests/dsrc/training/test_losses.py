"""The losses against the reference, in value and in gradient."""

import numpy as np
import pytest
import torch

from dsrc.models.detector import NetworkOutput
from dsrc.training.losses import DistillSettings, detection_loss, distillation_losses, released
from tests.dsrc.models.reference import golden


def test_detection_loss_equals_the_reference_in_value_and_gradient() -> None:
    arrays, notes = golden("det_loss")
    cls, reg = (torch.from_numpy(arrays[k]).requires_grad_() for k in ("psm", "rm"))
    positive, targets = torch.from_numpy(arrays["pos_equal_one"]).bool(), torch.from_numpy(arrays["targets"])
    cls_loss, reg_loss = detection_loss(cls, reg, positive, targets)
    expected = notes["values"]["f64"]
    np.testing.assert_allclose(cls_loss.item(), expected["conf_loss"], rtol=2e-5)
    np.testing.assert_allclose(reg_loss.item(), expected["reg_loss"], rtol=2e-5)
    (cls_loss + reg_loss).backward()
    np.testing.assert_allclose(cls.grad.numpy(), arrays["grad_psm"], atol=1e-6)
    np.testing.assert_allclose(reg.grad.numpy(), arrays["grad_rm"], atol=1e-6)


def test_a_sample_without_objects_has_no_box_loss() -> None:
    arrays, _ = golden("det_loss")
    cls, reg, targets = (torch.from_numpy(arrays[k])[2:] for k in ("psm", "rm", "targets"))
    cls_loss, reg_loss = detection_loss(cls, reg, torch.zeros(1, 16, 32, 2, dtype=torch.bool), targets)
    assert reg_loss.item() == 0
    assert cls_loss.item() > 0


POSITIVE = torch.rand(2, 8, 8, 2, generator=torch.Generator().manual_seed(3)) > 0.9


def outputs(seed: int) -> NetworkOutput:
    make = torch.Generator().manual_seed(seed)
    stages = tuple(torch.randn(3, 4, 16 // 2**k, 16 // 2**k, generator=make) for k in (1, 2, 3))
    maps = [torch.randn(2, c, 8, 8, generator=make) for c in (6, 2, 14)]
    return NetworkOutput(stages, *maps)


@pytest.mark.parametrize("settings", [DistillSettings(), released()])
def test_a_student_that_equals_its_teacher_has_nothing_to_learn(settings: DistillSettings) -> None:
    foreground = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(1)) > 0.8
    same = distillation_losses(outputs(1), outputs(1), foreground, POSITIVE, (2, 1), settings)
    other = distillation_losses(outputs(1), outputs(2), foreground, POSITIVE, (2, 1), settings)
    assert all(abs(value) < 1e-6 for value in same.values())
    assert all(value > 0 for value in other.values())


def test_only_the_foreground_is_distilled() -> None:
    student, teacher = outputs(1), outputs(2)
    nowhere, nobody = torch.zeros(3, 16, 16, dtype=torch.bool), torch.zeros(2, 8, 8, 2, dtype=torch.bool)
    nothing = distillation_losses(student, teacher, nowhere, nobody, (2, 1), DistillSettings())
    assert all(value == 0 for value in nothing.values())


def test_the_distillation_after_prediction_is_counted_per_object_like_the_detection() -> None:
    """Twice the objects, each as wrong as before, cost the same, however large the foreground is."""
    wrong = torch.zeros(1, 14, 8, 8)
    wrong[:, 0] = 1.0
    flat = torch.zeros(1, 2, 8, 8)
    stages = tuple(torch.zeros(1, 4, 16 // 2**k, 16 // 2**k) for k in (1, 2, 3))
    teacher, student = (
        NetworkOutput(stages, torch.zeros(1, 6, 8, 8), flat, reg) for reg in (torch.zeros_like(wrong), wrong)
    )
    values = []
    for objects, cells in ((1, 8), (2, 8), (2, 16)):
        positive, foreground = torch.zeros(1, 8, 8, 2, dtype=torch.bool), torch.zeros(1, 16, 16, dtype=torch.bool)
        positive[0, 0, :objects, 0] = True
        foreground[0, 0, :cells] = True
        settings = DistillSettings(dap=1.0)
        values.append(distillation_losses(student, teacher, foreground, positive, (1,), settings)["dap"].item())
    np.testing.assert_allclose(values, 0.5 / 7, rtol=1e-6)
