"""DSRC as its text has it and as released: what differs, that both train, and that the second is the reference."""

from collections.abc import Callable
from dataclasses import replace as replace_sample
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
from msgspec.structs import replace

from dsrc.data.sample import Sample, SampleRequest, make_sample
from dsrc.models.detector import Detector
from dsrc.models.inputs.batch import Batch, collate
from dsrc.models.inputs.labels import LabelSettings, cells_in_boxes
from dsrc.models.inputs.teacher import teacher_clouds
from dsrc.models.storage.names import detector_state
from dsrc.ops.coding import REFERENCE_ORDER
from dsrc.ops.grid import GridSpec
from dsrc.training.module import DetectionModule, RateCurve
from dsrc.training.recipes import Recipe, dsrc_code, dsrc_paper
from dsrc.training.train import train
from sim.boxes import Boxes
from tests.dsrc.models.reference import close, golden, reconstruction_state, state
from tests.dsrc.training.drive import frame, write_drive
from tests.dsrc.training.runs import Power, tiny


def differences(one: msgspec.Struct, other: msgspec.Struct) -> dict[str, tuple[object, object]]:
    found: dict[str, tuple[object, object]] = {}
    for name in one.__struct_fields__:
        a, b = getattr(one, name), getattr(other, name)
        if isinstance(a, msgspec.Struct):
            found |= {f"{name}.{key}": pair for key, pair in differences(a, b).items()}
        elif a != b:
            found[name] = (a, b)
    return found


def test_the_released_targets_know_no_pedestrians() -> None:
    with pytest.raises(ValueError, match=r"labels.targets: expected overlap with users=vulnerable, found released"):
        replace(dsrc_code(), model=replace(dsrc_code().model, users="vulnerable"))


def test_the_presets_differ_where_the_text_and_the_released_code_do() -> None:
    assert differences(dsrc_paper(), dsrc_code()) == {
        "name": ("dsrc-paper", "dsrc-code"),
        "model.stage_blocks": ((3, 5, 8), (3, 4, 5)),
        "model.box_order": ("lwh", "hwl"),
        "model.padded_slots": (False, True),
        "model.score_prior": (0.01, None),
        "model.reconstruction_cell_z_m": (0.4, 4.0),
        "model.team_by": ("range", "folders"),
        "model.score_threshold": (0.2, 0.25),
        "model.max_extent_m": (None, 6.0),
        "distill.dap": (0.5, 1.0),
        "distill.form": ("paper", "released"),
        "distill.daf_mask": (False, True),
        "distill.teacher_norms": ("fixed", "moving"),
        "labels.inside": ("rotated", "hull"),
        "labels.foreground": ("boxes", "points"),
        "labels.targets": ("overlap", "released"),
        "labels.ego_box": (False, True),
        "labels.max_pillars": (None, 32_000),
        "learning_rate": (2e-3, 1e-3),
        "schedule": ("cosine", "released"),
        "warmup": (0.0, 0.25),
        "clip": (10.0, 0.0),
        "keep": ("best", "last"),
    }


@pytest.mark.parametrize("preset", [dsrc_paper, dsrc_code])
def test_a_preset_has_the_papers_range_and_schedule(preset: Callable[[], Recipe]) -> None:
    recipe = preset()
    assert (recipe.model.grid.width, recipe.model.grid.height) == (704, 200)
    assert recipe.model.reconstruction_bins == 10
    assert (recipe.epochs, recipe.batch_size, recipe.reconstruction) == (40, 2, 1.0)
    assert (recipe.distill.dae, recipe.distill.daf) == (1.0, 1.0)
    assert recipe.augmentation == msgspec.convert(
        {"flip": False, "rotation_deg": 0, "scale": 0, "random_ego": False, "dropout": 0}, type(recipe.augmentation)
    )


def test_both_full_networks_have_the_sizes_of_the_fact_sheet() -> None:
    sizes = {}
    for preset in (dsrc_paper, dsrc_code):
        with torch.device("meta"):
            detector = Detector(replace(preset().model, score_prior=None))
        sizes[preset] = sum(p.numel() for p in detector.parameters())
    assert sizes == {dsrc_paper: 6_846_560 - 128, dsrc_code: 5_198_344 - 128}  # without a norm that is never used


