"""Products of bfloat16 tensors through float32."""

import pytest
import torch
from torch import Tensor, nn

from dsrc.models.layers.half_products import half_products, through_float32

pytestmark = pytest.mark.skipif(not hasattr(torch.library, "get_kernel"), reason="PyTorch replaces kernels from 2.9 on")
CONVOLUTIONS = {
    "wide": nn.Conv2d(8, 4, 3, padding=1),
    "strided": nn.Conv2d(8, 4, 3, stride=2, padding=1, bias=False),
    "of cells": nn.Conv2d(8, 4, 1),
    "of cells without bias": nn.Conv2d(8, 4, 1, bias=False),
    "transposed": nn.ConvTranspose2d(8, 4, 2, stride=2),
    "grouped": nn.Conv2d(8, 4, 1, groups=2),
}


def of_layer(layer: nn.Module, x: Tensor, gradient: Tensor) -> list[Tensor]:
    """Return the output, the gradient of the input, and those of the weights."""
    x = x.detach().requires_grad_()
    out = layer(x)
    return [out, *torch.autograd.grad(out, (x, *layer.parameters()), gradient)]


@pytest.mark.parametrize("order", [torch.contiguous_format, torch.channels_last])
@pytest.mark.parametrize("name", CONVOLUTIONS)
def test_convolution_is_that_of_float32_rounded_once(name: str, order: torch.memory_format) -> None:
    torch.manual_seed(0)
    layer = CONVOLUTIONS[name].to(torch.bfloat16).to(memory_format=order)  # type: ignore[call-overload]
    x = torch.randn(2, 8, 6, 10).bfloat16().to(memory_format=order)
    gradient = torch.randn(layer(x).shape).bfloat16().to(memory_format=order)
    wide = of_layer(layer.float(), x.float(), gradient.float())
    with through_float32():
        found = of_layer(layer.to(torch.bfloat16), x, gradient)
    for one, expected in zip(found, wide, strict=True):
        assert one.dtype == torch.bfloat16 and one.shape == expected.shape
        torch.testing.assert_close(one, expected.bfloat16(), rtol=2**-7, atol=1e-5)
        assert (one == expected.bfloat16()).float().mean() > 0.98


def test_sum_is_of_float32() -> None:
    ones = torch.ones(1, 4096, dtype=torch.bfloat16)
    with through_float32():
        assert (ones @ ones.T).item() == 4096  # a sum in bfloat16 stays at 256
        assert torch.baddbmm(torch.ones(1, 1, 1).bfloat16(), ones[None], ones.T[None]).item() == 4096
        assert nn.functional.linear(ones, ones, torch.ones(1).bfloat16()).item() == 4096


def test_float32_stays_as_it_is() -> None:
    torch.manual_seed(0)
    layer, x = nn.Conv2d(8, 4, 3), torch.randn(2, 8, 6, 10)
    before = of_layer(layer, x, torch.ones(2, 4, 4, 8))
    with through_float32():
        during = of_layer(layer, x, torch.ones(2, 4, 4, 8))
    after = of_layer(layer, x, torch.ones(2, 4, 4, 8))
    for one, two, three in zip(before, during, after, strict=True):
        assert torch.equal(one, two) and torch.equal(one, three)


def test_products_are_replaced_where_the_processor_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    ones = torch.ones(1, 4096, dtype=torch.bfloat16)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr("dsrc.models.layers.half_products.BFLOAT16", False)
    with half_products(True):
        assert (ones @ ones.T).item() == 4096
    calls: list[str] = []
    monkeypatch.setattr("dsrc.models.layers.half_products.through_float32", lambda: calls.append("replaced"))
    half_products(False)
    monkeypatch.setattr("dsrc.models.layers.half_products.BFLOAT16", True)
    half_products(True)
    assert calls == []
