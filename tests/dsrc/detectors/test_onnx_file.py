"""ONNX files as detectors, run by ONNX Runtime: ours finds what PyTorch finds, another's is points to boxes."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from dsrc.data.drives import open_drives
from dsrc.data.sample import make_sample
from dsrc.detectors.check import check_detector
from dsrc.detectors.open import detector_sha256, open_detector
from dsrc.evaluation.find import detect_drives
from dsrc.evaluation.scoring.read import read_detections
from dsrc.models.storage.checkpoint import load_detector, save_detector
from dsrc.models.storage.export import export_onnx
from sim.errors import CheckpointError
from tests.dsrc.evaluation.small import write_detector, write_drives

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

BOX, RANGE = [[10.0, 2.0, -1.0, 4.2, 1.8, 1.5, 0.3]], "[-40, -40, -3, 40, 40, 1]"


def write_points_to_boxes(path: Path, metadata: dict[str, str]) -> Path:
    """Write a file by the package `onnx` that answers one box, with the mean of the points' columns as its score."""
    helper, number = onnx.helper, onnx.TensorProto.FLOAT
    nodes = [
        helper.make_node("Constant", [], ["boxes"], value=onnx.numpy_helper.from_array(np.float32(BOX), "b")),
        helper.make_node("ReduceMean", ["points"], ["mean"], keepdims=0),
        helper.make_node("Sigmoid", ["mean"], ["one"]),
        helper.make_node("Constant", [], ["shape"], value=onnx.numpy_helper.from_array(np.array([1]), "s")),
        helper.make_node("Reshape", ["one", "shape"], ["score"]),
    ]
    put = [helper.make_tensor_value_info("boxes", number, [1, 7]), helper.make_tensor_value_info("score", number, [1])]
    graph = helper.make_graph(nodes, "g", [helper.make_tensor_value_info("points", number, ["P", 4])], put)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    helper.set_model_props(model, metadata)
    onnx.save(model, path)
    return path


@pytest.mark.parametrize("height", ["sensor", "ground"])
def test_our_export_finds_in_drives_what_the_detector_file_finds(height: str, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    data = write_drives(tmp_path / "data", drives=1)
    detector = load_detector(write_detector(tmp_path / "small.pt", "attfuse"))
    detector.settings = msgspec.structs.replace(detector.settings, height=height)
    save_detector(tmp_path / "small.pt", detector, {"seed": 0}, half=False)
    assert export_onnx(detector, tmp_path / "small.onnx") == "any number"
    found = []
    for name in ("small.pt", "small.onnx"):
        row, (boxes,) = detect_drives(
            checkpoint=str(tmp_path / name), data=data, out=tmp_path / name[-4:], engine="fused"
        )
        assert row.detections > 0
        found.append(read_detections(boxes)[0].frames)
    assert found[0].keys() == found[1].keys()
    for key, one in found[0].items():
        assert np.allclose(found[1][key].boxes.array, one.boxes.array, rtol=0, atol=2e-3)
        assert np.allclose(found[1][key].score, one.score, rtol=0, atol=1e-3)


def test_a_file_of_points_to_boxes_is_a_detector_of_the_range_that_it_says(tmp_path: Path) -> None:
    path = write_points_to_boxes(tmp_path / "theirs.onnx", {"range_m": RANGE})
    detector = open_detector(path)
    assert detector.settings.request.grid.range_m == (-40, -40, -3, 40, 40, 1)
    assert detector.settings.request.max_agents == 1
    (drive,) = open_drives(write_drives(tmp_path / "data", drives=1))
    sample = make_sample(drive.read(0), None, detector.settings.request)
    found = detector.detect(sample)
    assert np.allclose(found.boxes.array, BOX)
    mean = float(np.concatenate(sample.clouds).mean())
    assert found.score == pytest.approx(1 / (1 + np.exp(-mean)), abs=1e-6)
    check_detector(str(path))


def test_weights_beside_the_file_are_part_of_its_hash(tmp_path: Path) -> None:
    path = write_points_to_boxes(tmp_path / "theirs.onnx", {"range_m": RANGE})
    model = onnx.load(path)
    onnx.external_data_helper.convert_model_to_external_data(
        model, location="weights.bin", size_threshold=50, convert_attribute=True
    )
    onnx.save(model, path)
    assert open_detector(path).settings.request.max_agents == 1
    weights, before = tmp_path / "weights.bin", detector_sha256(path)
    assert detector_sha256(path) == before
    weights.write_bytes(weights.read_bytes()[:-1] + b"\x01")
    assert detector_sha256(path) != before


def test_a_file_that_says_no_range_is_refused(tmp_path: Path) -> None:
    path = write_points_to_boxes(tmp_path / "theirs.onnx", {})
    with pytest.raises(CheckpointError, match=r"theirs\.onnx: metadata: expected range_m, 6 numbers, .* found none"):
        open_detector(path)
