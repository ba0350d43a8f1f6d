"""Deployment of a detector: the same numbers up to rounding, with fewer passes through memory.

On CPUs a plain detector spends half its time between the convolutions. Here batch norms are folded into the convolution
before them, ReLUs and shortcuts fused with the one before (oneDNN's fused convolutions), the channel splits of Res2Net
are convolutions of their own instead of slices that are copied and joined, and every map stays in channels-last order,
which those convolutions need. Pillars are encoded in one compiled loop, and a first layer of 1 x 1 convolutions is
computed for them alone: most cells of a map have no points and all the same value.

These layers cannot be trained, and their state dict has other names than a detector's.
"""

import copy
import logging
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsrc.models.detector import Detector
from dsrc.models.device import BFLOAT16
from dsrc.models.layers.backbones import BasicBlock, Res2Block, Res2Net
from dsrc.models.layers.blocks import Decoder
from dsrc.models.layers.conv_norm import ConvSequence
from dsrc.models.layers.encoder import PillarEncoder, PillarMap, Pillars
from dsrc.ops.pillars import pillar_maxima
from sim.errors import SettingsError, complaint, did_you_mean
from sim.files import file_sha256
from sim.machine import keep_memory

LOG = logging.getLogger(__name__)
FLOAT32_ONLY = frozenset({"509498e29b56c2efc7716c63896580ae2ed2e97270341f11e97f3f6bf8cf5349"})
"""SHA-256 of shipped detector files whose average precision changes more in bfloat16 than `studies/bf16_gate.py`
allows: `small-dsrc-vulnerable.pt`."""
AUTO = "auto"
"""Name that stands for the engine of `engine_for`."""
_ONEDNN = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_convolution_pointwise")
_ROWS = 1024
"""Step of the numbers of pillars that a layer in bfloat16 is computed for."""


def deployed(detector: Detector, precision: torch.dtype = torch.float32) -> Detector:
    """Copy a detector for inference: the same output, faster.

    Args:
        precision: precision of matrix products and maps. `torch.bfloat16` keeps 8 bits of the numbers and is nearly
            three times as fast again on CPUs with matrix units for it (AMX); boxes then move by a centimetre, scores by
            0.005.
    """
    keep_memory()
    fast = copy.deepcopy(detector).eval().requires_grad_(False)
    fused = _by_onednn(detector.cls_head.weight.device, precision)
    if fused:
        _fuse_children(fast)
    else:
        for module in fast.modules():
            _fold_norms(module, precision)
    sparse = fused and isinstance(fast.backbone, Res2Net)
    fast.encoder = FusedEncoder(fast.encoder, dense=not sparse)  # type: ignore[assignment]
    heads = (fast.cls_head, fast.reg_head, fast.direction_head)
    for layer in fast.modules():
        if isinstance(layer, FusedConv) or layer in heads:
            layer.to(precision)
    fast.precision = precision
    return fast


def torch_compiled(detector: Detector) -> Detector:
    """Copy a detector for inference with PyTorch's compiler; the first frames take a minute.

    Raises:
        SettingsError: a C++ compiler is missing.
    """
    on_cpu = detector.cls_head.weight.device.type == "cpu"
    if on_cpu and not any(shutil.which(name) for name in (os.environ.get("CXX", ""), "g++", "clang++", "cl") if name):
        hint = "; without one, detectors are fused by dsrc.models.storage.deploy.deployed"
        raise SettingsError(complaint("compile", "C++ compiler", "g++, clang++, cl or what CXX names", "none", hint))
    fast = copy.deepcopy(detector).eval().requires_grad_(False)
    for part in (fast.backbone, fast.decoder, fast.shrink):
        part.compile()
    return fast


def halved(detector: Detector) -> Detector:
    """Copy a detector for inference in bfloat16, see `deployed`.

    Raises:
        SettingsError: the processor does not compute it.
    """
    if _ONEDNN and not BFLOAT16 and detector.cls_head.weight.device.type == "cpu":
        expected = "a processor with bfloat16 (AVX-512 or AMX)"
        raise SettingsError(complaint("engine", "bf16", expected, "none; take fused"))
    return deployed(detector, torch.bfloat16)


ENGINES: dict[str, Callable[[Detector], Detector]] = {
    "fused": deployed,
    "bf16": halved,
    "compiled": torch_compiled,
    "plain": lambda detector: detector,
}
"""Ways to run a detector, by name."""


