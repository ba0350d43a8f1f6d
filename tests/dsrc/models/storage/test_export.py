"""An exported detector says in another runtime what it says in PyTorch."""

from pathlib import Path

import numpy as np
import pytest
import torch

from dsrc.models.detector import Detector
from dsrc.models.fusion import AgentLayout
from dsrc.models.inputs.batch import pillars_of
from dsrc.models.layers.encoder import Pillars
from dsrc.models.storage.export import INPUTS, export_onnx
from sim.errors import SettingsError
from tests.dsrc.models.storage.test_deploy import a_detector


def pillars_with(detector: Detector, agents: int, points: int) -> Pillars:
    rng = np.random.default_rng(agents)
    low, high = np.array(detector.settings.grid.range_m[:3]), np.array(detector.settings.grid.range_m[3:])
    clouds = [
        np.concatenate([rng.uniform(low, high, (points, 3)), rng.random((points, 1))], axis=1).astype(np.float32)
        for _ in range(agents)
    ]
    return pillars_of(clouds, detector.settings)


def assert_same_as_torch(detector: Detector, path: Path, agents: int, points: int) -> None:
    runtime = pytest.importorskip("onnxruntime")
    pillars = pillars_with(detector, agents, points)
    tensors = (pillars.points, pillars.pillar, pillars.coords, pillars.count, torch.zeros(agents, dtype=torch.bool))
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    wanted = {i.name for i in session.get_inputs()}
    cls, reg = session.run(["cls", "reg"], {n: t.numpy() for n, t in zip(INPUTS, tensors, strict=True) if n in wanted})
    with torch.inference_mode():
        expected = detector(pillars, AgentLayout((agents,)))
    np.testing.assert_allclose(cls, expected.cls.numpy(), atol=1e-4, rtol=0)
    np.testing.assert_allclose(reg, expected.reg.numpy(), atol=1e-4, rtol=0)


@pytest.mark.slow
@pytest.mark.parametrize("fusion", ["attention", "max", "none", "coalign"])
def test_logits_are_the_same_for_any_number_of_agents_and_points(fusion: str, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    detector = a_detector(fusion=fusion)
    assert export_onnx(detector, tmp_path / "detector.onnx") == "any number"
    for agents, points in ((1, 50), (2, 3000), (4, 1000)):
        assert_same_as_torch(detector, tmp_path / "detector.onnx", agents, points)


@pytest.mark.slow
@pytest.mark.parametrize("fusion", ["v2vnet", "where2comm", "mrcnet"])
def test_logits_are_the_same_for_the_number_of_agents_that_was_asked_for(fusion: str, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    detector = a_detector(fusion=fusion)
    assert export_onnx(detector, tmp_path / "detector.onnx", agents=3) == "3"
    assert_same_as_torch(detector, tmp_path / "detector.onnx", 3, 1000)


@pytest.mark.parametrize("agents", [-1, 0, 6])
def test_more_agents_than_a_method_takes_are_refused_at_once(agents: int, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=f"export: agents: expected 1 to 5, found {agents}"):
        export_onnx(a_detector(fusion="where2comm", max_agents=5), tmp_path / "detector.onnx", agents)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("agents", [1, 9])
def test_where_any_number_is_taken_the_one_that_is_said_has_no_meaning(agents: int, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    detector = a_detector(fusion="max")
    assert export_onnx(detector, tmp_path / "detector.onnx", agents) == "any number"
    assert_same_as_torch(detector, tmp_path / "detector.onnx", 3, 200)


@pytest.mark.slow
def test_one_agent_may_be_the_number_that_a_method_takes(tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    detector = a_detector(fusion="where2comm")
    assert export_onnx(detector, tmp_path / "detector.onnx", agents=1) == "1"
    assert_same_as_torch(detector, tmp_path / "detector.onnx", 1, 200)


def test_a_method_without_a_form_in_onnx_is_refused_at_once(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="fusion") as caught:
        export_onnx(a_detector(fusion="v2xvit"), tmp_path / "detector.onnx")
    assert "\n" not in str(caught.value) and not list(tmp_path.iterdir())


def test_missing_packages_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dsrc.models.storage.export.importlib.util.find_spec", lambda name: None)
    with pytest.raises(SettingsError, match="pip install onnx"):
        export_onnx(a_detector(), tmp_path / "detector.onnx")
