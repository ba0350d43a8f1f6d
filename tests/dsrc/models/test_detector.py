"""What a detector says depends on the clouds alone, and lies in its range."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from msgspec.structs import replace as changed

from dsrc.data.sample import Sample, inside_range, make_sample
from dsrc.models.detector import Detector
from dsrc.training.recipes import debug
from sim.boxes import Boxes
from tests.dsrc.training.drive import frame


@pytest.fixture(scope="module")
def sample() -> Sample:
    return make_sample(frame(0), 1000, debug().model.grid)


def talkative(**changes: object) -> Detector:
    """A network of random weights that reports almost everything it thinks of."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        made = Detector(changed(debug().model, score_threshold=0.005, **changes))
        torch.nn.init.normal_(made.reg_head.bias, std=0.5)
        return made.eval()


@pytest.mark.parametrize("fusion", ["attention", "max", "none", "late"])
def test_detections_do_not_depend_on_labels(sample: Sample, fusion: str) -> None:
    detector = talkative(fusion=fusion)
    unlabelled = replace(sample, boxes=Boxes.zeros(), agent_boxes=(Boxes.zeros(),) * len(sample.clouds))
    seen, blind = detector.detect(sample), detector.detect(unlabelled)
    assert len(seen) > 10
    np.testing.assert_array_equal(seen.boxes.array, blind.boxes.array)
    np.testing.assert_array_equal(seen.score, blind.score)


@pytest.mark.parametrize("fusion", ["attention", "late"])
def test_detections_lie_wholly_in_the_range_and_come_best_first(sample: Sample, fusion: str) -> None:
    detector = talkative(fusion=fusion)
    found = detector.detect(sample)
    assert len(found) > 10
    assert inside_range(found.boxes, detector.settings.grid).all()
    assert (np.diff(found.score) <= 0).all()


def test_a_collaborator_changes_what_is_detected_unless_there_is_no_fusion(sample: Sample) -> None:
    alone = replace(
        sample,
        agent_ids=sample.agent_ids[:1],
        clouds=sample.clouds[:1],
        ego_from_agent=sample.ego_from_agent[:1],
        agent_boxes=sample.agent_boxes[:1],
    )
    for fusion, same in (("none", True), ("attention", False), ("max", False), ("late", False)):
        one, all_of_them = (talkative(fusion=fusion).detect(s).score for s in (alone, sample))
        assert np.array_equal(one, all_of_them) == same, fusion


def test_a_teacher_is_no_detector(sample: Sample) -> None:
    with pytest.raises(ValueError, match="ground truth"):
        talkative(role="teacher").detect(sample)
