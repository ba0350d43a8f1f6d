"""The losses against the reference, in value and in gradient."""

import numpy as np
import torch

from dsrc.training.losses import detection_loss
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
