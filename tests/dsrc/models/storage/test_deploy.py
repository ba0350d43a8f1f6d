"""A detector made fast for use says what the plain one says."""

import logging
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from msgspec.structs import replace
from torch import nn

from dsrc.models.detector import Detector
from dsrc.models.device import BFLOAT16
from dsrc.models.fusion import FUSIONS, AgentLayout
from dsrc.models.inputs.batch import pillars_of
from dsrc.models.layers.encoder import PillarEncoder, PillarMap, Pillars
from dsrc.models.storage.deploy import ENGINES, FusedConv, FusedEncoder, deployed, engine_for
from dsrc.training.recipes import debug
from sim.errors import SettingsError
from sim.files import file_sha256

AGENTS = (2, 1)


def a_detector(**changes: Any) -> Detector:
    """A small detector whose batch norms have seen something."""
    torch.manual_seed(0)
    detector = Detector(replace(debug().model, stage_blocks=(2, 1, 2), sdd=False, pcp=False, rec=False, **changes))
    generator = torch.Generator().manual_seed(1)
    for module in detector.modules():
        if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d | nn.BatchNorm3d):
            for tensor, low, high in (
                (module.running_mean, -0.2, 0.2),
                (module.running_var, 0.5, 2.0),
                (module.weight, 0.5, 1.5),
                (module.bias, -0.2, 0.2),
            ):
                tensor.data.uniform_(low, high, generator=generator)
    return detector.eval()


def some_pillars(detector: Detector) -> Pillars:
    rng = np.random.default_rng(0)
    low, high = np.array(detector.settings.grid.range_m[:3]), np.array(detector.settings.grid.range_m[3:])
    clouds = [
        np.concatenate([rng.uniform(low, high, (3000, 3)), rng.random((3000, 1))], axis=1).astype(np.float32)
        for _ in range(sum(AGENTS))
    ]
    return pillars_of(clouds, detector.settings)


def assert_same(found: Any, expected: Any, atol: float = 2e-5, rtol: float = 1e-5) -> None:
    for field in fields(expected):
        value, wanted = getattr(found, field.name), getattr(expected, field.name)
        for a, b in zip(value, wanted, strict=True) if isinstance(wanted, tuple) else ((value, wanted),):
            torch.testing.assert_close(a, b, atol=atol, rtol=rtol)


@pytest.mark.parametrize("method", FUSIONS)
def test_it_gives_the_same_maps_for_every_method(method: str) -> None:
    detector = a_detector(fusion=method)
    before = {name: value.clone() for name, value in detector.state_dict().items()}
    fast, pillars = deployed(detector), some_pillars(detector)
    layout = AgentLayout((1, 1, 1)) if method in ("none", "early", "late") else AgentLayout(AGENTS)
    with torch.inference_mode():
        expected = detector(pillars, layout)
        assert_same(fast(pillars, layout), expected)
        # A network's last bits may change from run to run, with how its threads share the work; its weights may not.
        assert_same(detector(pillars, layout), expected)
    assert all(torch.equal(value, before[name]) for name, value in detector.state_dict().items())
    assert any(isinstance(module, FusedConv) for module in fast.modules())


@pytest.mark.parametrize("backbone", ["res2net", "resnet", "plain"])
def test_it_gives_the_same_maps_for_every_backbone(backbone: str, monkeypatch: pytest.MonkeyPatch) -> None:
    detector = a_detector(backbone=backbone, compress=4)
    fast, pillars = deployed(detector), some_pillars(detector)
    assert not any(isinstance(module, nn.BatchNorm2d) for module in fast.modules())
    with torch.inference_mode():
        expected = detector(pillars, AgentLayout(AGENTS))
        assert_same(fast(pillars, AgentLayout(AGENTS)), expected)
        # Where there is no oneDNN.
        monkeypatch.setattr("dsrc.models.storage.deploy._ONEDNN", False)
        assert_same(fast(pillars, AgentLayout(AGENTS)), expected)
        folded = deployed(detector)
        assert not any(isinstance(module, FusedConv | nn.BatchNorm2d) for module in folded.modules())
        assert_same(folded(pillars, AgentLayout(AGENTS)), expected)


def test_a_processor_without_bfloat16_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dsrc.models.storage.deploy.BFLOAT16", False)
    with pytest.raises(SettingsError, match=r"^engine: bf16: expected a processor with bfloat16 .*, found none"):
        ENGINES["bf16"](a_detector())


def test_auto_is_bfloat16_where_the_processor_computes_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    weights = tmp_path / "detector.pt"
    weights.write_bytes(b"weights")
    caplog.set_level(logging.INFO, "dsrc.models.storage.deploy")
    monkeypatch.setattr("dsrc.models.storage.deploy.BFLOAT16", True)
    assert engine_for(weights) == engine_for(str(weights)) == "bf16" and engine_for(weights, device="cuda") == "fused"
    monkeypatch.setattr("dsrc.models.storage.deploy.FLOAT32_ONLY", frozenset({file_sha256(weights)}))
    assert engine_for(weights) == "fused"
    monkeypatch.setattr("dsrc.models.storage.deploy.BFLOAT16", False)
    assert engine_for(weights) == "fused"
    reasons = ("processor computes bfloat16", "device is cuda", "has not passed the gate", "processor has no bfloat16")
    assert [why in text for why, text in zip(reasons, caplog.messages, strict=True)] == [True] * 4