def test_the_released_rate_is_that_of_its_epochs() -> None:
    curve = RateCurve(dsrc_code(), steps=400)
    expected = {0: 2e-4, 5: 6e-4, 9: 9.2e-4, 10: 8.6e-4, 20: 5.1e-4, 30: 1.6e-4, 39: 2.2e-5}
    for epoch, rate in expected.items():
        for step in (0, 9):
            assert 1e-3 * curve(epoch * 10 + step) == pytest.approx(rate, rel=0.05), epoch


def test_the_papers_rate_begins_at_its_peak_and_falls() -> None:
    rates = [RateCurve(dsrc_paper(), steps=100)(step) for step in range(101)]
    assert rates[0] == 1.0
    assert (np.diff(rates) < 0).all()


def test_cells_in_a_box_are_those_whose_centre_is_in_it() -> None:
    grid = GridSpec(range_m=(-8, -8, -3, 8, 8, 1))
    boxes = Boxes.from_array([[1, 2, -1, 4.5, 1.8, 1.5, 0.7], [-7.8, 0, -1, 4, 2, 1.5, 0.0]])
    mask = cells_in_boxes([boxes, Boxes.zeros()], grid)
    centres = np.stack(np.meshgrid(*[np.arange(-7.8, 8, 0.4)] * 2), -1).reshape(-1, 2)
    inside = boxes.contains(np.concatenate([centres, np.full((len(centres), 1), -1.0)], 1)).any(0)
    np.testing.assert_array_equal(mask[0], inside.reshape(40, 40))
    assert 0 < mask[0].sum() == inside.sum()
    assert not mask[1].any()


def test_a_foreground_of_boxes_has_cells_that_no_point_has_met() -> None:
    sample = make_sample(frame(0), 1000, tiny().model.grid)
    points, boxes = (
        collate([sample], tiny().model, True, LabelSettings(foreground=f)).foreground for f in ("points", "boxes")
    )
    assert (boxes & ~points).any()
    assert (points & ~boxes).sum() < 0.5 * points.sum()  # cells that a box's edge cuts


def shrunk(preset: Recipe) -> Recipe:
    """A preset on the grid and with the widths of a fast test."""
    names = ("grid", "pillar_channels", "stage_channels", "base_width", "decoder_channels", "shrink_channels")
    small = {name: getattr(tiny().model, name) for name in (*names, "reconstruction_channels")}
    return replace(preset, model=replace(preset.model, stage_blocks=(1, 1, 1), **small), epochs=2, workers=0)


@pytest.mark.slow
@pytest.mark.parametrize("preset", [dsrc_paper, dsrc_code])
def test_a_preset_trains_its_teacher_and_its_student_and_resumes_exactly(
    preset: Callable[[], Recipe], tmp_path: Path
) -> None:
    recipe = replace(shrunk(preset()), validation_share=0.4, validate_every=1, half=False)
    data = write_drive(tmp_path / "data", 5)
    teacher = train(recipe, data, tmp_path / "teacher", "teacher")
    whole = train(recipe, data, tmp_path / "whole", "student", teacher=teacher)
    with pytest.raises(RuntimeError, match="power cut"):
        train(recipe, data, tmp_path / "cut", "student", teacher=teacher, callbacks=[Power(1)])
    cut = train(recipe, data, tmp_path / "cut", "student", teacher=teacher)
    states = [torch.load(path, weights_only=True)["state"] for path in (whole, cut)]
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])


@pytest.mark.slow
@pytest.mark.parametrize("preset", [dsrc_paper, dsrc_code])
def test_a_full_network_takes_a_step(preset: Callable[[], Recipe]) -> None:
    recipe = preset()
    module = DetectionModule(recipe, *(Detector(recipe.settings(stage)) for stage in ("student", "teacher"))).train()
    sample = make_sample(frame(0), 1000, SampleRequest(recipe.model.grid, keep_ego_box=recipe.labels.ego_box))
    moving = recipe.distill.teacher_norms == "moving"
    losses = module.losses(collate([sample], recipe.model, True, recipe.labels, objects=moving))
    sum(losses.values()).backward()
    assert set(losses) == {"cls", "reg", "dae", "daf", "dap", "rec_mask", "rec_offset"}
    assert all(torch.isfinite(parameter.grad).all() for parameter in module.parameters())


