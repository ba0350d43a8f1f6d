"""The rivals' backbones and the layers around them equal the reference, given its weights."""

import pytest
import torch
from torch import nn

from dsrc.models.layers.backbones import plain, resnet
from dsrc.models.layers.blocks import Compressor, double_conv, upsample
from tests.dsrc.models.reference import close, golden, matching, state

PARTS = {
    "base": (r"base/blocks\.(\d)\.(\d+)\.(.*)", lambda m: f"stages.{m[1]}.{int(m[2]) - 1}.{m[3]}"),
    "resnet": (r"resnet/resnet\.layer(\d)\.(.*)", r"stages.\1.\2"),
}


@pytest.mark.parametrize("name", ["base", "resnet"])
def test_a_backbone_and_its_decoder_equal_the_reference(name: str) -> None:
    arrays, notes = golden("baseline_backbones")
    config, weights, x = notes["config"], state(arrays), torch.from_numpy(arrays["x"])
    widths, blocks = tuple(config["num_filters"]), tuple(config["layer_nums"])
    backbone = plain(16, widths, blocks, 0.01) if name == "base" else resnet(16, widths, blocks)
    backbone.load_state_dict(matching(weights, (PARTS[name],)))
    ups = zip(widths, config["num_upsample_filter"], config["upsample_strides"], strict=True)
    decoder = nn.ModuleList(upsample(inputs, outputs, stride, 0.01) for inputs, outputs, stride in ups)
    decoder.load_state_dict(matching(weights, ((rf"{name}/deblocks\.(.*)", r"\1"),)))
    with torch.inference_mode():
        stages = backbone.eval()(x)
        decoded = torch.cat([up(stage) for up, stage in zip(decoder.eval(), stages, strict=True)], dim=1)
    if name == "resnet":
        for k, stage in enumerate(stages):
            close(stage, arrays[f"inter/resnet_stage{k}"], 5e-5)
    close(decoded, arrays[f"out/{name}"], 5e-5)


@pytest.mark.parametrize(("name", "kernel", "stride"), [("shrink_stride2", 3, 2), ("shrink_1x1", 1, 1)])
def test_shrink_convolutions_equal_the_reference(name: str, kernel: int, stride: int) -> None:
    arrays, _ = golden("baseline_backbones")
    layers = double_conv(36, 24, kernel, stride)
    layers.load_state_dict(matching(state(arrays), ((rf"{name}/layers\.0\.double_conv\.(.*)", r"\1"),)))
    close(layers(torch.from_numpy(arrays["out/base"])), arrays[f"out/{name}"], 5e-5)


def test_the_compressor_equals_the_reference() -> None:
    arrays, _ = golden("baseline_backbones")
    compressor = Compressor(16, 4).eval()
    compressor.load_state_dict(matching(state(arrays), ((r"compressor/(en|de)coder\.(.*)", r"\1code.\2"),)))
    close(compressor(torch.from_numpy(arrays["x"])), arrays["out/compressor"], 5e-5)
