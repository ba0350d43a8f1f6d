"""A published state dict becomes a detector that says the same; anything else is refused in one line."""

from pathlib import Path

import numpy as np
import pytest
import torch

from dsrc.__main__ import main
from dsrc.models.fusion import AgentLayout
from dsrc.models.inputs.batch import pillars_of
from dsrc.models.storage.checkpoint import load_detector, save_detector
from dsrc.models.storage.deploy import deployed
from dsrc.models.storage.import_dsrc import import_detector
from dsrc.ops.grid import GridSpec
from dsrc.training.recipes import RECIPES
from sim.boxes import Boxes
from sim.errors import CheckpointError
from tests.dsrc.models.reference import golden, state


def grid_of(notes: dict) -> GridSpec:
    return GridSpec(range_m=tuple(notes["config"]["range"]), cell_m=notes["config"]["voxel"][0])


def clouds_of(arrays: dict, grid: GridSpec, name: str = "points") -> list[np.ndarray]:
    clouds = [arrays[f"{name}/{i}"] for i in range(sum(key.startswith(f"{name}/") for key in arrays))]
    low, high = np.array(grid.range_m[:3]), np.array(grid.range_m[3:])
    return [cloud[((cloud[:, :3] > low) & (cloud[:, :3] < high)).all(1)] for cloud in clouds]


def written(path: Path, content: object) -> Path:
    torch.save(content, path)
    return path


def test_an_imported_detector_says_the_same_of_the_same_points(tmp_path: Path) -> None:
    arrays, notes = golden("dsrc_base_small")
    grid = grid_of(notes)
    path = written(tmp_path / "net_epoch1.pth", {f"module.{k}": v for k, v in state(arrays).items()})
    out = tmp_path / "detector.pt"
    ends = [str(value) for value in grid.range_m]
    main(["model", "import", str(path), "--out", str(out), "--cell-m", str(grid.cell_m), "--range-m", *ends])
    detector = load_detector(out)
    assert detector.settings.stage_blocks == tuple(notes["config"]["layer_nums"])
    assert detector.settings.base_width == 26
    # What no tensor says is as in the preset of the released code.
    released = RECIPES["dsrc-code"]().model
    fields = ("max_extent_m", "score_threshold", "max_points", "max_pillars", "box_order", "padded_slots", "team_by")
    for field in fields:
        assert getattr(detector.settings, field) == getattr(released, field), field
    clouds = clouds_of(arrays, grid)
    with torch.inference_mode():
        output = detector(pillars_of(clouds, detector.settings), AgentLayout((len(clouds),)))
    for found, name in ((output.cls, "psm"), (output.reg, "rm")):
        np.testing.assert_allclose(found.numpy(), arrays[f"out/{name}"], rtol=0, atol=1e-4)


@pytest.mark.parametrize("teacher", [False, True])
def test_both_halves_of_a_students_file_are_imported(tmp_path: Path, teacher: bool) -> None:
    arrays, notes = golden("dsrc_student_train")
    path = written(tmp_path / "student.pth", {"state_dict": state(arrays)})
    detector = import_detector(path, grid_of(notes), teacher)
    assert detector.settings.role == ("teacher" if teacher else "student")
    assert detector.settings.point_features == (5 if teacher else 4)
    grid = grid_of(notes)
    clouds = clouds_of(arrays, grid, "clouds_paint" if teacher else "points")
    clouds = [clouds[i] for i in (0, 1, 4)] if teacher else clouds
    with torch.inference_mode():
        output = detector(pillars_of(clouds, detector.settings), AgentLayout((2, 1)))
    end = "_teacher" if teacher else ""
    np.testing.assert_allclose(output.cls.numpy(), arrays[f"eval/psm{end}"], rtol=0, atol=1e-4)
    np.testing.assert_allclose(output.reg.numpy(), arrays[f"eval/rm{end}"], rtol=0, atol=1e-4)


