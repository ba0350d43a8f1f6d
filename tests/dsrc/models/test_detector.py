"""What a detector says depends on the clouds alone, and lies in its range."""

from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
from msgspec.structs import replace as changed

from dsrc.data.sample import Sample, inside_range, make_sample
from dsrc.models.detector import Detector
from dsrc.models.fusion import FUSIONS
from dsrc.models.fusion.max import MaxFusion
from dsrc.models.inputs.batch import collate
from dsrc.models.layers.backbones import BACKBONES
from dsrc.models.settings import Backbone, ModelSettings
from dsrc.models.storage.checkpoint import load_detector, save_detector
from dsrc.ops.grid import GridSpec
from dsrc.training.module import DetectionModule
from dsrc.training.recipes import debug
from sim.boxes import Boxes
from tests.dsrc.models.weights import stirred
from tests.dsrc.training.drive import frame


@pytest.fixture(scope="module")
def sample() -> Sample:
    return make_sample(frame(0), 1000, GRID)


GRID = GridSpec(range_m=(-19.2, -9.6, -3.0, 19.2, 9.6, 1.0))


def talkative(**changes: object) -> Detector:
    """A network of random weights that reports almost everything it thinks of."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = changed(
            debug().model, grid=GRID, stage_channels=(16, 16, 16), shrink_channels=16, decoder_channels=16, **changes
        )
        made = Detector(changed(model, score_threshold=0.005, score_prior=0.02))
        torch.nn.init.normal_(made.reg_head.bias, std=0.5)
        stirred(made.fusion)
        return made.eval()


def logits(detector: Detector, sample: Sample) -> torch.Tensor:
    """What the detector thinks of each anchor."""
    batch = collate([sample], detector.settings, training=False)
    with torch.inference_mode():
        return detector(batch.student, batch.layout).cls


@pytest.mark.parametrize("fusion", FUSIONS)
def test_a_collaborator_changes_what_is_thought_unless_there_is_no_fusion(sample: Sample, fusion: str) -> None:
    alone = replace(
        sample,
        agent_ids=sample.agent_ids[:1],
        clouds=sample.clouds[:1],
        ego_from_agent=sample.ego_from_agent[:1],
        agent_boxes=sample.agent_boxes[:1],
    )
    detector = talkative(fusion=fusion)
    one, all_of_them = logits(detector, alone), logits(detector, sample)
    if fusion == "late":
        assert len(all_of_them) == 3
        assert not np.array_equal(detector.detect(alone).score, detector.detect(sample).score)
    else:
        assert torch.allclose(one, all_of_them, atol=1e-6) == (fusion == "none")


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


def test_a_teacher_is_no_detector(sample: Sample) -> None:
    with pytest.raises(ValueError, match="ground truth"):
        talkative(role="teacher").detect(sample)


@pytest.mark.parametrize("fusion", FUSIONS)
def test_every_weight_of_every_method_learns_and_comes_back_from_its_file(
    sample: Sample, tmp_path: Path, fusion: str
) -> None:
    detector = talkative(fusion=fusion, compress=2).train()
    recipe = changed(debug(), model=changed(detector.settings, sdd=False, pcp=False, rec=False))
    module = DetectionModule(recipe, detector)
    seen_by_a_mast = make_sample(frame(0), -1, recipe.model.grid)
    batch = collate([sample, seen_by_a_mast], recipe.model, training=True)
    torch.manual_seed(1)
    torch.stack(list(module.losses(batch).values())).sum().backward()
    still = [name for name, weight in detector.named_parameters() if weight.grad is None]
    assert still == []
    save_detector(tmp_path / "detector.pt", detector, half=False)
    loaded = load_detector(tmp_path / "detector.pt")
    torch.testing.assert_close(logits(loaded, sample), logits(detector.eval(), sample), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("backbone", ["res2net", "resnet", "plain"])
def test_any_method_stands_behind_any_backbone(sample: Sample, backbone: str) -> None:
    assert len(talkative(fusion="max", backbone=backbone).detect(sample)) > 10


@pytest.mark.parametrize("fusion", ["attention", "where2comm", "mrcnet", "cobevt", "ermvp"])
def test_what_is_lost_on_the_way_is_not_fused(sample: Sample, fusion: str) -> None:
    detector = talkative(fusion=fusion)
    grid = detector.settings.grid
    none, everything = (np.full((grid.height // 8, grid.width // 8), value) for value in (False, True))
    everybody = logits(detector, replace(sample, lost=(none, none, none)))
    torch.testing.assert_close(everybody, logits(detector, sample), rtol=1e-4, atol=1e-5)
    nobody = logits(detector, replace(sample, lost=(none, everything, everything)))
    assert not torch.allclose(everybody, nobody, atol=1e-4)
    other = replace(sample, clouds=(sample.clouds[0],) * 3, lost=(none, everything, everything))
    torch.testing.assert_close(nobody, logits(detector, other), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("fusion", sorted(set(FUSIONS) - {"none", "early", "late", "ermvp"}))
def test_as_many_numbers_are_sent_as_are_said_to_be(sample: Sample, fusion: str) -> None:
    detector = talkative(fusion=fusion)
    batch = collate([sample], detector.settings, training=False)
    with torch.inference_mode():
        maps = detector.maps(detector.backbone(detector.encoder(batch.student)))
        sent = detector.fusion.send(maps, batch.layout, detector)
    assert sum(part[0].numel() for part in sent) == detector.fusion.values_sent(detector.settings)


@pytest.mark.parametrize("fusion", ["max", "v2vnet", "v2xvit", "cobevt", "where2comm", "ermvp", "mrcnet"])
def test_maps_that_were_made_in_the_agents_own_frames_are_warped(sample: Sample, fusion: str) -> None:
    plain = {"fusion": fusion, "sdd": False, "pcp": False, "rec": False}
    before, after = talkative(**plain), talkative(own_frame=True, **plain)
    # An agent that stands where the ego stands has the same frame: nothing needs warping.
    here = replace(sample, ego_from_agent=np.tile(np.eye(4), (3, 1, 1)))
    torch.testing.assert_close(logits(before, here), logits(after, here), rtol=1e-3, atol=1e-3)
    # One that stands elsewhere is heard, and where it believes to be matters.
    there = logits(after, sample)
    poses = sample.ego_from_agent.copy()
    poses[1:, 0, 3] += 3.0
    assert not torch.allclose(there, logits(after, replace(sample, ego_from_agent=poses)), atol=1e-4)


def test_a_map_that_is_warped_is_nearly_the_map_of_a_cloud_that_was_moved() -> None:
    # Far enough from a cell's middle that only whole cells agree: the collaborator stands 8 whole cells ahead.
    settings = changed(debug().model, grid=GRID, fusion="max", sdd=False, pcp=False, rec=False, stage_blocks=(1, 1, 1))
    own = changed(settings, own_frame=True)
    ahead = np.eye(4)
    ahead[0, 3] = 8 * settings.grid.cell_m
    cloud = make_sample(frame(0), 1000, GRID).clouds[0]
    poses = np.stack([np.eye(4), ahead])
    empty = Boxes.zeros()
    sample = Sample("x", (1, 2), (cloud[:0], cloud), poses, empty, (empty, empty))
    maps = []
    for chosen in (settings, own):
        batch = collate([sample], chosen, training=False)
        dense = Detector(chosen).encoder.eval().scatter(batch.student.count[:, None].float(), batch.student)
        maps.append(MaxFusion().fuse(dense, batch.layout)[0, 0])
    inner = maps[0][:, 8:-8] - maps[1][:, 8:-8]
    assert (inner.abs() > 0.1).float().mean() < 0.02
    assert maps[0][:, 8:-8].sum() > 500


def test_settings_name_what_there_is() -> None:
    assert set(get_args(Backbone)) == set(BACKBONES)
    with pytest.raises(ValueError, match="own_frame: expected a fusion of maps"):
        changed(debug().model, own_frame=True)
    with pytest.raises(ValueError, match="shrink_channels: expected a multiple of 16"):
        changed(debug().model, fusion="cobevt", shrink_channels=40)
    with pytest.raises(ValueError, match="users: expected vehicles with a direction head"):
        ModelSettings(users="vulnerable", direction=True)
    with pytest.raises(ValueError, match="users: expected vehicles with a direction head"):
        ModelSettings(users="vulnerable", anchor_lwh=(0.6, 0.6, 1.7))
    with pytest.raises(ValueError, match="compress: expected no more"):
        changed(debug().model, compress=32)


def test_opencood_counts_boxes_beyond_the_detectors_range(sample: Sample) -> None:
    detector = talkative(fusion="attention")
    own = detector.detect(sample)
    detector.settings = changed(detector.settings, judged_by="opencood", score_threshold=0.005)
    found = detector.detect(sample)
    inside = inside_range(found.boxes, GRID)
    assert 0 < inside.sum() < len(found)
    assert inside_range(found.boxes, GridSpec((-140.0, -40.0, -3.0, 140.0, 40.0, 1.0))).all()
    # What lies in the detector's range is the same, as the range is asked for after the suppression.
    assert np.array_equal(found.boxes[inside].array, own.boxes.array)
