"""A network that was trained in CARLA's left-handed frame sees what it was trained on, and says what is there."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from msgspec.structs import replace as changed

from dsrc.data.drives import list_drives, open_drive
from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.data.sample import Sample, SampleRequest, make_sample
from dsrc.models.detector import Detector
from dsrc.models.fusion import FUSIONS
from dsrc.models.inputs.batch import collate
from dsrc.models.inputs.trained_frame import as_trained, mirrored
from dsrc.models.settings import ModelSettings
from dsrc.models.storage.import_dsrc import import_detector
from dsrc.ops.coding import REFERENCE_ORDER, decode
from dsrc.ops.grid import GridSpec
from dsrc.ops.iou import bev_iou
from sensors.frame import Frame
from sensors.sweep import make_sweep
from sim.boxes import Boxes
from tests.dsrc.data import goldens
from tests.dsrc.models.reference import FIXTURES, golden, state
from tests.dsrc.models.test_detector import talkative
from tests.dsrc.training.drive import SPEC, frame

LEFT = {"left_handed": True, "intensity_steps": 255}
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def mirror_image(sample: Sample) -> Sample:
    """The sample in a world seen in a mirror; all is turned here by hand."""

    def turned(cloud: np.ndarray) -> np.ndarray:
        return cloud * np.array([1, -1, 1, 1], np.float32)

    return replace(
        sample,
        clouds=tuple(map(turned, sample.clouds)),
        ego_from_agent=MIRROR @ sample.ego_from_agent @ MIRROR,
        boxes=Boxes.from_array(sample.boxes.array * [1, -1, 1, 1, 1, 1, -1], object_id=sample.boxes.object_id),
        agent_boxes=tuple(Boxes.from_array(b.array * [1, -1, 1, 1, 1, 1, -1]) for b in sample.agent_boxes),
        lost=tuple(tiles[::-1].copy() for tiles in sample.lost),
    )


def test_the_pillars_of_a_tree_are_the_references(tmp_path: Path) -> None:
    mini = goldens.unpack_opv2v_mini(tmp_path)
    settings = ModelSettings(sdd=False, pcp=False, rec=False, **LEFT)
    sample = make_sample(
        open_drive(list_drives(mini)[0]).read(0), None, SampleRequest(settings.grid, keep_ego_box=True)
    )
    pillars = collate([sample], settings, training=False).student
    with np.load(FIXTURES / "opv2v_mini_pillars.npz") as expected:
        for agent in range(3):
            own = (pillars.coords[:, 0] == agent).numpy()
            rows = {tuple(cell): row for row, cell in enumerate(expected[f"coords/{agent}"].tolist())}
            order = [rows[tuple(cell)] for cell in pillars.coords[own][:, 1:].tolist()]
            assert sorted(order) == list(range(len(rows)))
            assert pillars.count[own].tolist() == expected[f"count/{agent}"][order].tolist()
            sums = torch.zeros(len(pillars.count), 4).index_add_(0, pillars.pillar, pillars.points)[own]
            assert np.abs(sums.numpy() - expected[f"sum/{agent}"][order]).max() < 2e-3


def written_tree(root: Path, clouds: list[np.ndarray]) -> Path:
    """Write clouds of the reference's frame as OPV2V's tree of agents that stand in one place."""
    made = frame(0, ground=1, per_car=1)
    agents = []
    for agent, cloud in zip(made.agents, clouds, strict=True):
        n = len(cloud)
        zeros = dict.fromkeys(("ring", "column", "time_offset", "return_number", "fate"), np.zeros(n))
        points, beside = cloud[:, :3] * np.array([1, -1, 1], np.float32), {"object_id": np.full(n, -1)}
        sweep = make_sweep(points, np.eye(4), 0.0, SPEC, intensity=cloud[:, 3], **zeros, **beside)
        agents.append(replace(agent, world_from_body=np.eye(4), sweep=sweep))
    # Without true boxes no point lies on an agent itself: the golden's clouds lie on it, too.
    empty = Frame(0, 0.0, tuple(agents), Boxes.zeros(), np.zeros((0, 2)), np.zeros((len(agents), 0), np.int64))
    write_frame(root / "drive", empty)
    return root / "drive"


def test_an_imported_network_finds_the_references_boxes_in_a_tree(tmp_path: Path) -> None:
    arrays, notes = golden("dsrc_base_small")
    grid = GridSpec(range_m=tuple(notes["config"]["range"]), cell_m=notes["config"]["voxel"][0])
    torch.save(state(arrays), tmp_path / "net_epoch1.pth")
    detector = import_detector(tmp_path / "net_epoch1.pth", grid)
    assert detector.settings.left_handed and detector.settings.intensity_steps == 255
    # This golden's intensities are no multiples of 1 / 255.
    detector.settings = changed(detector.settings, intensity_steps=None)
    clouds = [arrays[f"points/{i}"] for i in range(3)]
    drive = open_drive(written_tree(tmp_path, clouds))
    sample = make_sample(drive.read(0), None, SampleRequest(grid, comm_range_m=1.0))
    assert [len(cloud) for cloud in sample.clouds] == [
        int(((c[:, :3] > grid.range_m[:3]) & (c[:, :3] < grid.range_m[3:])).all(1).sum()) for c in clouds
    ]
    found = detector.detect(sample)
    assert len(found) > 3
    maps = arrays["out/rm"][0].reshape(2, 7, *arrays["out/rm"].shape[2:])
    deltas = np.moveaxis(maps, (0, 1), (2, 3))[..., REFERENCE_ORDER].astype(np.float64)
    said = decode(deltas, detector.anchors).reshape(-1, 7) * [1, -1, 1, 1, 1, 1, -1]
    scores = 1 / (1 + np.exp(-np.moveaxis(arrays["out/psm"][0], 0, -1).reshape(-1)))
    for box, score in zip(found.boxes.array, found.score, strict=True):
        off = np.abs(said[:, :6] - box[:6]).max(1) + np.abs(np.sin(said[:, 6] - box[6]))
        assert off.min() < 1e-3
        assert abs(scores[off.argmin()] - score) < 1e-4


@pytest.mark.parametrize("fusion", [*FUSIONS, "own frame", "aligned"])
def test_a_left_handed_network_sees_the_mirror_image_of_what_it_is_given(fusion: str) -> None:
    changes = {
        "own frame": {"fusion": "coalign", "own_frame": True},
        "aligned": {"fusion": "attention", "align_poses": True},
    }.get(fusion, {"fusion": fusion})
    detector = talkative(sdd=False, pcp=False, rec=False, **changes)
    torch.nn.init.zeros_(detector.reg_head.bias)
    sample = make_sample(frame(0, ground=300, per_car=60), 1000, detector.settings.grid)
    if fusion == "attention":
        lost = np.zeros((6, 12), bool)
        lost[:2, 5:] = True
        sample = replace(sample, lost=(np.zeros((0, 0), bool), lost, np.zeros((0, 0), bool)))
    plain = detector.detect(mirror_image(sample))
    detector.settings = changed(detector.settings, left_handed=True)
    left = detector.detect(sample)
    assert len(left) > 3
    np.testing.assert_allclose(left.boxes.array[:, :6], plain.boxes.array[:, :6] * [1, -1, 1, 1, 1, 1], atol=1e-6)
    assert np.abs(np.sin(left.boxes.yaw + plain.boxes.yaw)).max() < 1e-6
    np.testing.assert_allclose(left.score, plain.score, atol=1e-6)


def test_the_truth_of_a_batch_stays_right_handed_and_its_targets_do_not() -> None:
    settings = changed(talkative(sdd=False, pcp=False, rec=False).settings, fusion="attention")
    sample = make_sample(frame(0, ground=300, per_car=60), 1000, settings.grid)
    left = collate([sample], changed(settings, **LEFT), training=True)
    plain = collate([mirror_image(sample)], settings, training=True)
    assert np.array_equal(left.boxes[0].array, sample.boxes.array)
    assert torch.equal(left.targets.positive, plain.targets.positive)
    assert torch.allclose(left.targets.regression, plain.targets.regression, atol=1e-6)


def test_intensities_are_those_of_eight_bits() -> None:
    sample = make_sample(frame(0, ground=300, per_car=60), 1000, GridSpec())
    settings = ModelSettings(intensity_steps=255)
    for cloud, own in zip(as_trained(sample, settings).clouds, sample.clouds, strict=True):
        assert np.array_equal(cloud[:, :3], own[:, :3])
        assert np.abs(cloud[:, 3] * 255 - np.round(own[:, 3] * 255)).max() < 1e-4
    assert as_trained(sample, ModelSettings()) is sample


def test_boxes_mirrored_twice_are_the_same_bit_for_bit() -> None:
    rng = np.random.default_rng(0)
    boxes = Boxes.from_array(np.column_stack([rng.normal(size=(9, 3)), np.ones((9, 3)), rng.uniform(-np.pi, np.pi, 9)]))
    boxes = replace(boxes, yaw=np.array([np.pi, 0.0, *boxes.yaw[2:]]))
    assert np.array_equal(mirrored(mirrored(boxes)).array, boxes.array)
    # The mirror image of the footprint is the footprint of the mirror image.
    corners = mirrored(boxes).corners()[:, :4, :2]
    expected = boxes.corners()[:, [1, 0, 3, 2], :2] * [1, -1]
    assert np.abs(corners - expected).max() < 1e-12
    assert bev_iou(mirrored(boxes).array, mirrored(boxes).array).diagonal().min() > 0.999


def test_a_left_handed_network_has_a_grid_that_is_even() -> None:
    uneven = GridSpec((-6.4, -3.2, -3.0, 6.4, 6.4, 1.0))
    with pytest.raises(ValueError, match=r"left_handed: expected a grid that is even about y = 0, found -3.2 to 6.4 m"):
        Detector(ModelSettings(grid=uneven, left_handed=True))
