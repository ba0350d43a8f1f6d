"""A convolution joined with its norm, shortcut and ReLU says what the single layers say, and so do its gradients."""

import pytest
import torch
from torch import Tensor, nn

from dsrc.models.layers.backbones import Res2Block, Res2Stage
from dsrc.models.layers.conv_norm import ConvSequence, conv_norm, count_batch


def layers(kind: str) -> tuple[nn.Module, nn.Module, Tensor]:
    torch.manual_seed(0)
    if kind == "conv3d":
        return nn.Conv3d(3, 4, 1), nn.BatchNorm3d(4), torch.randn(2, 3, 2, 4, 4)
    if kind == "transposed":
        return nn.ConvTranspose2d(3, 4, 2, stride=2, bias=False), nn.BatchNorm2d(4), torch.randn(2, 3, 4, 4)
    return (
        nn.Conv2d(3, 4, 3, padding=1, bias=False),
        nn.BatchNorm2d(4, eps=1e-3, momentum=0.05),
        torch.randn(2, 3, 4, 4),
    )


@pytest.mark.parametrize("relu", [True, False])
@pytest.mark.parametrize("shortcut", [True, False])
@pytest.mark.parametrize("kind", ["conv2d", "conv3d", "transposed"])
def test_it_says_what_the_layers_say_one_by_one(kind: str, shortcut: bool, relu: bool) -> None:
    found, expected = [], []
    for results in (found, expected):
        conv, norm, x = layers(kind)
        x.requires_grad_()
        beside = torch.randn_like(conv(x)).requires_grad_()
        if results is found:
            out = conv_norm(x, conv, norm, relu, beside if shortcut else None)
            count_batch(norm)
        else:
            out = norm(conv(x)) + (beside if shortcut else 0.0)
            out = torch.relu(out) if relu else out
        (out * torch.arange(out.numel()).view_as(out).sin()).sum().backward()
        results += [out, x.grad, *(p.grad for p in (*conv.parameters(), *norm.parameters())), *norm.buffers()]
        results += [beside.grad] if shortcut else []
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b)


def test_its_gradient_is_that_of_finite_differences() -> None:
    conv, norm, x = layers("conv2d")
    conv.double(), norm.double()
    beside = torch.randn(2, 4, 4, 4, dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda x, b: conv_norm(x, conv, norm, True, b), (x.double().requires_grad_(), beside.requires_grad_())
    )


def test_a_sequence_has_the_names_and_results_of_a_plain_one() -> None:
    torch.manual_seed(0)
    parts = [nn.Conv2d(3, 4, 1), nn.BatchNorm2d(4), nn.ReLU(), nn.Conv2d(4, 4, 1), nn.ReLU(), nn.Conv2d(4, 2, 1)]
    parts += [nn.BatchNorm2d(2), nn.GELU()]
    joined, plain, x = ConvSequence(*parts), nn.Sequential(*parts), torch.randn(2, 3, 5, 5)
    assert joined.state_dict().keys() == plain.state_dict().keys()
    torch.testing.assert_close(joined(x), plain(x))
    torch.testing.assert_close(joined.eval()(x), plain.eval()(x))


@pytest.mark.parametrize("end", [[], [nn.ReLU()]])
def test_a_run_of_layers_has_the_gradients_of_finite_differences(end: list[nn.Module]) -> None:
    torch.manual_seed(0)
    parts = [nn.Conv2d(2, 3, 1), nn.BatchNorm2d(3), nn.ReLU(), nn.Conv2d(3, 2, 3, padding=1), nn.BatchNorm2d(2), *end]
    joined, x = ConvSequence(*parts).double(), torch.randn(2, 2, 3, 4, dtype=torch.float64, requires_grad=True)
    weights = list(joined.parameters())
    assert torch.autograd.gradcheck(lambda x, *_: joined(x), (x, *weights))


def test_a_stage_of_blocks_is_what_its_layers_are_one_by_one() -> None:
    torch.manual_seed(0)
    blocks = [Res2Block(3, 8, 32, True), Res2Block(8, 8, 32, False), Res2Block(8, 8, 32, False)]
    stage, x = Res2Stage(*blocks).double(), torch.randn(2, 3, 8, 8, dtype=torch.float64)
    found = []
    for run in (stage, lambda x: blocks[2](blocks[1](blocks[0](x)))):
        stage.zero_grad()
        x = x.detach().requires_grad_()
        out = run(x)
        (out * torch.arange(out.numel()).view_as(out).sin()).sum().backward()
        found.append([out, x.grad, *(weight.grad for weight in stage.parameters())])
    torch.testing.assert_close(*found)