def engine_for(path: Path | str, engine: str = AUTO, device: str = "cpu") -> str:
    """Return the name of the engine that runs a detector file: the one that is asked for, or the choice of `auto`.

    `auto` is `bf16` on a CPU that computes it, with a detector that is as good in it, else `fused`. Keys, logs and
    reports hold what is returned, so that results of two machines are never taken for each other.

    Raises:
        SettingsError: the name is unknown.
    """
    if engine != AUTO:
        if engine not in ENGINES:
            raise SettingsError(f"engine: unknown '{engine}'{did_you_mean(engine, (AUTO, *ENGINES))}")
        return engine
    if device != "cpu":
        chosen, why = "fused", f"the device is {device}"
    elif not BFLOAT16:
        chosen, why = "fused", "the processor has no bfloat16"
    elif Path(path).is_file() and file_sha256(Path(path)) in FLOAT32_ONLY:
        chosen, why = "fused", "the detector has not passed the gate of bfloat16"
    else:
        chosen, why = "bf16", "the processor computes bfloat16"
    _tell(str(path), chosen, why)
    return chosen


@cache
def _tell(path: str, engine: str, why: str) -> None:
    """Log a choice, once in a process."""
    LOG.info("engine %s, since %s: %s", engine, why, path)


def _by_onednn(device: torch.device, precision: torch.dtype) -> bool:
    """Whether oneDNN's fused convolutions take maps of this precision on a device."""
    return _ONEDNN and device.type == "cpu" and (BFLOAT16 or precision == torch.float32)


def _fold_norms(module: nn.Module, precision: torch.dtype) -> None:
    """Fold the norms of a block into its convolutions, where no other layers are faster."""
    pairs: list[tuple[nn.Module, str, nn.Module, str]] = []
    if isinstance(module, Res2Block):
        pairs += [(module, "conv1", module, "bn1"), (module, "conv3", module, "bn3")]
        pairs += [(module.convs, str(i), module.bns, str(i)) for i in range(len(module.convs))]
    elif isinstance(module, BasicBlock):
        pairs += [(module, "conv1", module, "bn1"), (module, "conv2", module, "bn2")]
    elif isinstance(module, ConvSequence):
        pairs += [(module, str(i), module, str(i + 1)) for i in range(len(module) - 1)]
    for holder, name, place, after in pairs:
        conv, norm = getattr(holder, name), getattr(place, after)
        if isinstance(conv, nn.Conv2d | nn.ConvTranspose2d) and isinstance(norm, nn.BatchNorm2d):
            weight, bias = folded(conv, norm)
            conv.weight.data, conv.bias = weight, nn.Parameter(bias, requires_grad=False)
            conv.to(precision)
            setattr(place, after, nn.Identity().eval())


def _fuse_children(module: nn.Module) -> None:
    for name, child in module.named_children():
        setattr(module, name, _fused(child))


def _fused(module: nn.Module) -> nn.Module:
    """Return a layer's fused replacement, or else the layer with its children replaced."""
    if isinstance(module, Decoder):
        return FusedDecoder(module)
    if isinstance(module, BasicBlock):
        return FusedBasicBlock(module)
    if isinstance(module, nn.Sequential):
        layers = list(module)
        if layers and all(isinstance(layer, Res2Block) for layer in layers):
            return nn.Sequential(*(FusedRes2Block(layer) for layer in layers if isinstance(layer, Res2Block)))
        return nn.Sequential(*_fused_layers(layers))
    _fuse_children(module)
    return module


def _fused_layers(layers: Sequence[nn.Module]) -> list[nn.Module]:
    """Fuse each convolution of a sequence with its batch norm and ReLU."""
    fused: list[nn.Module] = []
    left = list(layers)
    while left:
        layer = left.pop(0)
        if not (isinstance(layer, nn.Conv2d) and layer.groups == 1 and layer.dilation == (1, 1)):
            fused.append(_fused(layer))
            continue
        norm = left.pop(0) if left and isinstance(left[0], nn.BatchNorm2d) else None
        relu = bool(left) and isinstance(left[0], nn.ReLU)
        if relu:
            left.pop(0)
        fused.append(FusedConv(*folded(layer, norm), layer.stride[0], layer.padding[0], relu))  # type: ignore[arg-type, union-attr, index]
    return fused


def folded(conv: nn.Conv2d | nn.ConvTranspose2d, norm: nn.BatchNorm2d | None) -> tuple[Tensor, Tensor]:
    """Return the weight, in the layer's layout, and the bias of a convolution with its batch norm folded in."""
    outputs = (-1, 1, 1, 1) if isinstance(conv, nn.Conv2d) else (1, -1, 1, 1)
    weight, bias = conv.weight, conv.bias if conv.bias is not None else conv.weight.new_zeros(conv.out_channels)
    if norm is None:
        return weight.clone(), bias.clone()
    if norm.running_mean is None or norm.running_var is None:
        raise ValueError("a batch norm without running statistics cannot be folded")
    scale = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
    return weight * scale.view(outputs), (bias - norm.running_mean) * scale + norm.bias


