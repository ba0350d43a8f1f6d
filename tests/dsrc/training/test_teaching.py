"""What a student is taught: boxes that only a collaborator has points on, the scene of all agents, and when."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from msgspec.structs import replace as changed

from dsrc.data.sample import Sample, make_sample
from dsrc.models.detector import Detector
from dsrc.models.inputs.batch import collate
from dsrc.models.layers.reconstruction import Reconstruction, SceneVoxels, reconstruction_losses, windowed
from dsrc.models.storage.checkpoint import load_detector, save_detector
from dsrc.training.initialise import initialise_from, load_teacher
from dsrc.training.losses import DistillSettings
from dsrc.training.module import DetectionModule, as_teacher
from dsrc.training.recipes import of_method
from sim.errors import CheckpointError
from tests.dsrc.training.drive import frame
from tests.dsrc.training.runs import tiny

HIDDEN = 1002
"""An object that a collaborator sees and the ego, 1000, has no point on, in every frame of the made-up drive."""


@pytest.fixture(scope="module")
def sample() -> Sample:
    return make_sample(frame(0), 1000, tiny().model.grid)


@pytest.fixture
def teacher_file(tmp_path: Path) -> Path:
    """A teacher of single clouds, as a campaign trains it."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        teacher = Detector(of_method(tiny(), "dsrc-alone").settings("teacher"))
    save_detector(tmp_path / "teacher.pt", teacher, half=False)
    return tmp_path / "teacher.pt"


@pytest.mark.parametrize("method", ["dsrc", "dsrc-max"])
def test_a_box_that_only_a_collaborator_sees_is_taught(sample: Sample, teacher_file: Path, method: str) -> None:
    settings = of_method(tiny(), method).settings("student")
    truth = frame(0)
    seen = truth.points_on[[agent.agent_id for agent in truth.agents].index(1000), truth.truth.object_id == HIDDEN]
    assert seen == 0
    x, y = sample.boxes.center[sample.boxes.object_id == HIDDEN][0, :2]
    low, cell_m = settings.grid.range_m, 2 * settings.grid.cell_m
    row, column = int((y - low[1]) / cell_m), int((x - low[0]) / cell_m)

    batch = collate([sample], settings, training=True)
    assert batch.foreground[:, 2 * row, 2 * column].any()  # it is in the mask of the distillation
    with torch.no_grad():
        taught = as_teacher(load_teacher(teacher_file, settings), batch).fused[0, :, row, column]
        ego_alone = as_teacher(load_detector(teacher_file), batch).fused[0, :, row, column]
    assert (taught - ego_alone).norm() > 0.05 * ego_alone.norm()


def test_a_teacher_of_another_fusion_with_weights_is_refused(teacher_file: Path) -> None:
    settings = of_method(changed(tiny(), model=changed(tiny().model, shrink_channels=16)), "dsrc").settings("student")
    with pytest.raises(CheckpointError, match=r"teacher.pt: fusion: expected v2vnet .* found none"):
        load_teacher(teacher_file, changed(settings, fusion="v2vnet"))


def test_a_teacher_of_other_road_users_is_refused(teacher_file: Path) -> None:
    settings = of_method(tiny(), "dsrc").settings("student")
    with pytest.raises(
        CheckpointError, match=r"teacher.pt: users: expected vulnerable as the student's, found vehicles"
    ):
        load_teacher(teacher_file, changed(settings, users="vulnerable"))
    with pytest.raises(CheckpointError, match=r"teacher.pt: anchor_lwh: expected \(4.0, 2.0, 1.5\)"):
        load_teacher(teacher_file, changed(settings, anchor_lwh=(4.0, 2.0, 1.5)))


def test_a_teacher_of_other_heights_is_refused(teacher_file: Path) -> None:
    settings = of_method(tiny(), "dsrc").settings("student")
    with pytest.raises(CheckpointError, match=r"teacher.pt: height: expected ground as the student's, found sensor"):
        load_teacher(teacher_file, changed(settings, height="ground"))


def test_a_student_can_begin_as_its_teacher_without_the_paint(sample: Sample, teacher_file: Path) -> None:
    settings = of_method(tiny(), "dsrc").settings("student")
    student = Detector(settings).eval()
    record = initialise_from(teacher_file, student)
    assert record["tensors_taken"] == record["tensors"]
    batch = collate([sample], settings, training=True)
    bare = changed(settings, pcp=False, role="teacher", sdd=False)
    unpainted = collate([sample], bare, training=True)
    painted = torch.cat([unpainted.teacher.points, torch.zeros(len(unpainted.teacher.points), 1)], dim=1)
    with torch.no_grad():
        found = student(unpainted.teacher, batch.layout).cls
        teacher = load_teacher(teacher_file, settings)
        expected = teacher(replace(unpainted.teacher, points=painted), batch.layout).cls
    torch.testing.assert_close(found, expected)


def test_what_is_reconstructed_is_the_scene_of_all_agents_also_for_one_that_hears_none(sample: Sample) -> None:
    together, alone = (of_method(tiny(), method).settings("student") for method in ("dsrc", "dsrc-alone"))
    scenes = [collate([sample], settings, training=True).scene for settings in (together, alone)]
    torch.testing.assert_close(scenes[0].voxel, scenes[1].voxel)


