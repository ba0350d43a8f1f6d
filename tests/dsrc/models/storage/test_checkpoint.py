"""Detector files: what is saved is loaded, and everything else is refused in one line."""

from pathlib import Path

import pytest
import torch
from msgspec.structs import replace

from dsrc.data.sample import SampleRequest, make_sample
from dsrc.models.detector import Detector, NetworkOutput
from dsrc.models.inputs.batch import collate
from dsrc.models.storage.checkpoint import load_detector, load_student, read_meta, save_detector, with_fusion
from dsrc.training.recipes import debug, small
from sim.errors import CheckpointError
from tests.dsrc.training.drive import frame


def detector(seed: int = 0) -> Detector:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return Detector(debug().model)


def refusal(path: Path) -> str:
    with pytest.raises(CheckpointError) as error:
        load_detector(path)
    message = str(error.value)
    assert "\n" not in message
    assert str(path) in message
    return message


def test_a_detector_comes_back_in_full_or_half_precision(tmp_path: Path) -> None:
    saved = detector()
    for half, tolerance in ((False, 0.0), (True, 1e-3)):
        save_detector(tmp_path / "detector.pt", saved, {"seed": 7, "path": Path("x")}, half=half)
        loaded = load_detector(tmp_path / "detector.pt")
        assert not loaded.training
        assert loaded.settings == saved.settings
        assert read_meta(tmp_path / "detector.pt") == {"seed": 7, "path": "x"}
        for name, tensor in saved.state_dict().items():
            torch.testing.assert_close(loaded.state_dict()[name], tensor, rtol=tolerance, atol=tolerance)


def test_the_small_detector_ships_in_less_than_8_mb(tmp_path: Path) -> None:
    save_detector(tmp_path / "detector.pt", Detector(small().model))
    assert (tmp_path / "detector.pt").stat().st_size < 8e6


def test_missing_garbage_and_foreign_files_are_refused(tmp_path: Path) -> None:
    assert "no such checkpoint" in refusal(tmp_path / "nothing.pt")
    garbage = tmp_path / "garbage.pt"
    garbage.write_bytes(b"not a checkpoint at all")
    assert "something else or damaged" in refusal(garbage)
    garbage.write_bytes(b"root:x:0:0:root")
    assert "something else or damaged" in refusal(garbage)
    whole = tmp_path / "whole.pt"
    save_detector(whole, detector())
    truncated = tmp_path / "truncated.pt"
    truncated.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    assert "something else or damaged" in refusal(truncated)
    torch.save({"state_dict": {}}, garbage)
    assert "format" in refusal(garbage)


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "detector.pt"
    save_detector(path, detector())
    content = torch.load(path, weights_only=True)
    wide = {**content, "settings": {**content["settings"], "shrink_channels": 96}}
    torch.save(wide, path)
    assert "expected shape" in refusal(path)
    del content["state"]["cls_head.bias"]
    torch.save(content, path)
    assert "cls_head.bias" in refusal(path)
    content = {**content, "settings": {**content["settings"], "fusion": "telepathy"}}
    torch.save(content, path)
    assert "telepathy" in refusal(path)


def test_a_damaged_origin_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "detector.pt"
    save_detector(path, detector())
    torch.save(torch.load(path, weights_only=True) | {"meta": 7}, path)
    with pytest.raises(CheckpointError, match="meta: expected what a training has written, found int"):
        read_meta(path)


def test_weights_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    broken = detector()
    torch.nn.init.constant_(broken.cls_head.bias, torch.nan)
    save_detector(tmp_path / "detector.pt", broken)
    assert "finite" in refusal(tmp_path / "detector.pt")


def test_a_file_with_code_in_it_is_not_run(tmp_path: Path) -> None:
    path = tmp_path / "detector.pt"
    torch.save({"format": "dsrc-detector-1", "settings": replace(debug().model, rec=False), "state": {}}, path)
    assert "something else or damaged" in refusal(path)


def test_a_teacher_is_refused_where_there_is_no_ground_truth(tmp_path: Path) -> None:
    path = tmp_path / "teacher.pt"
    save_detector(path, Detector(replace(debug().model, role="teacher")))
    assert load_detector(path).settings.role == "teacher"
    with pytest.raises(CheckpointError, match=r"teacher.pt: settings.role: expected student, found teacher"):
        load_student(path)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"max_points": 0}, "max_points"),
        ({"base_width": 1}, "base_width"),
        ({"grid": {"cell_m": 0.3}}, "multiples of 8"),
    ],
)
def test_settings_that_make_no_network_are_refused(tmp_path: Path, change: dict, word: str) -> None:
    path = tmp_path / "detector.pt"
    save_detector(path, detector())
    content = torch.load(path, weights_only=True)
    torch.save({**content, "settings": {**content["settings"], **change}}, path)
    assert word in refusal(path)


def output_of(teacher: Detector, agents: int) -> NetworkOutput:
    """Return what a teacher makes of the first agents of a frame with three."""
    sample = make_sample(
        frame(0, ground=300, per_car=60), None, SampleRequest(teacher.settings.grid, max_agents=agents)
    )
    batch = collate([sample], teacher.settings, training=False)
    assert batch.teacher is not None
    with torch.inference_mode():
        return teacher(batch.teacher, batch.layout)


def test_a_teacher_of_the_ego_alone_reads_all_agents_with_a_fusion_without_weights() -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        alone = Detector(replace(debug().model, role="teacher", fusion="none")).eval()
    together = with_fusion(alone, "attention")
    assert (together.settings, together.training) == (replace(alone.settings, fusion="attention"), False)
    for name, tensor in alone.state_dict().items():
        assert torch.equal(together.state_dict()[name], tensor)
    assert len(output_of(alone, 2).stages[0]) == 1
    assert len(output_of(together, 2).stages[0]) == 2
    assert not torch.equal(output_of(together, 2).fused, output_of(alone, 2).fused)
    back = with_fusion(together, "none")
    assert torch.equal(output_of(back, 2).fused, output_of(alone, 2).fused)


def test_a_detector_of_another_fusion_has_weights_of_its_own() -> None:
    plain = detector().eval()
    before = {name: tensor.clone() for name, tensor in plain.state_dict().items()}
    with torch.no_grad():
        with_fusion(plain, "max").cls_head.weight.zero_()
    assert all(torch.equal(tensor, before[name]) for name, tensor in plain.state_dict().items())


@pytest.mark.parametrize("fusion", ["v2vnet", "v2xvit", "cobevt", "coalign", "ermvp", "mrcnet"])
def test_a_fusion_with_weights_takes_none_from_a_detector_without(fusion: str) -> None:
    with pytest.raises(CheckpointError, match=rf"fusion: expected .* 'attention', found '{fusion}', where") as error:
        with_fusion(detector(), fusion)
    assert "\n" not in str(error.value)


def test_settings_that_a_fusion_does_not_go_with_are_told() -> None:
    few = Detector(replace(debug().model, share=0.5))
    with pytest.raises(CheckpointError, match="share, bits: expected a fusion of maps, found none"):
        with_fusion(few, "none")
