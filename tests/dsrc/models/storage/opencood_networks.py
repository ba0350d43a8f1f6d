"""Small PointPillar networks with OpenCOOD's names of tensors, and what they compute, written from the papers.

Nothing here is of `dsrc.models`, but for the three fusions by attention in windows, which goldens hold to the reference
(`tests/dsrc/models/test_fusion.py`).
"""

import torch
from torch import Tensor
from torch.nn import functional

from dsrc.models.fusion import AgentLayout
from dsrc.models.fusion.cobevt import CoBEVT
from dsrc.models.fusion.ermvp import ERMVP
from dsrc.models.fusion.v2xvit import V2XViT
from dsrc.models.layers.encoder import Pillars
from dsrc.models.storage import names
from dsrc.models.storage.names import renamed_state

PILLAR, STAGES, BLOCKS, DECODER, SHRINK, AGENTS = 8, (8, 16, 24), (1, 2, 1), (8, 12, 16), 32, 3
RANGE_M = (-12.8, -6.4, -3.0, 12.8, 6.4, 1.0)

State = dict[str, Tensor]


class _Maker:
    def __init__(self) -> None:
        self.state: State = {}
        self.generator = torch.Generator().manual_seed(0)

    def put(self, name: str, *shape: int, scale: float | None = None) -> None:
        fan = max(1, torch.Size(shape[1:]).numel())
        self.state[name] = torch.randn(shape, generator=self.generator) * (scale or fan**-0.5)

    def layer(self, name: str, *shape: int, bias: bool = True) -> None:
        self.put(f"{name}.weight", *shape)
        if bias:
            self.put(f"{name}.bias", shape[0], scale=0.1)

    def norm(self, name: str, channels: int, batch: bool = True) -> None:
        self.put(f"{name}.weight", channels, scale=0.1)
        self.state[f"{name}.weight"] += 1.0
        self.put(f"{name}.bias", channels, scale=0.1)
        if batch:
            self.put(f"{name}.running_mean", channels, scale=0.1)
            self.state[f"{name}.running_var"] = torch.rand(channels, generator=self.generator) + 0.5
            self.state[f"{name}.num_batches_tracked"] = torch.tensor(7)


