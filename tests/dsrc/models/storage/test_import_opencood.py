"""A published state dict becomes a detector that says the same; anything else is refused in one line."""

from pathlib import Path

import numpy as np
import pytest
import torch

from dsrc.__main__ import main
from dsrc.models.fusion import AgentLayout
from dsrc.models.inputs.batch import pillars_of
from dsrc.models.storage.checkpoint import load_detector
from dsrc.models.storage.import_opencood import import_detector
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
    assert "transformer.weight" in refusal({**whole, "transformer.weight": torch.zeros(2)})
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