@pytest.mark.parametrize("order", [torch.contiguous_format, torch.channels_last])
def test_a_windows_gradient_is_that_of_a_slice_in_the_maps_own_order(order: torch.memory_format) -> None:
    scene = SceneVoxels(torch.zeros((1, 4), dtype=torch.long), torch.zeros((1, 3)), 1)
    whole = torch.zeros(1, 3, 8, 16).contiguous(memory_format=order).requires_grad_()
    cut, *_ = windowed(whole, scene, 0.5)
    weight = torch.randn(cut.shape)
    (gradient,) = torch.autograd.grad((cut * weight).sum(), whole)
    assert gradient.stride() == whole.stride()
    assert gradient.count_nonzero() == weight.numel() and gradient.sum() == pytest.approx(float(weight.sum()), abs=1e-5)
    rows, columns = (gradient[0, 0].any(axis).nonzero()[:, 0] for axis in (1, 0))
    inside = gradient[..., rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    torch.testing.assert_close(inside, weight)


def test_a_window_of_the_scene_holds_the_voxels_above_its_cells() -> None:
    marked = torch.arange(8 * 16, dtype=torch.float32).view(1, 1, 8, 16)
    every = torch.stack(torch.meshgrid(*(torch.arange(n) for n in (1, 4, 16, 32)), indexing="ij"), -1).view(-1, 4)
    scene = SceneVoxels(every, every[:, 1:].float(), 1)
    torch.manual_seed(4)
    for _ in range(20):
        cut, voxel, inside = windowed(marked, scene, 0.5)
        assert cut.shape == (1, 1, 4, 8)
        assert inside is not None
        assert inside.sum() == 4 * 8 * 16
        # An offset here is the voxel's old place: its cell's mark says the same.
        z, y, x = (axis[inside] for axis in voxel[1:])
        offset = scene.offset[inside]
        torch.testing.assert_close(offset[:, 0], z.float())
        cell = offset[:, 1] // 2 * 16 + offset[:, 2] // 2
        torch.testing.assert_close(cut[0, 0, y // 2, x // 2], cell)
    whole, voxel, inside = windowed(marked, scene, 1.0)
    assert whole is marked
    torch.testing.assert_close(torch.stack(voxel, dim=1), scene.voxel)
    assert inside is None


def test_windows_cost_what_the_whole_scene_costs_on_average(sample: Sample) -> None:
    settings = of_method(tiny(), "dsrc").settings("student")
    torch.manual_seed(0)
    head = Reconstruction(settings).eval()
    scene = collate([sample], settings, training=True).scene
    fused = torch.randn(1, settings.shrink_channels, settings.grid.height // 2, settings.grid.width // 2)
    with torch.no_grad():
        whole = reconstruction_losses(head, fused, scene)
        parts = [reconstruction_losses(head, fused, scene, 0.5) for _ in range(200)]
    for number in (0, 1):
        np.testing.assert_allclose(np.mean([part[number] for part in parts]), whole[number], rtol=0.1)


def test_reconstruction_heads_say_the_same_in_both_memory_orders() -> None:
    settings = of_method(tiny(), "dsrc").settings("student")
    torch.manual_seed(0)
    head = Reconstruction(settings)
    voxel = [torch.randint(size, (50,)) for size in (2, 4, 10, 12)]
    found = []
    for order in (torch.contiguous_format, torch.channels_last_3d):
        head.zero_grad()
        volume = torch.randn(2, head.offset.in_channels, 4, 10, 12, generator=torch.Generator().manual_seed(1))
        volume = volume.contiguous(memory_format=order).requires_grad_()
        occupancy, offset = head.heads(volume, voxel)
        (occupancy.square().sum() + offset.pow(3).sum()).backward()
        weights = [weight.grad for layer in (head.occupancy, head.offset) for weight in layer.parameters()]
        found.append([occupancy, offset, volume.grad, *weights])
    torch.testing.assert_close(found[1], found[0])


@pytest.mark.parametrize(("step", "share"), [(0, 1.0), (69, 1.0), (85, 0.5), (100, 0.0)])
def test_the_distillation_fades_in_the_last_steps(step: int, share: float) -> None:
    class Trainer:
        estimated_stepping_batches, global_step = 100, step

    recipe = changed(tiny(), distill=DistillSettings(fade=0.3))
    module = DetectionModule(recipe, Detector(recipe.settings("student")))
    module._trainer = Trainer()
    assert module._distillation_factor() == pytest.approx(share)


def test_a_teacher_moves_with_the_student(teacher_file: Path) -> None:
    recipe = of_method(tiny(), "dsrc")
    teacher = load_teacher(teacher_file, recipe.settings("student"))
    module = DetectionModule(recipe, Detector(recipe.settings("student")), teacher).to("meta")
    assert {weight.device.type for weight in teacher.parameters()} == {"meta"}
    assert not any(weight.requires_grad for weight in teacher.parameters())
    assert not {id(weight) for weight in module.parameters()} & {id(weight) for weight in teacher.parameters()}