def test_an_engine_that_is_asked_for_is_no_other() -> None:
    assert [engine_for(Path("no.pt"), name) for name in ENGINES] == list(ENGINES)
    with pytest.raises(SettingsError, match="engine: unknown 'atuo'; did you mean 'auto'"):
        engine_for(Path("no.pt"), "atuo")


@pytest.mark.skipif(not BFLOAT16, reason="needs a processor with bfloat16")
@pytest.mark.parametrize("method", sorted({"attention", "late"} | {name for name in FUSIONS if FUSIONS[name].start}))
def test_half_the_digits_give_nearly_the_same_scores(method: str) -> None:
    detector = a_detector(fusion=method)
    coarse, pillars = deployed(detector, torch.bfloat16), some_pillars(detector)
    layout = AgentLayout((1, 1, 1)) if method in ("none", "early", "late") else AgentLayout(AGENTS)
    with torch.inference_mode():
        expected, found = detector(pillars, layout), coarse(pillars, layout)
    assert found.cls.dtype == torch.float32
    difference = (found.cls.sigmoid() - expected.cls.sigmoid()).abs().max()
    assert 0 < difference < 0.005


@pytest.mark.slow
def test_compiled_it_gives_the_same_maps() -> None:
    detector = a_detector()
    pillars = some_pillars(detector)
    fast = ENGINES["compiled"](detector)
    with torch.inference_mode():
        assert_same(fast(pillars, AgentLayout(AGENTS)), detector(pillars, AgentLayout(AGENTS)))


def test_without_a_compiler_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dsrc.models.storage.deploy.shutil.which", lambda name: None)
    with pytest.raises(SettingsError, match="C\\+\\+ compiler") as caught:
        ENGINES["compiled"](a_detector())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("changes", [{}, {"padded_slots": True}, {"role": "teacher", "pcp": True}])
def test_pillars_in_one_pass_have_the_features_of_the_encoder(changes: dict[str, Any]) -> None:
    settings = replace(debug().model, **{"sdd": False, "pcp": False, "rec": False} | changes)
    torch.manual_seed(0)
    encoder = PillarEncoder(settings).eval().requires_grad_(False)
    generator = torch.Generator().manual_seed(1)
    for tensor, low, high in (
        (encoder.norm.running_mean, -0.2, 0.2),
        (encoder.norm.running_var, 0.5, 2.0),
        (encoder.norm.weight, -1.5, 1.5),  # a negative one turns the maximum into the minimum
        (encoder.norm.bias, -0.2, 0.2),
    ):
        tensor.data.uniform_(low, high, generator=generator)
    rng = np.random.default_rng(0)
    low, high = np.array(settings.grid.range_m[:3]), np.array(settings.grid.range_m[3:])
    clouds = [
        np.concatenate([rng.uniform(low, high, (count, 3)), rng.random((count, settings.point_features - 3))], axis=1)
        for count in (6000, 0, 500)
    ]
    pillars = pillars_of([cloud.astype(np.float32) for cloud in clouds], settings)
    fused = FusedEncoder(encoder, dense=True)
    with torch.inference_mode():
        torch.testing.assert_close(fused.features(pillars), encoder.features(pillars), atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(fused(pillars), encoder(pillars), atol=1e-5, rtol=1e-5)
        nothing = pillars_of([np.zeros((0, settings.point_features), np.float32)], settings)
        assert not fused(nothing).any()


def test_a_map_by_its_pillars_is_the_dense_map() -> None:
    coords = torch.tensor([[0, 0, 0], [0, 2, 5], [1, 3, 2], [1, 6, 4]])
    sparse = PillarMap(torch.arange(1.0, 9.0).view(4, 2), coords, clouds=2, height=8, width=6)
    dense = sparse.dense()
    assert dense.shape == (2, 2, 8, 6) and dense[1, :, 6, 4].tolist() == [7.0, 8.0] and dense.sum() == 36.0
    torch.testing.assert_close(sparse.halved().dense(), dense[:, :, ::2, ::2])
    filled = sparse.dense(torch.tensor([0.5, -1.0]))
    torch.testing.assert_close(filled, torch.where(dense > 0, dense, torch.tensor([0.5, -1.0])[:, None, None]))
    conv = FusedConv(torch.randn(3, 2, 1, 1), torch.randn(3), relu=True)
    torch.testing.assert_close(conv.of_pillars(sparse), conv(dense), atol=1e-6, rtol=1e-6)


@pytest.mark.skipif(not BFLOAT16, reason="needs a processor with bfloat16")
def test_in_bfloat16_frames_of_nearly_as_many_pillars_share_a_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    """OneDNN keeps a kernel for each number of rows: a campaign of thousands of frames had gigabytes of them."""
    seen, plain = [], nn.functional.linear

    def linear(x: torch.Tensor, *weights: torch.Tensor) -> torch.Tensor:
        seen.append(len(x))
        return plain(x, *weights)

    monkeypatch.setattr("dsrc.models.storage.deploy.functional.linear", linear)
    conv = FusedConv(torch.randn(3, 2, 1, 1), torch.randn(3)).bfloat16()
    for count in (1, 4, 1000):
        coords = torch.stack([torch.zeros(count), torch.arange(count) // 50, torch.arange(count) % 50], 1).long()
        sparse = PillarMap(torch.randn(count, 2), coords, clouds=1, height=32, width=50)
        dense = conv(sparse.dense().bfloat16())
        torch.testing.assert_close(conv.of_pillars(sparse), dense, atol=2e-2, rtol=2e-2)
    assert len(set(seen)) == 1