def golden_batch(recipe: Recipe) -> Batch:
    """The reference's batch, made by our own code of its points and boxes."""
    arrays, _ = golden("dsrc_student_train")
    samples = []
    for agents, union in (((0, 1), 0), ((2,), 1)):
        boxes = [Boxes.from_array(arrays[f"agent_boxes/{i}"][:, REFERENCE_ORDER]) for i in agents]
        clouds = tuple(_in_range(arrays[f"points/{i}"], recipe.model.grid) for i in agents)
        truth = Boxes.from_array(arrays[f"gt_union/{union}"][:, REFERENCE_ORDER])
        poses = np.stack([np.eye(4)] * len(agents))
        samples.append(Sample("golden", tuple(agents), clouds, poses, truth, tuple(boxes)))
    return collate(samples, recipe.model, True, recipe.labels, objects=True)


def _in_range(cloud: np.ndarray, grid: GridSpec) -> np.ndarray:
    low, high = np.array(grid.range_m[:3], np.float32), np.array(grid.range_m[3:], np.float32)
    return cloud[((cloud[:, :3] > low) & (cloud[:, :3] < high)).all(1)]


def test_a_training_step_of_the_released_preset_equals_the_references_from_the_points_on() -> None:
    arrays, notes = golden("dsrc_student_train")
    config = notes["config"]
    model = replace(
        dsrc_code().model,
        grid=GridSpec(range_m=tuple(config["range"])),
        pillar_channels=config["vfe"][0],
        stage_channels=tuple(config["num_filters"]),
        stage_blocks=tuple(config["layer_nums"]),
        decoder_channels=config["upsample_filters"][0],
        shrink_channels=config["shrink_dim"],
    )
    recipe = replace(dsrc_code(), model=model)
    student, teacher = Detector(recipe.settings("student")), Detector(recipe.settings("teacher"))
    student.load_state_dict(detector_state(state(arrays)))
    teacher.load_state_dict(detector_state(state(arrays), teacher=True))
    module = DetectionModule(recipe, student, teacher)
    module.reconstruction.load_state_dict(reconstruction_state(state(arrays)))
    for net in (student, teacher):  # torch sums a norm's statistics less exactly in the order that is fast on CPUs
        net.to(memory_format=torch.contiguous_format)
        net.backbone.register_forward_pre_hook(lambda _, inputs: (inputs[0].contiguous(),))
    batch = golden_batch(recipe)
    module.train()
    losses = {name: value.item() for name, value in module.losses(batch).items()}
    expected = notes["losses"]["train"]
    names = {"cls": "conf_loss", "reg": "reg_loss", "dae": "rec_loss", "daf": "fused_loss", "dap": "kd_loss"}
    names |= {"rec_mask": "mask_loss", "rec_offset": "offset_loss"}
    assert losses == pytest.approx({ours: expected[theirs] for ours, theirs in names.items()}, rel=2e-5)
    assert sum(losses.values()) == pytest.approx(expected["total"], rel=2e-5)
    for key in (
        "pillar_vfe_teacher.pfn_layers.0.norm.running_mean",
        "backbone_teacher.resnet.layer3.1.bn3.running_var",
    ):
        (name,) = detector_state({key: torch.zeros(1)}, teacher=True)
        close(teacher.state_dict()[name], arrays[f"train/after1/{key}"])


def test_a_teacher_with_fixed_norms_does_not_change(tmp_path: Path) -> None:
    recipe = tiny()
    module = DetectionModule(recipe, Detector(recipe.settings("student")), Detector(recipe.settings("teacher")))
    sample = make_sample(frame(0), 1000, recipe.model.grid)
    before = {name: tensor.clone() for name, tensor in module._teacher[0].state_dict().items()}
    module.train()
    module.losses(collate([sample], recipe.model, training=True))
    assert all(torch.equal(tensor, before[name]) for name, tensor in module._teacher[0].state_dict().items())


def test_a_hull_reaches_farther_than_its_box() -> None:
    sample = make_sample(frame(0), 1000, tiny().model.grid)
    turned = replace_sample(sample, agent_boxes=tuple(replace_sample(b, yaw=b.yaw + 0.8) for b in sample.agent_boxes))
    hull, box = (
        collate([turned], tiny().model, True, LabelSettings(inside=i)).teacher.points[:, 4] for i in ("hull", "rotated")
    )
    assert hull.sum() > box.sum() > 0
    assert len(teacher_clouds(turned, "hull").object_clouds[0]) > len(teacher_clouds(turned).object_clouds[0])