class FusedEncoder(nn.Module):
    """Pillar encoder with its batch norm folded in, on CPUs in one pass over the points."""

    def __init__(self, encoder: PillarEncoder, dense: bool) -> None:
        """Fuse an encoder; `dense` gives maps of all cells, else of the pillars."""
        super().__init__()
        self.encoder, self.dense = encoder, dense
        scale, shift = encoder.norm.scale_shift()
        # A scale below zero turns the minimum into the maximum: folded into the weight first, it is always the maximum.
        self.register_buffer("weight", (encoder.linear.weight * scale[:, None]).T.contiguous())
        self.register_buffer("shift", shift.clone())

    weight: Tensor
    shift: Tensor

    def forward(self, pillars: Pillars) -> Tensor | PillarMap:
        """Return the (N, C, H, W) feature map; cells without points are zero."""
        with torch.autocast(pillars.points.device.type, enabled=False):
            features = self.features(pillars)
        found = self.encoder.map_of(features, pillars)
        return found.dense() if self.dense or pillars.padded else found

    def features(self, pillars: Pillars) -> Tensor:
        """Return (V, C) features of the pillars."""
        if pillars.points.device.type != "cpu" or pillars.padded or not len(pillars.count):
            return self.encoder.features(pillars)
        arrays = (pillars.points, pillars.count, self.encoder.centre(pillars), self.weight)
        values = torch.from_numpy(pillar_maxima(*(array.numpy() for array in arrays)))
        values += self.shift
        if self.encoder.padded_slots:
            padded = (pillars.count < self.encoder.max_points)[:, None]
            values = torch.where(padded, torch.maximum(values, self.shift), values)
        return values.relu_()


