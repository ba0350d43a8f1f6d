"""The gate of bfloat16: its arithmetic, its verdict and what follows from it."""

from pathlib import Path

import msgspec
import pytest
import torch
from torch import nn

from dsrc.detectors.texts import SHIPPED_DETECTOR
from dsrc.models.storage.deploy import FLOAT32_ONLY, FusedConv
from dsrc.tables.table import Table
from sim.files import file_sha256
from studies.bf16_gate import Gate, Result, emulated, gate_rows, passes
from tests.dsrc.models.storage.test_deploy import a_detector

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def measured() -> Result:
    return msgspec.json.decode((ROOT / "studies/shipped/bf16_gate.json").read_bytes(), type=Result)


def rows(*changes: float) -> list[Gate]:
    both = ("AP@0.5", "AP@0.7")
    values = [(dict.fromkeys(both, 80.0), dict.fromkeys(both, 80.0 + change)) for change in changes]
    return [Gate(detector="d", sha256="", condition="c", float32=a, bfloat16=b) for a, b in values]


def test_a_detector_passes_within_the_mean_and_each() -> None:
    assert passes(rows(0.2, -0.4, 1.0))
    assert not passes(rows(0.5, 0.5, -0.05)), "the mean"
    assert not passes(rows(1.6, -1.0, -0.6)), "one condition"


def test_the_result_is_of_the_shipped_detectors(measured: Result) -> None:
    shipped = {path.stem: file_sha256(path) for path in SHIPPED_DETECTOR.parent.glob("*.pt")}
    found = {row.detector: row.sha256 for row in measured.rows}
    assert found == shipped
    assert {shipped[name] for name in measured.failed} == FLOAT32_ONLY
    for name in found:
        assert passes(row for row in measured.rows if row.detector == name) == (name not in measured.failed)


def test_the_page_has_the_result(measured: Result) -> None:
    head, lines = gate_rows(measured)
    table = Table.of(head, lines, len(head)).markdown().rstrip()
    assert table in (ROOT / "docs/models.md").read_text(encoding="utf-8")


def test_emulated_numbers_are_of_bfloat16() -> None:
    fast = emulated(a_detector())
    convs = [layer for layer in fast.modules() if isinstance(layer, FusedConv | nn.Conv2d)]
    assert convs and all(torch.equal(layer.weight, layer.weight.bfloat16().float()) for layer in convs)
    conv = next(layer for layer in convs if isinstance(layer, FusedConv) and layer.weight.shape[2] == 3)
    x = torch.rand(1, conv.weight.shape[1], 9, 9)
    with torch.inference_mode():
        found = conv(x)
        exact = nn.functional.conv2d(
            x.bfloat16().double(), conv.weight.double(), conv.bias.double(), conv.stride, conv.padding
        )
    assert found.dtype == torch.bfloat16
    torch.testing.assert_close(found.double(), exact.relu().bfloat16().double(), atol=1e-3, rtol=2**-8)
