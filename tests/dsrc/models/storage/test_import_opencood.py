"""A checkpoint of OpenCOOD's is known by its tensors' names and says the same here; others are refused in one line."""

from pathlib import Path

import numpy as np
import pytest
import torch
from msgspec.structs import replace

from dsrc.__main__ import main
from dsrc.models.detector import Detector, NetworkOutput
from dsrc.models.fusion import AgentLayout
from dsrc.models.inputs.batch import pillars_of
from dsrc.models.storage.checkpoint import load_detector
from dsrc.models.storage.deploy import deployed
from dsrc.models.storage.import_opencood import PublishedTraining, import_opencood
from dsrc.ops.coding import decode, in_half_turn
from sim.errors import CheckpointError, SettingsError, UserError
from tests.dsrc.models.storage.opencood_networks import AGENTS, RANGE_M, STAGES, network, said

HERE = PublishedTraining(range_m=RANGE_M, max_agents=AGENTS)

NETWORKS = {
    "early": ({}, 1),
    "late": ({}, 1),
    "attention": ({}, 1),
    "max_map": ({"kernel": 1}, 1),
    "v2vnet": ({"fusion": "v2vnet", "kernel": 3}, 2),
    "v2vnet compressed": ({"fusion": "v2vnet", "kernel": 3, "compress": 4}, 2),
    "v2xvit": ({"fusion": "v2xvit", "kernel": 3}, 2),
    "cobevt": ({"fusion": "cobevt", "kernel": 3}, 2),
    "where2comm": ({"fusion": "where2comm", "kernel": 3}, 2),
    "ermvp": ({"fusion": "ermvp", "kernel": 3}, 2),
    "coalign": ({"residual": True}, 1),
    "coalign of its authors": ({"residual": True, "kernel": 3, "directions": True}, 1),
    "max of residual blocks": ({"residual": True, "kernel": 3}, 2),
}
AMBIGUOUS = ("early", "late", "attention", "max")


def written(path: Path, content: object) -> Path:
    torch.save(content, path)
    return path


def clouds(number: int = AGENTS) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    low, high = np.array((*RANGE_M[:3], 0.0)), np.array((*RANGE_M[3:], 1.0))
    return [rng.uniform(low, high, (900, 4)).astype(np.float32) for _ in range(number)]


def output_of(detector: Detector, method: str) -> NetworkOutput:
    # Methods that detect in each cloud alone get one sample per cloud.
    layout = AgentLayout((1,) * AGENTS) if method in ("early", "late") else AgentLayout((AGENTS,))
    with torch.inference_mode():
        return detector(pillars_of(clouds(), detector.settings), layout)


@pytest.mark.parametrize("name", NETWORKS)
def test_an_imported_network_says_what_the_published_one_says(tmp_path: Path, name: str) -> None:
    parts, stride = NETWORKS[name]
    method, state = name.split()[0], network(**parts)
    path = written(tmp_path / "net_epoch1.pth", state)
    asked = method if method in AMBIGUOUS else None
    detector = import_opencood(path, replace(HERE, method=asked, shrink_stride=stride if method == "max" else None))
    assert detector.settings.fusion == method
    assert detector.settings.head_stride == 2 * stride
    assert detector.anchors.shape == (32 // (2 * stride), 64 // (2 * stride), 2, 7)
    pillars = pillars_of(clouds(), detector.settings)
    expected = said(state, pillars, method, stride)
    for made in (detector, deployed(detector)):
        output = output_of(made, method)
        for found, wanted in zip((output.cls, output.reg), expected, strict=False):
            assert found.shape == wanted.shape
            assert (found - wanted).abs().max() < 1e-4 * wanted.abs().max()
    if "directions" in parts:
        first, second = expected[2][:, ::2], expected[2][:, 1::2]
        sure = (second - first).abs() > 1e-3
        assert torch.equal((output.direction > 0)[sure], (second > first)[sure])


def test_a_published_heading_lies_in_the_half_turn_of_its_class() -> None:
    rng = np.random.default_rng(0)
    anchors = np.zeros((3, 4, 2, 7))
    anchors[..., 3:6], anchors[..., 1, 6] = (3.9, 1.6, 1.56), np.pi / 2
    deltas = rng.normal(0.0, 2.0, (1, 14, 3, 4))
    second = rng.random((1, 2, 3, 4)) < 0.5
    turned = in_half_turn(deltas, second, anchors, 0.7853)
    kept = [i for i in range(14) if i % 7 != 6]
    assert np.array_equal(turned[:, kept], deltas[:, kept])
    for anchor in range(2):
        before, after = (
            decode(np.moveaxis(maps[0, 7 * anchor : 7 * anchor + 7], 0, -1), anchors[:, :, anchor])[..., 6]
            for maps in (deltas, turned)
        )
        np.testing.assert_allclose(np.sin(2 * (after - before)), 0.0, atol=1e-9)
        into = (after - 0.7853) % (2 * np.pi)
        assert np.array_equal(into > np.pi, second[0, anchor])


def test_widths_and_strides_are_found_and_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path / "net_epoch9.pth", {"model_state_dict": network("cobevt", kernel=3)})
    out, ends = tmp_path / "detector.pt", [str(value) for value in RANGE_M]
    options = ["--family", "opencood", "--range-m", *ends, "--out", str(out)]
    main(["model", "import", str(path), *options])
    text = capsys.readouterr().out
    settings = load_detector(out).settings
    for line in (
        "method: cobevt, at most 3 agents",
        "backbone: plain, 8/16/24 channels in 1/2/1 blocks",
        "decoder: 8/12/16 channels",
        "shrink: 32 channels, kernel 3",
        "heads: a cell per 4 pillars, anchors of 3.9 x 1.6 x 1.56 m",
        "trained: left-handed, intensities in 255 steps",
        str(out),
    ):
        assert line in text.splitlines()
    assert settings.stage_channels == STAGES and settings.left_handed and settings.intensity_steps == 255
    more = [
        "--right-handed",
        "--own-frame",
        "--intensity-steps",
        "0",
        "--anchor-m",
        "4.5",
        "2",
        "1.56",
        "--shrink-stride",
        "1",
    ]
    main(["model", "import", str(path), *options, *more])
    assert "anchors of 4.5 x 2 x 1.56 m" in capsys.readouterr().out
    detector = load_detector(out)
    settings = detector.settings
    assert settings.own_frame and not settings.left_handed and settings.intensity_steps is None
    assert detector.anchors.shape == (16, 32, 2, 7) and set(detector.anchors[..., 3].flat) == {4.5}


