"""A whole training step of the student: losses, gradients and three steps of Adam, as the reference has them."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from dsrc.models.detector import Detector, NetworkOutput
from dsrc.models.fusion import AgentLayout
from dsrc.models.inputs.batch import scene_of
from dsrc.models.layers.encoder import Pillars
from dsrc.models.layers.reconstruction import Reconstruction, SceneVoxels, reconstruction_losses
from dsrc.models.storage.names import detector_state
from dsrc.training.losses import detection_loss, distillation_losses, released
from tests.dsrc.models.reference import close, golden, pillars, reconstruction_state, settings_of, state

AGENTS = (2, 1)


@dataclass
class Step:
    """Student, teacher and head of the golden, and its batch."""

    nets: nn.ModuleDict
    own: Pillars
    teacher: Pillars
    objects_with_teacher: Pillars
    foreground: Tensor
    scene: SceneVoxels
    positive: Tensor
    regression: Tensor

    def losses(self) -> dict[str, Tensor]:
        student = self.nets["student"](self.own, AgentLayout(AGENTS))
        with torch.no_grad():
            teacher = self._teacher_output()
        cls, reg = detection_loss(student.cls, student.reg, self.positive, self.regression)
        mask, offset = reconstruction_losses(self.nets["pcr"], student.fused, self.scene)
        kd = distillation_losses(student, teacher, self.foreground, self.positive, AGENTS, released())
        return {"cls": cls, "reg": reg, "mask": mask, "offset": offset, **kd}

    def _teacher_output(self) -> NetworkOutput:
        """Run the teacher; in training mode its pillar norm sees the objects' clouds in the same batch, as released."""
        net = self.nets["teacher"]
        features = net.encoder.features(self.objects_with_teacher)
        own = torch.isin(self.objects_with_teacher.coords[:, 0], torch.tensor([0, 1, 4]))
        dense = net.encoder.scatter(features[own], self.teacher)
        net.encoder.forward = lambda _: dense
        output = net(self.teacher, AgentLayout(AGENTS))
        del net.encoder.forward
        return output


@pytest.fixture(params=[False, True], ids=["exact", "filled up"])
def step(request: pytest.FixtureRequest) -> tuple[Step, dict[str, NDArray], dict]:
    arrays, notes = golden("dsrc_student_train")
    config = notes["config"]
    settings = settings_of(config)
    nets = nn.ModuleDict(
        {
            "student": Detector(settings),
            "teacher": Detector(settings_of(config, role="teacher")),
            "pcr": Reconstruction(settings),
        }
    )
    reference = state(arrays)
    nets["student"].load_state_dict(detector_state(reference))
    nets["teacher"].load_state_dict(detector_state(reference, teacher=True))
    nets["pcr"].load_state_dict(reconstruction_state(reference))
    nets["teacher"].requires_grad_(False)
    # Torch sums a batch norm's statistics less exactly (5e-5) in the memory order that is fast on CPUs.
    nets.to(memory_format=torch.contiguous_format)
    for name in ("student", "teacher"):
        nets[name].backbone.register_forward_pre_hook(lambda _, inputs: (inputs[0].contiguous(),))
    paint = [arrays[f"voxel_paint/{k}"] for k in ("features", "coords", "num_points")]
    cloud = paint[1][:, 0]
    rows = np.isin(cloud, [0, 1, 4])
    renamed = paint[1][rows].copy()
    renamed[:, 0] = np.array([0, 1, 0, 0, 2])[renamed[:, 0]]
    merged = [_stored_points(arrays, sample) for sample in range(2)]
    own = pillars(*(arrays[f"voxel_own/{k}"] for k in ("features", "coords", "num_points")), 3)
    scene = scene_of(merged, settings)
    return (
        Step(
            nets,
            filled_up(own) if request.param else own,
            pillars(paint[0][rows], renamed, paint[2][rows], 3),
            pillars(*paint, 6),
            torch.from_numpy(arrays["eval/object_mask_full"][:, 0]).bool(),
            scene_filled_up(scene) if request.param else scene,
            torch.from_numpy(arrays["label/pos_equal_one"]).bool(),
            torch.from_numpy(arrays["label/targets"]),
        ),
        arrays,
        notes,
    )


def filled_up(pillars: Pillars) -> Pillars:
    """Return pillars as a device has them that does not know their numbers."""
    nowhere = torch.tensor([pillars.clouds, 0, 0]).repeat(7, 1)
    return Pillars(
        points=torch.cat([pillars.points, torch.zeros(50, pillars.points.shape[1])]),
        pillar=torch.cat([pillars.pillar, len(pillars.count) + torch.arange(50) % 5]),
        coords=torch.cat([pillars.coords, nowhere]),
        count=torch.cat([pillars.count, torch.zeros(7, dtype=torch.int64)]),
        clouds=pillars.clouds,
        padded=True,
    )


