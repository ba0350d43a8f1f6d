"""The direction head: front and back, which neither overlap nor a heading's sine tells apart."""

from dataclasses import replace as replace_sample
from pathlib import Path

import numpy as np
import pytest
import torch
from msgspec.structs import replace

from dsrc.data.sample import make_sample
from dsrc.evaluation.metrics.ap import FrameResult
from dsrc.evaluation.metrics.heading_accuracy import heading_share
from dsrc.models.detector import Detector, NetworkOutput
from dsrc.models.inputs.batch import collate
from dsrc.models.storage.checkpoint import load_detector, save_detector
from dsrc.ops.detections import Detections
from dsrc.training.losses import direction_loss
from sim.boxes import Boxes
from tests.dsrc.training.drive import frame
from tests.dsrc.training.runs import tiny

SETTINGS = replace(tiny().model, direction=True, sdd=False, pcp=False, rec=False, score_threshold=0.5)
HEADINGS = np.radians([0, 40, 50, 90, 130, 140, 180, -170, -130, -90, -50, -40])


def perfect(boxes: Boxes, *, sine_only: bool, direction: bool) -> NetworkOutput:
    """The maps of a network that has learned its targets, or a heading only as well as its sine tells."""
    sample = replace_sample(make_sample(frame(0), 1000, SETTINGS.grid), boxes=boxes)
    targets = collate([sample], SETTINGS, training=True).targets
    reg = targets.regression.permute(0, 3, 1, 2).clone()
    against = torch.cos(reg[:, 6::7]) < 0
    if sine_only:
        reg[:, 6::7] = torch.atan(torch.tan(reg[:, 6::7]))
    cls = torch.where(targets.positive.permute(0, 3, 1, 2), 9.0, -9.0)
    return NetworkOutput((cls, cls, cls), cls, cls, reg, torch.where(against, 5.0, -5.0) if direction else None)


def cars(yaw: np.ndarray) -> Boxes:
    x, y = np.meshgrid([-18.0, -9.0, 0.0, 9.0], [-8.0, 0.0, 8.0])
    rows = [x.ravel(), y.ravel(), np.full(12, -1.0), np.full(12, 4.2), np.full(12, 1.8), np.full(12, 1.5), yaw]
    return Boxes.from_array(np.stack(rows, axis=1))


@pytest.mark.parametrize("turn", np.radians([0, 3, 44, 46]))
def test_a_heading_known_by_its_sine_is_right_with_the_head_and_half_the_time_without(turn: float) -> None:
    truth = cars(HEADINGS + turn)
    detector = Detector(SETTINGS)
    for direction, low, high in ((True, 1.0, 1.0), (False, 0.3, 0.7)):
        (found,) = detector.decode(perfect(truth, sine_only=True, direction=direction))
        assert low <= heading_share([FrameResult(found, truth)]) <= high


def test_the_direction_does_not_turn_a_heading_that_is_right() -> None:
    truth = cars(HEADINGS)
    (found,) = Detector(SETTINGS).decode(perfect(truth, sine_only=False, direction=True))
    assert len(found) == 12
    assert heading_share([FrameResult(found, truth)]) == 1.0


def test_the_loss_asks_for_the_side_of_the_anchor_at_its_boxes_alone() -> None:
    positive = torch.zeros(2, 3, 3, 2, dtype=torch.bool)
    positive[0, 1, 1, 0] = positive[0, 2, 2, 1] = True
    regression = torch.zeros(2, 3, 3, 14)
    regression[0, 1, 1, 6], regression[0, 2, 2, 13] = 3.0, -0.5
    logits = torch.zeros(2, 2, 3, 3, requires_grad=True)
    loss = direction_loss(logits, positive, regression)
    loss.backward()
    assert loss.item() == pytest.approx(np.log(2) / 2)  # a mean over two samples, one without boxes
    assert logits.grad[0, 0, 1, 1] < 0 < logits.grad[0, 1, 2, 2]
    assert (logits.grad != 0).sum() == 2


def test_a_head_is_saved_and_without_it_nothing_changes(tmp_path: Path) -> None:
    with_head, without = Detector(SETTINGS), Detector(replace(SETTINGS, direction=False))
    save_detector(tmp_path / "d.pt", with_head)
    assert load_detector(tmp_path / "d.pt").settings.direction
    extra = set(with_head.state_dict()) - set(without.state_dict())
    assert extra == {"direction_head.weight", "direction_head.bias"}


def test_the_share_is_of_what_is_found() -> None:
    truth = cars(HEADINGS)
    boxes = cars(HEADINGS + np.where(np.arange(12) < 3, np.pi, 0.7))[np.arange(8)]
    found = Detections(boxes, np.linspace(0.4, 0.9, 8).astype(np.float32))
    assert heading_share([FrameResult(found, truth)], threshold=0.2) == pytest.approx(5 / 8)
    assert np.isnan(heading_share([FrameResult(Detections.zeros(), truth)]))