def test_what_does_not_fit_is_named_with_its_shape(tmp_path: Path) -> None:
    whole = network("v2vnet", kernel=3)

    def refusal(content: object, kind: type[UserError] = CheckpointError, **origin: object) -> str:
        path = written(tmp_path / "net.pth", content)
        with pytest.raises(kind) as error:
            import_opencood(path, replace(HERE, **origin))
        assert "\n" not in str(error.value) and str(path) in str(error.value)
        return str(error.value)

    three = {"cls_head.weight": torch.zeros(3, 32, 1, 1)}
    assert "state: cls_head.weight: expected shape (2, 32, 1, 1), found (3, 32, 1, 1)" in refusal(whole | three)
    assert "found fusion_net.delay.weight (2, 5)" in refusal(whole | {"fusion_net.delay.weight": torch.zeros(2, 5)})
    assert "fusion.update" in refusal({k: v for k, v in whole.items() if "conv_gates" not in k})
    assert "backbone.deblocks.2.0.weight" in refusal({k: v for k, v in whole.items() if "deblocks.2" not in k})
    assert "finite" in refusal(whole | {"reg_head.bias": torch.full((14,), torch.inf)})
    gates = "fusion_net.conv_gru.cell_list.0.conv_gates.weight"
    assert f"{gates}: expected shape (64, 96, 3, 3), found (64,)" in refusal(whole | {gates: torch.zeros(64)})
    # What fuses in another way is not taken for what it resembles.
    disco = network(kernel=3) | {"fusion_net.pixel_weight_layer.conv1_1.weight": torch.zeros(128, 64, 1, 1)}
    assert "found fusion_net.pixel_weight_layer.conv1_1.weight (128, 64, 1, 1)" in refusal(disco)
    stages = network(compress=2) | {}
    assert "found naive_compressor.encoder.0.weight" in refusal(stages, method="attention")
    wide = network("where2comm", kernel=3)
    wide["fusion_net.naive_communication.gaussian_filter.weight"] *= 2
    assert "expected a Gaussian of 5 x 5 cells" in refusal(wide)
    # As many tensors fit several methods.
    assert "expected one that fits, of early, late, none, attention, max, coalign" in refusal(network(), SettingsError)
    assert "found v2xvit" in refusal(whole, SettingsError, method="v2xvit")
    assert "grid" in refusal(whole, SettingsError, range_m=(1.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert "grid: expected multiples of 8 cells" in refusal(whole, SettingsError, cell_m=0.3)
    for name, number in (("max_agents", 0), ("shrink_stride", -1), ("anchor_lwh", (4.0, 0.0, 1.5))):
        assert f"settings: {name}" in refusal(whole, SettingsError, **{name: number})
    assert "family dsrc" in refusal({"backbone.resnet.layer1.0.conv3.weight": torch.zeros(2)})
    assert "PointPillar" in refusal({"conv.weight": torch.zeros(2)})


def test_where2comm_that_sends_everything_is_attention(tmp_path: Path) -> None:
    state = network("where2comm", kernel=3)
    path = written(tmp_path / "net.pth", state)
    detector = import_opencood(path, replace(HERE, method="attention", shrink_stride=2))
    expected = said(state, pillars_of(clouds(), detector.settings), "attention", 2)
    assert (output_of(detector, "attention").cls - expected[0]).abs().max() < 1e-4


def test_options_of_one_family_are_not_silent_in_the_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path / "net.pth", network("v2vnet", kernel=3))
    for options in (["--method", "late"], ["--family", "opencood", "--teacher"]):
        with pytest.raises(SystemExit) as error:
            main(["model", "import", str(path), "--out", str(tmp_path / "detector.pt"), *options])
        assert error.value.code == 2
        assert f"leave out {'--method' if '--method' in options else '--teacher'}" in capsys.readouterr().err