def network(
    fusion: str = "", residual: bool = False, kernel: int = 0, compress: int = 0, directions: bool = False
) -> State:
    """Return the state dict of a network: its fusion, backbone, kernel of the shrink convolutions (0 for none), ..."""
    make = _Maker()
    make.layer("pillar_vfe.pfn_layers.0.linear", PILLAR, 10, bias=False)
    make.norm("pillar_vfe.pfn_layers.0.norm", PILLAR)
    inputs = PILLAR
    for k, (width, blocks) in enumerate(zip(STAGES, BLOCKS, strict=True)):
        for j in range(blocks + (0 if residual else 1)):
            if residual:
                prefix = f"backbone.resnet.layer{k}.{j}"
                make.layer(f"{prefix}.conv1", width, inputs, 3, 3, bias=False)
                make.norm(f"{prefix}.bn1", width)
                make.layer(f"{prefix}.conv2", width, width, 3, 3, bias=False)
                make.norm(f"{prefix}.bn2", width)
                if j == 0:
                    make.layer(f"{prefix}.downsample.0", width, inputs, 1, 1, bias=False)
                    make.norm(f"{prefix}.downsample.1", width)
            else:
                make.layer(f"backbone.blocks.{k}.{3 * j + 1}", width, inputs, 3, 3, bias=False)
                make.norm(f"backbone.blocks.{k}.{3 * j + 2}", width)
            inputs = width
        make.layer(f"backbone.deblocks.{k}.0", width, DECODER[k], 2**k, 2**k, bias=False)
        make.norm(f"backbone.deblocks.{k}.1", DECODER[k])
    channels = sum(DECODER)
    if kernel:
        make.layer("shrink_conv.layers.0.double_conv.0", SHRINK, channels, kernel, kernel)
        make.layer("shrink_conv.layers.0.double_conv.2", SHRINK, SHRINK, 3, 3)
        channels = SHRINK
    if compress:
        ends = (("encoder.0", channels // compress, channels), ("decoder.0", channels, channels // compress))
        for name, outputs, reads in (*ends, ("decoder.3", channels, channels)):
            make.layer(f"naive_compressor.{name}", outputs, reads, 3, 3)
            number = int(name[-1]) + 1
            make.norm(f"naive_compressor.{name[:-1]}{number}", outputs)
    _FUSIONS.get(fusion, lambda make: None)(make)
    make.layer("cls_head", 2, channels, 1, 1)
    make.layer("reg_head", 14, channels, 1, 1)
    if directions:
        make.layer("dir_head", 4, channels, 1, 1)
    return make.state


def _v2vnet(make: _Maker) -> None:
    make.layer("fusion_net.msg_cnn", SHRINK, 2 * SHRINK, 3, 3)
    make.layer("fusion_net.conv_gru.cell_list.0.conv_gates", 2 * SHRINK, 3 * SHRINK, 3, 3)
    make.layer("fusion_net.conv_gru.cell_list.0.conv_can", SHRINK, 3 * SHRINK, 3, 3)
    make.layer("fusion_net.mlp", SHRINK, SHRINK)


def _windows(make: _Maker, attentions: tuple[str, ...], feeds: tuple[str, ...]) -> None:
    for k in range(3):
        for name in attentions:
            part = f"fusion_net.layers.{k}.{name}"
            make.norm(f"{part}.norm", SHRINK, batch=False)
            make.layer(f"{part}.fn.to_out.0", SHRINK, SHRINK, bias=False)
            make.put(f"{part}.fn.relative_position_bias_table.weight", (2 * AGENTS - 1) * 49, 8)
            make.state[f"{part}.fn.relative_position_index"] = torch.zeros(48, 48, dtype=torch.long)
            if name == "WindowAttentionGlobal":
                make.layer(f"{part}.fn.qkv", 2 * SHRINK, SHRINK)
                make.layer(f"{part}.fn.proj", SHRINK, SHRINK)
                for j in range(2):
                    make.layer(f"{part}.fn.to_q_global.{j}.conv.0", SHRINK, 1, 3, 3, bias=False)
                    make.layer(f"{part}.fn.to_q_global.{j}.conv.2.fc.0", SHRINK // 4, SHRINK, bias=False)
                    make.layer(f"{part}.fn.to_q_global.{j}.conv.2.fc.2", SHRINK, SHRINK // 4, bias=False)
                    make.layer(f"{part}.fn.to_q_global.{j}.conv.3", SHRINK, SHRINK, 1, 1, bias=False)
            else:
                make.layer(f"{part}.fn.to_qkv", 3 * SHRINK, SHRINK, bias=False)
        for name in feeds:
            make.norm(f"fusion_net.layers.{k}.{name}.norm", SHRINK, batch=False)
            make.layer(f"fusion_net.layers.{k}.{name}.fn.net.0", SHRINK, SHRINK)
            make.layer(f"fusion_net.layers.{k}.{name}.fn.net.3", SHRINK, SHRINK)
    make.norm("fusion_net.mlp_head.2", SHRINK, batch=False)
    make.layer("fusion_net.mlp_head.3", SHRINK, SHRINK)


def _cobevt(make: _Maker) -> None:
    _windows(make, ("window_attention", "grid_attention"), ("window_ffd", "grid_ffd"))


def _ermvp(make: _Maker) -> None:
    feeds = ("window_ffd", "grid_ffd", "windowGlobal_ffd")
    _windows(make, ("window_attention", "grid_attention", "WindowAttentionGlobal"), feeds)
    make.layer("sampler.score_pred_net.0", SHRINK, SHRINK, 1, 1)
    make.layer("sampler.score_pred_net.2", 1, SHRINK, 1, 1)
    make.layer("sampler.v_proj", SHRINK, SHRINK)


def _v2xvit(make: _Maker) -> None:
    make.layer("fusion_net.encoder.prior_feed", SHRINK, SHRINK + 3)
    make.put("fusion_net.encoder.rte.emb.emb.weight", 100, SHRINK)
    make.layer("fusion_net.encoder.rte.emb.lin", SHRINK, SHRINK)
    for k in range(3):
        over, within = (f"fusion_net.encoder.layers.{k}.0.layers.0.{j}" for j in range(2))
        make.norm(f"{over}.norm", SHRINK, batch=False)
        for kind in range(2):
            for name in "kqva":
                make.layer(f"{over}.fn.{name}_linears.{kind}", SHRINK, SHRINK)
        for name in ("att", "msg"):
            make.put(f"{over}.fn.relation_{name}", 4, 8, SHRINK // 8, SHRINK // 8)
        make.norm(f"{within}.norm", SHRINK, batch=False)
        # The middle windows are wider than the map.
        for j, (side, width) in enumerate(((4, SHRINK), (8, 2 * SHRINK), (16, SHRINK))):
            make.put(f"{within}.fn.pwmsa.{j}.pos_embedding", 2 * side - 1, 2 * side - 1)
            make.layer(f"{within}.fn.pwmsa.{j}.to_qkv", 3 * width, SHRINK, bias=False)
            make.layer(f"{within}.fn.pwmsa.{j}.to_out.0", SHRINK, width)
        make.layer(f"{within}.fn.split_attn.fc1", SHRINK, SHRINK, bias=False)
        make.norm(f"{within}.fn.split_attn.bn1", SHRINK, batch=False)
        make.layer(f"{within}.fn.split_attn.fc2", 3 * SHRINK, SHRINK, bias=False)
        feed = f"fusion_net.encoder.layers.{k}.1"
        make.norm(f"{feed}.norm", SHRINK, batch=False)
        make.layer(f"{feed}.fn.net.0", SHRINK, SHRINK)
        make.layer(f"{feed}.fn.net.3", SHRINK, SHRINK)


def _where2comm(make: _Maker) -> None:
    near = torch.exp(-(torch.arange(-2.0, 3.0) ** 2) / 2)
    make.state["fusion_net.naive_communication.gaussian_filter.weight"] = (near[:, None] * near)[None, None] / (
        2 * torch.pi
    )
    make.state["fusion_net.naive_communication.gaussian_filter.bias"] = torch.zeros(1)


_FUSIONS = {"v2vnet": _v2vnet, "cobevt": _cobevt, "ermvp": _ermvp, "v2xvit": _v2xvit, "where2comm": _where2comm}


def said(state: State, pillars: Pillars, fusion: str, stride: int = 1) -> tuple[Tensor, ...]:
    """Return the logits, residuals and, with that head, directions of one sample's agents, ego first."""
    return _Network(state, stride).run(pillars, fusion)


class _Network:
    def __init__(self, state: State, stride: int) -> None:
        self.state, self.stride = state, stride
        self.residual = any("resnet" in name for name in state)

    def run(self, pillars: Pillars, fusion: str) -> tuple[Tensor, ...]:
        x = self.encoded(pillars)
        stages = self.stages(x)
        if fusion in ("attention", "coalign", "max", "where2comm"):
            if fusion == "where2comm":
                stages = self.stages(x, self.selected(self.conv("cls_head", self.shrunk(stages))))
            join = _maximum if fusion == "max" else _attention
            fused = self.shrunk([join(stage) for stage in stages])
        elif fusion in ("early", "late"):
            fused = self.shrunk(stages)
        else:
            fused = getattr(self, fusion)(self.compressed(self.shrunk(stages)))
        heads = [name for name in ("cls_head", "reg_head", "dir_head") if f"{name}.weight" in self.state]
        return tuple(self.conv(name, fused) for name in heads)

    def encoded(self, pillars: Pillars) -> Tensor:
        """Pillar features of 32 slots, rows without a point zero; maximum over the slots."""
        low, cell, slots = torch.tensor(RANGE_M), 0.4, 32
        width, height = 64, 32
        maps = torch.zeros(pillars.clouds, PILLAR, height, width)
        for v, (cloud, row, column) in enumerate(pillars.coords.tolist()):
            points = pillars.points[pillars.pillar == v]
            place = torch.tensor([column, row, 0.0])
            centre = low[:3] + (place + 0.5) * torch.tensor([cell, cell, 4.0])
            xyz = points[:, :3]
            rows = torch.cat([points, xyz - xyz.mean(0), xyz - centre], dim=1)
            rows = torch.cat([rows, torch.zeros(slots - len(rows), 10)])
            features = rows @ self.state["pillar_vfe.pfn_layers.0.linear.weight"].T
            maps[cloud, :, row, column] = self.norm("pillar_vfe.pfn_layers.0.norm", features).relu().amax(0)
        return maps

    def stages(self, x: Tensor, selected: Tensor | None = None) -> list[Tensor]:
        found = []
        for k, blocks in enumerate(BLOCKS):
            for j in range(blocks + (0 if self.residual else 1)):
                stride = 2 if j == 0 else 1
                if self.residual:
                    name = f"backbone.resnet.layer{k}.{j}"
                    inner = self.norm(f"{name}.bn1", self.conv(f"{name}.conv1", x, stride, 1), 1e-5).relu()
                    inner = self.norm(f"{name}.bn2", self.conv(f"{name}.conv2", inner, 1, 1), 1e-5)
                    if j == 0:
                        x = self.norm(f"{name}.downsample.1", self.conv(f"{name}.downsample.0", x, 2), 1e-5)
                    x = (x + inner).relu()
                else:
                    name = f"backbone.blocks.{k}.{3 * j}"
                    x = self.conv(f"backbone.blocks.{k}.{3 * j + 1}", x, stride, 1)
                    x = self.norm(f"backbone.blocks.{k}.{3 * j + 2}", x).relu()
            if k == 0 and selected is not None:
                x = x * functional.interpolate(selected, x.shape[2:], mode="bilinear", align_corners=False)
            found.append(x)
        return found

    def shrunk(self, stages: list[Tensor]) -> Tensor:
        parts = [
            functional.conv_transpose2d(stage, self.state[f"backbone.deblocks.{k}.0.weight"], stride=2**k)
            for k, stage in enumerate(stages)
        ]
        x = torch.cat([self.norm(f"backbone.deblocks.{k}.1", part).relu() for k, part in enumerate(parts)], dim=1)
        name = "shrink_conv.layers.0.double_conv"
        if f"{name}.0.weight" not in self.state:
            return x
        side = self.state[f"{name}.0.weight"].shape[-1]
        return self.conv(f"{name}.2", self.conv(f"{name}.0", x, self.stride, side // 2).relu(), 1, 1).relu()

    def compressed(self, x: Tensor) -> Tensor:
        if "naive_compressor.encoder.0.weight" in self.state:
            for name, norm in (("encoder.0", "encoder.1"), ("decoder.0", "decoder.1"), ("decoder.3", "decoder.4")):
                x = self.conv(f"naive_compressor.{name}", x, 1, 1)
                x = self.norm(f"naive_compressor.{norm}", x).relu()
        return x

    def max_map(self, x: Tensor) -> Tensor:
        return _maximum(x)

    def v2vnet(self, x: Tensor) -> Tensor:
        """Two rounds: the mean over j of the message from j to i enters a GRU without memory with i's features."""
        part = "fusion_net.conv_gru.cell_list.0"
        for _ in range(2):
            updated = []
            for own in x:
                pairs = torch.stack([torch.cat([other, own]) for other in x])
                entry = torch.cat([own, self.conv("fusion_net.msg_cnn", pairs, 1, 1).mean(0)])
                memory = torch.zeros_like(own)
                gates = self.conv(f"{part}.conv_gates", torch.cat([entry, memory])[None], 1, 1)[0].sigmoid()
                reset, update = gates.chunk(2)
                candidate = self.conv(f"{part}.conv_can", torch.cat([entry, reset * memory])[None], 1, 1)[0].tanh()
                updated.append((1 - update) * memory + update * candidate)
            x = torch.stack(updated)
        weight, bias = self.state["fusion_net.mlp.weight"], self.state["fusion_net.mlp.bias"]
        return functional.linear(x[:1].permute(0, 2, 3, 1), weight, bias).permute(0, 3, 1, 2)

    def selected(self, logits: Tensor) -> Tensor:
        """Cells that are sent: smoothed confidence above 0.01, and all of the ego's."""
        name = "fusion_net.naive_communication.gaussian_filter"
        smooth = self.conv(name, logits.sigmoid().amax(1, keepdim=True), 1, 2)
        mask = (smooth > 0.01).float()
        mask[0] = 1.0
        return mask

    def cobevt(self, x: Tensor) -> Tensor:
        return self.windowed(CoBEVT(SHRINK, AGENTS, released=True), names.COBEVT, x, {"keep": torch.zeros(SHRINK)})

    def ermvp(self, x: Tensor) -> Tensor:
        beside = renamed_state(self.below("sampler."), names.SAMPLER) | {"keep": torch.zeros(SHRINK)}
        return self.windowed(ERMVP(SHRINK, AGENTS, released=True), names.ERMVP, x, beside)

    def v2xvit(self, x: Tensor) -> Tensor:
        return self.windowed(V2XViT(SHRINK, widths=(SHRINK, SHRINK, 2 * SHRINK, SHRINK)), names.V2XVIT, x, {})

    def windowed(self, fusion: CoBEVT | ERMVP | V2XViT, rules: tuple, x: Tensor, beside: State) -> Tensor:
        fusion.load_state_dict(renamed_state(self.below("fusion_net."), rules) | beside)
        return fusion.eval().fuse(x, AgentLayout((len(x),)))

    def below(self, prefix: str) -> State:
        return {name.removeprefix(prefix): t for name, t in self.state.items() if name.startswith(prefix)}

    def conv(self, name: str, x: Tensor, stride: int = 1, padding: int = 0) -> Tensor:
        return functional.conv2d(x, self.state[f"{name}.weight"], self.state.get(f"{name}.bias"), stride, padding)

    def norm(self, name: str, x: Tensor, eps: float = 1e-3) -> Tensor:
        parts = (self.state[f"{name}.{part}"] for part in ("running_mean", "running_var", "weight", "bias"))
        return functional.batch_norm(x, *parts, eps=eps)


def _maximum(x: Tensor) -> Tensor:
    return x.amax(0, keepdim=True)


def _attention(x: Tensor) -> Tensor:
    """Per cell, the ego's features ask all agents'."""
    tokens = x.flatten(2).permute(2, 0, 1)
    weight = (tokens @ tokens.transpose(1, 2) / x.shape[1] ** 0.5).softmax(-1)
    return (weight @ tokens)[:, 0].T.reshape(1, *x.shape[1:])