class FusedConv(nn.Module):
    """Convolution with an optional fused ReLU."""

    weight: Tensor
    bias: Tensor

    def __init__(self, weight: Tensor, bias: Tensor, stride: int = 1, padding: int = 0, relu: bool = True) -> None:
        """Make a layer of an (outputs, inputs, k, k) weight and an (outputs,) bias."""
        super().__init__()
        self.stride, self.padding, self.relu = stride, padding, relu
        self.register_buffer("weight", weight.detach().contiguous(memory_format=torch.channels_last))
        self.register_buffer("bias", bias.detach().contiguous())

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, inputs, H, W) to (N, outputs, H', W')."""
        x, stride, padding = x.to(self.weight.dtype), [self.stride] * 2, [self.padding] * 2
        if _ONEDNN and x.device.type == "cpu":
            relu = "relu" if self.relu else "none"
            return torch.ops.mkldnn._convolution_pointwise(
                x, self.weight, self.bias, padding, stride, [1, 1], 1, relu, [], ""
            )
        y = functional.conv2d(x, self.weight, self.bias, stride, padding)
        return y.relu_() if self.relu else y

    def of_pillars(self, x: PillarMap) -> Tensor:
        """Map the pillars by a 1 x 1 convolution to the (N, outputs, H, W) map of all cells."""
        features = x.features.to(self.weight.dtype)
        if features.dtype == torch.bfloat16:  # oneDNN compiles and keeps a kernel for each number of rows
            features = functional.pad(features, (0, 0, 0, -len(features) % _ROWS))
        values = functional.linear(features, self.weight.flatten(1), self.bias)[: len(x.features)]
        empty = self.bias
        if self.relu:
            values, empty = values.relu_(), empty.relu()
        return replace(x, features=values).dense(empty)

    def add_to(self, out: Tensor, x: Tensor) -> Tensor:
        """Add the convolution of x to (N, outputs, H, W) in place, then apply the ReLU if there is one."""
        stride, padding = [self.stride] * 2, [self.padding] * 2
        if _ONEDNN and x.device.type == "cpu":
            relu = "relu" if self.relu else None
            return torch.ops.mkldnn._convolution_pointwise_.binary(
                out, x, self.weight, self.bias, padding, stride, [1, 1], 1, "add", 1.0, relu, [], None
            )
        out += functional.conv2d(x, self.weight, self.bias, stride, padding)
        return out.relu_() if self.relu else out


class FusedRes2Block(nn.Module):
    """Fused Res2 block: convolutions per split, results added in place.

    The first block of a stage leaves its input unchanged; the others overwrite theirs, which is not used elsewhere.
    """

    def __init__(self, block: Res2Block) -> None:
        """Fuse a block."""
        super().__init__()
        self.first = block.first
        splits = len(block.convs) + 1
        weight, bias = folded(block.conv1, block.bn1)
        parts = zip(weight.chunk(splits), bias.chunk(splits), strict=True)
        self.enter = nn.ModuleList(FusedConv(*part) for part in parts)
        self.inner = nn.ModuleList(
            FusedConv(*folded(conv, norm), conv.stride[0], 1)  # type: ignore[arg-type, index]
            for conv, norm in zip(block.convs, block.bns, strict=True)
        )
        weight, bias = folded(block.conv3, block.bn3)
        self.shortcut = None
        if block.downsample is not None:
            along, shift = folded(*block.downsample)  # type: ignore[arg-type]
            self.shortcut = FusedConv(along, shift, 2, relu=False)
        # One bias in all, and one ReLU at the end.
        nothing = torch.zeros_like(bias)
        self.leave = nn.ModuleList(
            FusedConv(part, bias if number == 0 else nothing, relu=number == splits - 1)
            for number, part in enumerate(weight.chunk(splits, dim=1))
        )

    def forward(self, x: Tensor | PillarMap) -> Tensor:
        """Map (N, inputs, H, W) to (N, outputs, H', W'); pillars reach the first block of a backbone alone."""
        if isinstance(x, PillarMap):
            entries = [enter.of_pillars(x) for enter in self.enter]  # type: ignore[operator]
            out = self.shortcut.of_pillars(x.halved())  # type: ignore[union-attr]
        else:
            entries = [enter(x) for enter in self.enter]
            out = x if self.shortcut is None else self.shortcut(x)
        results: list[Tensor] = []
        for entry, inner in zip(entries[:-1], self.inner, strict=True):
            results.append(inner(entry if self.first or not results else entry.add_(results[-1])))
        results.append(functional.avg_pool2d(entries[-1], 3, 2, 1) if self.first else entries[-1])
        for result, leave in zip(results, self.leave, strict=True):
            out = leave.add_to(out, result)  # type: ignore[operator]
        return out


class FusedBasicBlock(nn.Module):
    """Fused basic residual block."""

    def __init__(self, block: BasicBlock) -> None:
        """Fuse a block."""
        super().__init__()
        self.enter = FusedConv(*folded(block.conv1, block.bn1), block.stride, 1)
        self.leave = FusedConv(*folded(block.conv2, block.bn2), 1, 1)
        self.shortcut = None
        if block.downsample is not None:
            self.shortcut = FusedConv(*folded(*block.downsample), block.stride, relu=False)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        """Map (N, inputs, H, W) to (N, outputs, H / stride, W / stride)."""
        # A computed shortcut is overwritten; the input itself is used elsewhere.
        out = x.clone() if self.shortcut is None else self.shortcut(x)
        return self.leave.add_to(out, self.enter(x))


class FusedDecoder(nn.Module):
    """Fused decoder: stages at one resolution, each written to its channels.

    Upsampling by s is a 1 x 1 convolution to s^2 times as many channels, which are the new cells.
    """

    def __init__(self, decoder: Decoder) -> None:
        """Fuse a decoder."""
        super().__init__()
        self.layers = nn.ModuleList()
        self.scales: list[int] = []
        for layer in decoder:
            weight, bias = folded(*list(layer.children())[:2])  # type: ignore[arg-type]
            inputs, outputs, scale, _ = weight.shape
            cells = weight.permute(2, 3, 1, 0).reshape(scale**2 * outputs, inputs, 1, 1)
            self.layers.append(FusedConv(cells, bias.repeat(scale**2)))
            self.scales.append(scale)

    def forward(self, stages: Sequence[Tensor]) -> Tensor:
        """Return (N, sum of channels, h, w)."""
        parts = []
        for layer, scale, stage in zip(self.layers, self.scales, stages, strict=True):
            cells = layer(stage).permute(0, 2, 3, 1).unflatten(3, (scale, scale, -1))
            parts.append(cells.permute(0, 1, 3, 2, 4, 5))
        rows, height, _, width = parts[0].shape[:4]
        height, width = height * self.scales[0], width * self.scales[0]
        out = parts[0].new_empty((rows, height, width, sum(part.shape[-1] for part in parts)))
        start = 0
        for part, scale in zip(parts, self.scales, strict=True):
            place = out.view(rows, height // scale, scale, width // scale, scale, -1)
            place[..., start : start + part.shape[-1]] = part
            start += part.shape[-1]
        return out.permute(0, 3, 1, 2)