def test_other_files_are_refused(tmp_path: Path) -> None:
    arrays, notes = golden("dsrc_base_small")
    whole, grid = state(arrays), grid_of(notes)

    def refusal(content: object, **options: bool) -> str:
        path = written(tmp_path / "net.pth", content)
        with pytest.raises(CheckpointError) as error:
            import_detector(path, grid, **options)
        assert "\n" not in str(error.value) and str(path) in str(error.value)
        return str(error.value)

    lacking = {k: v for k, v in whole.items() if k != "cls_head.bias"}
    assert "cls_head.bias" in refusal(lacking)
    assert "transformer.weight; networks of OpenCOOD" in refusal({**whole, "transformer.weight": torch.zeros(2)})
    assert "shape" in refusal({**whole, "reg_head.weight": torch.zeros(14, 3, 1, 1)})
    assert "finite" in refusal({**whole, "cls_head.bias": torch.full((2,), torch.nan)})
    assert "pillar_vfe" in refusal({"conv.weight": torch.zeros(2)})
    assert "none" in refusal(whole, teacher=True)
    assert "list" in refusal([1, 2])
    assert "no pickled objects" in refusal({"x": Boxes.zeros()})
    for garbage in (b"", b"root:x:0:0:root", b"q\x00q\x01", b"\x80\x02}q\x00."):
        (tmp_path / "garbage.pth").write_bytes(garbage)
        with pytest.raises(CheckpointError, match=r"garbage.pth: (file|state): expected"):
            import_detector(tmp_path / "garbage.pth", grid)
    with pytest.raises(CheckpointError, match="no such"):
        import_detector(tmp_path / "nothing.pth", grid)


def test_decoder_widths_by_stage_are_imported(tmp_path: Path) -> None:
    arrays, notes = golden("dsrc_base_small")
    reference, widths = state(arrays), (24, 32, 40)
    for k, width in enumerate(widths):
        # One stage gets fewer channels than the golden has, one more; those left out or added are silent.
        for name in ("0.weight", "1.weight", "1.bias", "1.running_mean", "1.running_var"):
            tensor, along = reference[f"backbone.deblocks.{k}.{name}"], int(name == "0.weight")
            kept = tensor.narrow(along, 0, min(width, tensor.shape[along]))
            more = list(kept.shape)
            more[along] = width - more[along]
            filled = torch.ones(more) if name == "1.running_var" else torch.zeros(more)
            reference[f"backbone.deblocks.{k}.{name}"] = torch.cat([kept, filled], along)
    shrink = reference["shrink_conv.layers.0.double_conv.0.weight"]
    parts = [part[:, :width] for part, width in zip(shrink.split(32, dim=1), widths, strict=True)]
    parts = [torch.nn.functional.pad(p, (0, 0, 0, 0, 0, w - p.shape[1])) for p, w in zip(parts, widths, strict=True)]
    reference["shrink_conv.layers.0.double_conv.0.weight"] = torch.cat(parts, dim=1)
    detector = import_detector(written(tmp_path / "wide.pth", reference), grid_of(notes))
    assert detector.settings.decoder_channels == widths
    assert [up[0].weight.shape[1] for up in detector.decoder] == list(widths)
    # The same network in ours with one width, where the channels that were cut are silent.
    even = state(arrays)
    for name in ("1.weight", "1.bias"):
        even[f"backbone.deblocks.0.{name}"][24:] = 0.0
    same = import_detector(written(tmp_path / "even.pth", even), grid_of(notes))
    assert same.settings.decoder_channels == 32
    pillars = pillars_of(clouds_of(arrays, grid_of(notes)), same.settings)
    with torch.inference_mode():
        for made in (detector, deployed(detector)):
            torch.testing.assert_close(made(pillars, AgentLayout((3,))).cls, same(pillars, AgentLayout((3,))).cls)
    save_detector(tmp_path / "detector.pt", detector, half=False)
    assert load_detector(tmp_path / "detector.pt").settings == detector.settings
