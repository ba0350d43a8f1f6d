"""The detector computes what the published networks compute, given their weights."""

import pytest
import torch

from dsrc.models.detector import Detector
from dsrc.models.fusion import AgentLayout
from dsrc.models.storage.names import detector_state
from tests.dsrc.models.reference import close, golden, pillars, settings_of, state


@pytest.mark.parametrize(("agents", "prefix"), [((3,), "out"), ((2, 1), "out_rl1")])
def test_student_equals_the_reference_layer_by_layer(agents: tuple[int, ...], prefix: str) -> None:
    arrays, notes = golden("dsrc_base_small")
    detector = Detector(settings_of(notes["config"])).eval()
    detector.load_state_dict(detector_state(state(arrays)))
    clouds = pillars(*(arrays[f"voxel/voxel_{k}"] for k in ("features", "coords", "num_points")), 3)
    with torch.inference_mode():
        close(detector.encoder.features(clouds), arrays["out/pillar_features"])
        output = detector(clouds, AgentLayout(agents))
    for k, stage in enumerate(output.stages, start=1):
        close(stage, arrays[f"out/stage{k}"])
        close(detector.fusion.fuse(stage, AgentLayout(agents)), arrays[f"{prefix}/fused{k}"])
    close(output.fused, arrays[f"{prefix}/shrunk"])
    close(output.cls, arrays[f"{prefix}/psm"])
    close(output.reg, arrays[f"{prefix}/rm"])


def test_teacher_equals_the_reference_on_painted_clouds() -> None:
    arrays, notes = golden("dsrc_teacher_small")
    detector = Detector(settings_of(notes["config"], role="teacher")).eval()
    detector.load_state_dict(detector_state(state(arrays), teacher=True))
    features, coords, count = (arrays[f"voxel/voxel_{k}"] for k in ("features", "coords", "num_points"))
    with torch.inference_mode():
        close(detector.encoder.features(pillars(features, coords, count, 6)), arrays["out/pillar_features"])
        # Its file also holds the clouds of the objects alone; the network reads the others.
        rows = notes["teacher_rows"]
        kept = torch.isin(torch.from_numpy(coords[:, 0]), torch.tensor(rows)).numpy()
        coords = coords[kept]
        coords[:, 0] = [rows.index(row) for row in coords[:, 0]]
        output = detector(pillars(features[kept], coords, count[kept], 3), AgentLayout((2, 1)))
    close(output.stages[2], arrays["out/stage3"])
    close(output.fused, arrays["out/shrunk"])
    close(output.cls, arrays["out/psm"])
    close(output.reg, arrays["out/rm"])
