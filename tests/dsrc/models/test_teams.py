"""Detections of every team are those of the sample without the others, though each cloud is encoded once."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from msgspec.structs import replace as changed

from dsrc.data.sample import Sample, make_sample
from dsrc.models.fusion import FUSIONS
from dsrc.models.inputs.batch import with_agents
from dsrc.models.layers.encoder import PillarEncoder
from dsrc.models.teams import team_detections, teams_of
from tests.dsrc.models.test_detector import GRID, logits, talkative
from tests.dsrc.training.drive import frame


@pytest.fixture(scope="module")
def sample() -> Sample:
    made = make_sample(frame(0, ground=200, per_car=60), 1000, GRID)
    none, some = np.zeros((6, 12), bool), np.zeros((6, 12), bool)
    some[:3, 4:] = True
    return replace(made, lost=(none, some, none))


def test_every_team_has_the_ego_and_no_two_are_the_same() -> None:
    assert teams_of(1) == [(0,)]
    assert teams_of(3) == [(0,), (0, 1), (0, 2), (0, 1, 2)]
    assert len(set(teams_of(5))) == 16


@pytest.mark.parametrize("fusion", [*FUSIONS, "own frame", "aligned"])
def test_a_teams_detections_are_those_without_the_others(sample: Sample, fusion: str) -> None:
    changes = {
        "own frame": {"fusion": "max", "own_frame": True},
        "aligned": {"fusion": "attention", "align_poses": True},
    }.get(fusion, {"fusion": fusion})
    detector = talkative(sdd=False, pcp=False, rec=False, **changes)
    # The best tenth, whatever its weights are, of boxes in range.
    torch.nn.init.zeros_(detector.reg_head.bias)
    best = float(logits(detector, sample).sigmoid().quantile(0.9))
    detector.settings = changed(detector.settings, score_threshold=best)
    found = team_detections(detector, sample)
    assert sum(map(len, found)) > 5
    for team, part in zip(teams_of(3), found, strict=True):
        alone = detector.detect(with_agents(sample, team))
        assert len(part) == len(alone)
        np.testing.assert_allclose(part.score, alone.score, atol=1e-4)
        # Two of nearly the same score may change places.
        by_x = (boxes[boxes[:, 0].argsort()] for boxes in (part.boxes.array, alone.boxes.array))
        np.testing.assert_allclose(*by_x, atol=1e-2)


def test_clouds_are_encoded_once(sample: Sample, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    forward = PillarEncoder.forward
    monkeypatch.setattr(PillarEncoder, "forward", lambda self, x: (seen.append(x.clouds), forward(self, x))[1])
    team_detections(talkative(fusion="attention"), sample)
    assert seen == [3]