def scene_filled_up(scene: SceneVoxels) -> SceneVoxels:
    """Return a scene with some of its voxels twice, of which one is meant."""
    voxel, offset = torch.cat([scene.voxel[:9], scene.voxel]), torch.cat([scene.offset[:9] + 1, scene.offset])
    return SceneVoxels(voxel, offset, scene.samples, torch.arange(len(voxel)) >= 9)


def _stored_points(arrays: dict[str, NDArray], sample: int) -> NDArray:
    features, coords, count = (arrays[f"voxel_merged/{k}"] for k in ("features", "coords", "num_points"))
    return features[(np.arange(features.shape[1])[None] < count[:, None]) & (coords[:, :1] == sample)]


def _compare(losses: dict[str, Tensor], expected: dict[str, float], rtol: float) -> None:
    names = {"conf_loss": "cls", "reg_loss": "reg", "rec_loss": "dae", "fused_loss": "daf", "kd_loss": "dap"}
    names |= {"mask_loss": "mask", "offset_loss": "offset"}
    for name, ours in names.items():
        if name in expected:
            np.testing.assert_allclose(losses[ours].item(), expected[name], rtol=rtol, err_msg=name)


def at_every_voxel(head: torch.nn.Module, fused: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return (B, 1, D, H, W) logits and (B, 3, D, H, W) offsets of all voxels."""
    none = torch.zeros(0, dtype=torch.long)
    logits, _ = head(fused, (none, none, none, none))
    shape = logits[:, 0].shape
    every = torch.meshgrid(*map(torch.arange, shape), indexing="ij")
    _, offset = head(fused, [axis.flatten() for axis in every])
    return logits, offset.unflatten(0, shape).movedim(-1, 1)


def test_losses_and_maps_equal_the_reference_in_eval_mode(step: tuple[Step, dict[str, NDArray], dict]) -> None:
    world, arrays, notes = step
    world.nets.eval()
    _compare(world.losses(), notes["losses"]["eval"], 2e-5)
    with torch.inference_mode():
        output = world.nets["student"](world.own, AgentLayout(AGENTS))
        logits, offset = at_every_voxel(world.nets["pcr"], output.fused)
    close(output.fused, arrays["eval/fused_feature"])
    close(logits, arrays["eval/pcr_mask_logits"])
    close(offset[:, :, :2], arrays["eval/pcr_offset"])


def test_foreground_is_where_the_objects_have_points(step: tuple[Step, dict[str, NDArray], dict]) -> None:
    world, arrays, _ = step
    coords = arrays["voxel_paint/coords"]
    mask = np.zeros((3, 64, 64), bool)
    for row, cloud in enumerate((2, 3, 5)):
        _, _, y, x = coords[coords[:, 0] == cloud].T
        mask[row, y, x] = True
    np.testing.assert_array_equal(mask, world.foreground.numpy())


def test_a_training_step_equals_the_reference(step: tuple[Step, dict[str, NDArray], dict]) -> None:
    world, arrays, notes = step
    world.nets.train()
    losses = world.losses()
    _compare(losses, notes["losses"]["train"], 2e-5)
    sum(losses.values()).backward()
    ours = {f"student.{k}": v for k, v in world.nets["student"].named_parameters()}
    ours |= {f"pcr.{k}": v for k, v in world.nets["pcr"].named_parameters()}
    for name, array in arrays.items():
        if name.startswith("train/grad/"):
            key = name.removeprefix("train/grad/")
            renamed = detector_state({key: torch.zeros(1)}) or reconstruction_state({key: torch.zeros(1)})
            part = "pcr" if key.startswith("pcr") else "student"
            close(ours[f"{part}.{next(iter(renamed))}"].grad, array, 2e-3)
        if name.startswith("train/after1/"):
            key = name.removeprefix("train/after1/")
            teacher = "_teacher" in key
            renamed = detector_state({key: torch.zeros(1)}, teacher) or reconstruction_state({key: torch.zeros(1)})
            part = "pcr" if key.startswith("pcr") else "teacher" if teacher else "student"
            close(world.nets[part].state_dict()[next(iter(renamed))], array)


def test_three_steps_of_adam_stay_with_the_reference(step: tuple[Step, dict[str, NDArray], dict]) -> None:
    world, _, notes = step
    world.nets.train()
    parameters = [p for p in world.nets.parameters() if p.requires_grad]
    adam = torch.optim.Adam(parameters, lr=1e-3, eps=1e-10, weight_decay=1e-4)
    for row in notes["adam3_f64"] if "adam3_f64" in notes else notes["losses"]["adam3_f64"]:
        losses = world.losses()
        expected = dict(zip(notes["adam3_columns"], row, strict=True))
        _compare(losses, expected, 5e-3)
        np.testing.assert_allclose(sum(losses.values()).item(), expected["total"], rtol=5e-3)
        adam.zero_grad()
        sum(losses.values()).backward()
        adam.step()
