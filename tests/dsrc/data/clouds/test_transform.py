"""The transform: the same sample whoever asks, in every form that pipelines have."""

import copy
from multiprocessing.reduction import ForkingPickler
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, Dataset

import dsrc
from dsrc import CorruptTransform
from sim.errors import DataError, SettingsError
from tests.dsrc.data.clouds.test_corrupt import BOXES, street

FOG_OR_SNOW = CorruptTransform(kinds=("fog", "snow"), severities=(2, 4), seed=5)


class Scans(Dataset):
    """Four scans that differ, each corrupted as it is read."""

    def __len__(self) -> int:
        return 4

    def __getitem__(self, index: int) -> torch.Tensor:
        return torch.from_numpy(FOG_OR_SNOW(street()[index:], index))


def test_any_number_of_workers_gives_the_same_samples() -> None:
    alone = [Scans()[index] for index in range(4)]
    for workers in (0, 2):
        loaded = list(DataLoader(Scans(), batch_size=None, num_workers=workers))
        assert all(torch.equal(one, other) for one, other in zip(alone, loaded, strict=True))


def test_a_sample_is_one_of_the_choices_and_all_of_them_come() -> None:
    cloud, lengths = street(), set()
    for index in range(30):
        out = FOG_OR_SNOW(cloud, index)
        assert np.array_equal(out, FOG_OR_SNOW(cloud, index))
        lengths.add(len(out))
    assert len(lengths) > 10
    assert not np.array_equal(FOG_OR_SNOW(cloud, 0), CorruptTransform(kinds=("fog", "snow"), seed=6)(cloud, 0))
    some = CorruptTransform(kinds=("fog",), probability=0.5)
    share = np.mean([some(cloud, index) is cloud for index in range(40)])
    assert 0.25 < share < 0.75


def test_a_sample_without_a_number_is_known_by_its_points() -> None:
    cloud = street()
    assert np.array_equal(FOG_OR_SNOW(cloud), FOG_OR_SNOW(cloud.copy()))
    assert np.array_equal(FOG_OR_SNOW({"points": cloud, "frame_id": "000007"})["points"], FOG_OR_SNOW(cloud, "000007"))
    rng = np.random.default_rng(0)
    assert not np.array_equal(FOG_OR_SNOW(cloud, rng=rng), FOG_OR_SNOW(cloud, rng=rng))


def test_the_forms_of_openpcdet_and_mmdetection3d() -> None:
    cloud = street()
    expected = FOG_OR_SNOW(cloud, 3)
    assert torch.equal(FOG_OR_SNOW(torch.from_numpy(cloud), 3), torch.from_numpy(expected))
    labels = np.arange(len(cloud), dtype=np.int64) + 1
    wrapped = SimpleNamespace(tensor=torch.from_numpy(cloud), points_dim=4)
    sample = {"points": wrapped, "sample_idx": 3, "pts_semantic_mask": labels, "other": "kept"}
    out = FOG_OR_SNOW(sample)
    assert np.array_equal(out["points"].tensor.numpy(), expected)
    assert (out["points"].points_dim, out["other"]) == (4, "kept")
    assert len(out["pts_semantic_mask"]) == len(expected)
    assert set(out["pts_semantic_mask"]) <= {0, *labels}
    assert np.array_equal(wrapped.tensor.numpy(), cloud)
    assert sample["pts_semantic_mask"] is labels


def test_boxes_of_a_sample_serve_the_kinds_that_need_objects() -> None:
    cloud, lossy = street(), CorruptTransform(kinds=("incomplete_echo",), severities=(5,))
    person = np.array([[9.0, -3.0, -1.0, 0.6, 0.6, 1.8, 0.0]])
    boxes = np.concatenate([BOXES[:, :7], person])
    names = np.array(["Car", "Van", "Pedestrian"])
    out = lossy({"points": cloud, "frame_id": "1", "gt_boxes": boxes, "gt_names": names})["points"]
    assert len(out) < len(cloud)
    low = BOXES[:, :7] - [0, 0, 0.75, 0, 0, 0, 0]
    holder = SimpleNamespace(tensor=torch.from_numpy(low), gravity_center=torch.from_numpy(BOXES[:, :3]))
    assert np.array_equal(lossy({"points": cloud, "sample_idx": "1", "gt_bboxes_3d": holder})["points"], out)
    with pytest.raises(SettingsError, match="boxes"):
        lossy(cloud)
    with pytest.raises(DataError, match="points: expected a key of the sample, found pts"):
        lossy({"pts": cloud})


def test_it_travels_to_other_processes() -> None:
    assert len(bytes(ForkingPickler.dumps(FOG_OR_SNOW))) < 500
    assert copy.deepcopy(FOG_OR_SNOW) == FOG_OR_SNOW


@pytest.mark.parametrize(
    "wrong",
    [
        {"kinds": ()},
        {"kinds": "fog"},
        {"kinds": ("frog",)},
        {"severities": (0,)},
        {"probability": 1.5},
        {"kinds": ("spray",), "family": "paper"},
        {"sensor": "hdl"},
    ],
)
def test_a_wrong_setting_is_refused_where_it_is_made(wrong: dict) -> None:
    with pytest.raises(SettingsError):
        dsrc.CorruptTransform(**wrong)
