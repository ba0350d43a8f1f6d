"""Fusion methods against their references and against what they must not depend on."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from dsrc.models.fusion import FUSIONS, AgentLayout, Fusion
from dsrc.models.fusion.attention import AttentionFusion
from dsrc.models.fusion.cobevt import CoBEVT
from dsrc.models.fusion.ermvp import ERMVP, density_clusters
from dsrc.models.fusion.max import MaxFusion
from dsrc.models.fusion.mrcnet import _over_channels
from dsrc.models.fusion.v2vnet import V2VNet
from dsrc.models.fusion.v2xvit import AgentAttention, V2XViT, WindowAttention, delay_code
from dsrc.models.fusion.warp import about_centre, in_cells, into_ego, normalised, shifted
from dsrc.models.fusion.where2comm import Where2comm, gaussian
from dsrc.models.fusion.windows import Dropout, attention
from dsrc.models.layers.backbones import plain
from dsrc.models.layers.blocks import upsample
from dsrc.models.settings import ModelSettings
from dsrc.models.storage.names import COBEVT, SAMPLER, V2VNET, V2XVIT, renamed_state
from dsrc.models.storage.names import ERMVP as ERMVP_NAMES
from tests.dsrc.models.reference import golden, matching, state
from tests.dsrc.models.storage.test_deploy import AGENTS, a_detector, some_pillars
from tests.dsrc.models.weights import stirred

SIZES = ModelSettings(stage_channels=(16, 16, 16), shrink_channels=16, decoder_channels=16)
LEARNED = sorted(name for name in FUSIONS if FUSIONS[name].start)


def untrained(name: str, settings: ModelSettings = SIZES) -> Fusion:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return FUSIONS[name].from_settings(settings).eval()


def made(name: str) -> Fusion:
    return stirred(untrained(name))


def near(found: torch.Tensor, expected: np.ndarray, tolerance: float) -> None:
    np.testing.assert_allclose(found.detach().numpy(), expected, rtol=0, atol=tolerance)


def test_attention_and_max_equal_the_reference() -> None:
    arrays, notes = golden("fuse_att_max")
    layout, x = AgentLayout(tuple(notes["record_len"])), torch.from_numpy(arrays["x"])
    near(AttentionFusion().fuse(x, layout), arrays["att"], 1e-5)
    near(AttentionFusion().fuse(x * 3, layout), arrays["att_x3"], 1e-5)
    np.testing.assert_array_equal(MaxFusion().fuse(x, layout).numpy(), arrays["max"])


def test_attention_and_maximum_of_warped_maps_equal_coaligns() -> None:
    arrays, notes = golden("fuse_coalign")
    pairwise = torch.from_numpy(arrays["pairwise"])
    extent = (notes["voxel"] * notes["W0"], notes["voxel"] * notes["H0"])
    there = [(b, j) for b, n in enumerate(notes["record_len"]) for j in range(n)]
    for b, j in there:
        near(normalised(pairwise[b, 0, j], extent), arrays["affine"][b, 0, j], 1e-6)
    warped = AgentLayout(tuple(notes["record_len"]), pairwise=pairwise, extent_m=extent)
    still = AgentLayout(warped.agents)
    for k in (1, 2, 3):
        x = torch.from_numpy(arrays[f"x{k}"])
        near(AttentionFusion().fuse(x, warped), arrays[f"out_warp{k}"], 2e-5)
        near(AttentionFusion().fuse(x, still), arrays[f"out_identity{k}"], 2e-5)
        near(MaxFusion().fuse(x, warped), arrays[f"max_warp{k}"], 2e-5)


def test_v2vnet_equals_the_reference() -> None:
    arrays, notes = golden("fuse_v2vnet")
    config, x = notes["config"], torch.from_numpy(arrays["x"])
    channels, (height, width) = config["C"], (config["H"], config["W"])
    weights = renamed_state(state(arrays), V2VNET)
    # The reset gate comes first; it and the weights for the hidden state meet zeros only.
    weights["update.weight"] = weights["update.weight"][channels:, : 2 * channels]
    weights["update.bias"] = weights["update.bias"][channels:]
    weights["candidate.weight"] = weights["candidate.weight"][:, : 2 * channels]
    weights["keep"] = torch.zeros(channels)
    fusion = V2VNet(channels, config["num_iteration"], released=True).eval()
    fusion.load_state_dict(weights)
    agents, cell = tuple(notes["record_len"]), config["voxel"] * config["downsample_rate"]
    pairwise = torch.from_numpy(arrays["pairwise"])
    there = AgentLayout(agents, pairwise=pairwise, extent_m=(cell * width, cell * height))
    motion = in_cells(pairwise, there, (height, width))
    near(motion[0, :3, :3], arrays["discretised"][0, :3, :3], 1e-5)
    seen = fusion.covered(motion[0, :3, :3], x[:3])
    assert (seen.numpy() != arrays["roi_mask"][0, :3, :3]).mean() < 1e-2
    near(shifted(x[:3], about_centre(motion[0, :3, 0], (height, width))), arrays["warp_feature"], 1e-4)
    near(fusion.fuse(x, AgentLayout(agents)), arrays["out_identity_avg_gru"], 2e-5)
    near(fusion.fuse(x, there), arrays["out_warp_avg_gru"], 1e-4)


def test_cobevt_equals_the_reference() -> None:
    arrays, notes = golden("fuse_cobevt")
    config, x = notes["config"], torch.from_numpy(arrays["x"])
    heads = config["input_dim"] // config["dim_head"]
    sizes = {"depth": config["depth"], "heads": heads, "window": config["window_size"], "hidden": config["mlp_dim"]}
    fusion = CoBEVT(config["input_dim"], config["agent_size"], **sizes, released=True).eval()
    fusion.load_state_dict(renamed_state(state(arrays), COBEVT) | {"keep": torch.zeros(config["input_dim"])})
    place = arrays["state/layers.0.window_attention.fn.relative_position_index"]
    np.testing.assert_array_equal(fusion.blocks[0]["near"].inner.place, place)
    near(fusion.attend(x[:3])[:3].permute(0, 3, 1, 2), arrays["inter/after_block1_b0"], 5e-5)
    near(fusion.fuse(x, AgentLayout(tuple(notes["record_len"]))), arrays["out_masked"], 5e-5)
    full = torch.from_numpy(arrays["x_full"])[0]
    near(fusion.fuse(full, AgentLayout((5,))), arrays["out_full"], 5e-5)
    # With the maximum number of agents there is nothing to pad.
    fusion.released = False
    near(fusion.fuse(full, AgentLayout((5,))), arrays["out_full"], 5e-5)


def test_ermvp_equals_the_reference() -> None:
    arrays, notes = golden("fuse_ermvp")
    config, x = notes["config"], torch.from_numpy(arrays["x"])
    heads = config["input_dim"] // config["dim_head"]
    sizes = {"depth": config["depth"], "heads": heads, "window": config["window_size"], "hidden": config["mlp_dim"]}
    fusion = ERMVP(config["input_dim"], config["agent_size"], **sizes, released=True).eval()
    parts = {
        part: {name.removeprefix(part): t for name, t in state(arrays).items() if name.startswith(part)}
        for part in ("fusion/", "sampler/")
    }
    weights = renamed_state(parts["fusion/"], ERMVP_NAMES) | renamed_state(parts["sampler/"], SAMPLER)
    fusion.load_state_dict(weights | {"keep": torch.zeros(config["input_dim"])})
    layout = AgentLayout(tuple(notes["record_len"]))
    near(fusion.fuse(fusion.send([x], layout)[0], layout), arrays["out_fusion"], 1e-4)
    sampler = fusion.sampler
    tokens, cells, score = sampler.tokens(x)
    np.testing.assert_array_equal(cells, arrays["sampler/topk_index"])
    near(score, np.take_along_axis(arrays["sampler/score"], arrays["sampler/topk_index"].astype(int), 1), 1e-5)
    near(tokens.transpose(0, 1), arrays["sampler/tokens"], 1e-5)
    cluster = density_clusters(tokens, arrays["cluster/merged"].shape[1], config["k"])
    np.testing.assert_array_equal(cluster, arrays["cluster/index"])
    merged = sampler.means(tokens, cluster, cells.float())
    near(merged, arrays["cluster/merged"], 1e-4)
    sparse = sampler(x).flatten(2).gather(2, cells[:, None].expand(-1, x.shape[1], -1))
    near(sparse.transpose(1, 2), arrays["cluster/restored"], 1e-4)


def test_what_ermvp_samples_is_what_is_fused() -> None:
    fusion = made("ermvp")
    x = torch.randn(3, 16, 16, 16, generator=torch.Generator().manual_seed(5))
    sent = fusion.send([x], AgentLayout((3,)))[0]
    assert torch.equal(sent[0], x[0])
    assert (sent[1:].abs().amax(1) > 0).flatten(1).sum(1).tolist() == [int(0.2 * 256)] * 2
    fusion.released = True
    assert torch.equal(fusion.send([x], AgentLayout((3,)))[0], x)


def test_v2xvit_equals_the_reference() -> None:
    arrays, notes = golden("fuse_v2xvit")
    config, x = notes["config"]["encoder"], torch.from_numpy(arrays["x"])
    windows = config["pwindow_att_config"]
    fusion = V2XViT(
        x.shape[1],
        depth=config["depth"],
        heads=config["cav_att_config"]["heads"],
        windows=tuple(zip(windows["window_size"], windows["heads"], strict=True)),
        hidden=config["feed_forward"]["mlp_dim"],
    ).eval()
    fusion.load_state_dict(renamed_state(state(arrays), V2XVIT))
    agents = tuple(notes["record_len"])
    prior = torch.cat([torch.from_numpy(row[:n]) for row, n in zip(arrays["prior"], agents, strict=True)])
    roadside = prior[:, 2] > 0
    # The reference warps even where nothing moves, and rounds: with its rounding the difference is 8e-6.
    near(fusion.fuse(x, AgentLayout(agents, roadside=roadside)), arrays["out_nodelay_identity"], 2e-4)
    cell = config["sttf"]["voxel_size"][0] * config["sttf"]["downsample_rate"]
    pairwise = torch.zeros(2, 5, 5, 4, 4)
    pairwise[:, :, 0] = torch.from_numpy(arrays["spatial_correction"])
    layout = AgentLayout(
        agents,
        roadside=roadside,
        delay=prior[:, 1].long(),
        pairwise=pairwise,
        extent_m=(cell * x.shape[3], cell * x.shape[2]),
    )
    _, seen = fusion.moved(x[:3], layout, 0)
    np.testing.assert_array_equal(seen.permute(1, 2, 0), arrays["inter/com_mask"][0, ..., :3])
    near(fusion.fuse(x, layout), arrays["out_delay_warp"], 2e-4)
    near(delay_code(torch.arange(8), x.shape[1]), arrays["state/encoder.rte.emb.emb.weight"][::2], 1e-6)


def spread(weight: torch.Tensor, heads: int, dim: int) -> torch.Tensor:
    """Give each head as many channels again, of zeros, along a dimension of heads times channels."""
    parts = weight.unflatten(dim, (heads, -1))
    return torch.cat([parts, torch.zeros_like(parts)], dim=dim + 1).flatten(dim, dim + 1)


def test_heads_with_idle_channels_attend_as_those_without() -> None:
    torch.manual_seed(0)
    channels, heads = 16, 4
    narrow, wide = (stirred(AgentAttention(channels, heads, 0.0, width)).eval() for width in (channels, 2 * channels))
    state = narrow.state_dict()
    twice = 2.0**0.5  # the scale is by the channels of a head
    for kind in range(2):
        for layer in ("query", "key", "value"):
            factor = twice if layer == "query" else 1.0
            for end in ("weight", "bias"):
                state[f"{layer}.{kind}.{end}"] = factor * spread(state[f"{layer}.{kind}.{end}"], heads, 0)
        state[f"out.{kind}.weight"] = spread(state[f"out.{kind}.weight"], heads, 1)
    for name in ("relation_score", "relation_message"):
        state[name] = nn.functional.pad(state[name], (0, 4, 0, 4))
    wide.load_state_dict(state)
    x, kind = torch.randn(3, 5, 6, channels), torch.tensor([0, 1, 0])
    near(wide(x, kind, None, 3), narrow(x, kind, None, 3).detach().numpy(), 1e-5)

    narrow, wide = (stirred(WindowAttention(channels, 4, heads, 0.0, width)).eval() for width in (16, 32))
    state = narrow.state_dict()
    query, key, value = (spread(part, heads, 0) for part in state["qkv.weight"].chunk(3))
    state |= {"qkv.weight": torch.cat([twice * query, key, value]), "out.weight": spread(state["out.weight"], heads, 1)}
    wide.load_state_dict(state)
    near(wide(x), narrow(x).detach().numpy(), 1e-5)


def test_v2xvit_takes_any_width_of_its_heads() -> None:
    settings = ModelSettings(
        fusion="v2xvit", shrink_channels=24, stage_channels=(16, 16, 16), attention_channels=(32, 16, 48, 64)
    )
    fusion = stirred(V2XViT.from_settings(settings))
    assert [layer.weight.shape for layer in fusion.blocks[0]["agents"].query] == [(32, 24)] * 2
    assert [b.qkv.weight.shape[0] for b in fusion.blocks[0]["windows"].inner.branches] == [48, 144, 192]
    assert fusion.fuse(torch.randn(3, 24, 9, 11), AgentLayout((2, 1))).shape == (2, 24, 9, 11)
    with pytest.raises(ValueError, match=r"attention_channels: expected multiples of 16 heads, found 24"):
        ModelSettings(fusion="v2xvit", attention_channels=24)
    with pytest.raises(
        ValueError, match=r"attention_channels: expected a width or 4, at least 1 each, found \(16, 16\)"
    ):
        ModelSettings(fusion="v2xvit", attention_channels=(16, 16))
    with pytest.raises(ValueError, match=r"decoder_channels: expected a width or 3, at least 1 each, found 0"):
        ModelSettings(decoder_channels=0)
    with pytest.raises(ValueError, match=r"attention_channels: expected none with fusion max, found those of v2xvit"):
        ModelSettings(fusion="max", attention_channels=32)


class Network(nn.Module):
    """The part of a detector that Where2comm asks: a plain backbone, and given logits."""

    def __init__(self, config: dict, weights: dict, logits: torch.Tensor) -> None:
        super().__init__()
        self.backbone = plain(16, tuple(config["num_filters"]), tuple(config["layer_nums"]), 0.01)
        self.backbone.load_state_dict(matching(weights, (PLAIN,)))
        self.deblocks = nn.ModuleList()
        for k, (inputs, outputs) in enumerate(zip(config["num_filters"], (8, 12, 16), strict=True)):
            self.deblocks.append(upsample(inputs, outputs, 2**k, 0.01))
        self.deblocks.load_state_dict(matching(weights, ((r"backbone/deblocks\.(.*)", r"\1"),)))
        self.given = logits
        self.eval()

    def logits(self, stages: list[torch.Tensor]) -> torch.Tensor:
        return self.given[[1, 2, 4]]  # of the others: agents are (3, 2)

    def run(self, fusion: Where2comm, x: torch.Tensor, layout: AgentLayout) -> torch.Tensor:
        scales = fusion(fusion.send(self.backbone(x), layout, self), layout, self)
        return torch.cat([up(scale) for up, scale in zip(self.deblocks, scales, strict=True)], dim=1)


PLAIN = (r"(?:backbone|base)/blocks\.(\d)\.(\d+)\.(.*)", lambda m: f"stages.{m[1]}.{int(m[2]) - 1}.{m[3]}")


@pytest.mark.parametrize("stride", [2, 4])
def test_where2comm_equals_the_port(stride: int) -> None:
    arrays, notes = golden("fuse_where2comm_opencood")
    x, layout = torch.from_numpy(arrays["x"]), AgentLayout(tuple(notes["record_len"]))
    logits = torch.from_numpy(arrays[f"psm_stride{stride}"])
    fusion = Where2comm(notes["config"]["communication"]["threshold"]).eval()
    near(gaussian(5, 1.0)[0, 0], arrays["gaussian_kernel"], 1e-6)
    near(fusion.smoothed(logits), arrays[f"smoothed_stride{stride}"], 1e-6)
    mask = fusion.mask(fusion.smoothed(logits), layout)
    np.testing.assert_array_equal(mask, arrays[f"mask_stride{stride}"])
    network = Network(notes["config"], state(arrays), logits)
    with torch.inference_mode():
        near(network.run(fusion, x, layout), arrays[f"out_multi_stride{stride}"], 3e-5)
        fusion.threshold = -1.0
        near(network.run(fusion, x, layout), arrays["out_fully"], 3e-5)


def test_where2comm_equals_the_authors_release() -> None:
    arrays, notes = golden("fuse_where2comm_official")
    x, logits = torch.from_numpy(arrays["x"]), torch.from_numpy(arrays["psm"])
    pairwise, agents = torch.from_numpy(arrays["pairwise"]), tuple(notes["record_len"])
    still = AgentLayout(agents)
    warped = AgentLayout(agents, pairwise=pairwise, extent_m=(0.4 * x.shape[3], 0.4 * x.shape[2]))
    network = Network(notes["config"], state(arrays), logits)
    fusion = Where2comm(notes["config"]["communication"]["thre"], released=True).eval()
    np.testing.assert_array_equal(fusion.mask(fusion.smoothed(logits), still), arrays["mask"])
    with torch.inference_mode():
        near(network.run(fusion, x, still), arrays["out_identity_ATTEN"], 3e-5)
        near(network.run(fusion, x, warped), arrays["out_warp_ATTEN"], 3e-5)


def test_the_ego_keeps_all_of_its_own_and_the_released_form_the_third_agents_too() -> None:
    confidence = torch.zeros(3, 1, 4, 4)
    for released, whole in ((False, [True, False, False]), (True, [True, False, True])):
        mask = Where2comm(released=released).eval().mask(confidence, AgentLayout((3,)))
        assert [bool(part.all()) for part in mask] == whole


def some_maps(fusion: Fusion, agents: int) -> list[torch.Tensor]:
    """Maps as they come out of a ReLU, of 16 channels and sides that windows do not divide."""
    x = torch.randn(agents, 16, 20, 36, generator=torch.Generator().manual_seed(7)).relu()
    return [x, x[..., ::2, ::2], x[..., ::4, ::4]] if fusion.place == "stages" else [x]


def moved(agents: int) -> torch.Tensor:
    """Poses of agents that stand 2 m apart, as a `AgentLayout` has them for one sample."""
    along = torch.arange(agents, dtype=torch.float64)
    pairwise = torch.eye(4, dtype=torch.float64).expand(1, agents, agents, 4, 4).clone()
    pairwise[0, :, :, 0, 3] = 2.0 * (along[:, None] - along)
    return pairwise


def test_every_method_with_weights_says_what_it_gives_before_they_are_trained() -> None:
    assert [name for name in sorted(FUSIONS) if any(True for _ in untrained(name).parameters())] == LEARNED


@pytest.mark.parametrize("name", LEARNED)
@pytest.mark.parametrize("warped", [False, True])
@pytest.mark.parametrize("training", [False, True])
def test_untrained_it_gives_the_egos_maps_or_the_maximum(name: str, warped: bool, training: bool) -> None:
    fusion = untrained(name).train(training)
    maps = some_maps(fusion, 3)
    places = {"pairwise": moved(3), "extent_m": (36.0, 20.0)} if warped else {}
    layout = AgentLayout((3,), roadside=torch.tensor([False, True, False]), delay=torch.tensor([0, 1, 2]), **places)
    fused = fusion(fusion.send(maps, layout), layout)
    for found, own in zip(fused, maps, strict=True):
        assert torch.equal(found, own[:1] if fusion.start == "identity" else MaxFusion().fuse(own, layout))


@pytest.mark.parametrize("name", LEARNED)
def test_every_weight_of_a_fusion_has_moved_after_three_steps(name: str) -> None:
    fusion = untrained(name).train()
    before = {key: weight.detach().clone() for key, weight in fusion.named_parameters()}
    layout = AgentLayout(
        (3, 2),
        roadside=torch.tensor([False, True, False, True, False]),
        delay=torch.tensor([0, 1, 2, 0, 1]),
    )
    maps, generator = some_maps(fusion, 5), torch.Generator().manual_seed(8)
    optimizer = torch.optim.AdamW(fusion.parameters(), lr=1e-3, weight_decay=0.0)
    for _ in range(3):
        optimizer.zero_grad()
        fused = fusion(fusion.send(maps, layout), layout)
        off = [(part - torch.randn(part.shape, generator=generator)).square().mean() for part in fused]
        torch.stack(off).sum().backward()
        optimizer.step()
    assert [key for key, weight in fusion.named_parameters() if torch.equal(weight, before[key])] == []


@pytest.mark.parametrize("name", LEARNED)
def test_all_other_weights_of_a_single_cloud_detector_fit_and_say_the_same(name: str) -> None:
    detector = a_detector(fusion=name)
    start = a_detector(fusion="max_map" if detector.fusion.place == "map" else "none")
    own = detector.state_dict()
    assert {key for key in own if not key.startswith("fusion.")} == set(start.state_dict())
    detector.load_state_dict(own | start.state_dict())
    pillars, layout = some_pillars(start), AgentLayout(AGENTS)
    with torch.inference_mode():
        if detector.fusion.start == "identity":
            expected = start(pillars, AgentLayout((1,) * sum(AGENTS))).cls[[0, AGENTS[0]]]
        else:
            expected = start(pillars, layout).cls
        torch.testing.assert_close(detector(pillars, layout).cls, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", ["attention", "max", "none", "coalign"])
def test_an_ego_alone_keeps_its_features(name: str) -> None:
    x = torch.randn(2, 4, 3, 3, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(made(name).fuse(x, AgentLayout((1, 1))), x)


@pytest.mark.parametrize("name", ["v2xvit", "cobevt", "ermvp"])
@pytest.mark.parametrize("released", [False, True])
def test_maps_that_windows_do_not_divide_are_fused_whole(name: str, released: bool) -> None:
    fusion, x = made(name), torch.randn(2, 16, 10, 18, generator=torch.Generator().manual_seed(4))
    fusion.released = released
    with torch.inference_mode():
        fused = fusion.fuse(x, AgentLayout((2,)))
    assert fused.shape == (1, 16, 10, 18)
    assert torch.isfinite(fused).all()


def test_the_flat_form_of_mrcnets_convolution_is_the_convolution() -> None:
    layer, both = nn.Conv3d(2, 1, 3, padding=1), torch.randn(2, 6, 5, 7, generator=torch.Generator().manual_seed(6))
    torch.testing.assert_close(_over_channels(layer, both), layer(both[None])[0, 0], rtol=1e-5, atol=1e-6)


def test_late_and_early_fusion_leave_every_map_alone() -> None:
    x = torch.randn(3, 4, 2, 2, generator=torch.Generator().manual_seed(3))
    for name in ("late", "early"):
        assert made(name).fuse(x, AgentLayout((1, 1, 1))) is x


def bump(x: float, y: float, size: int = 48, cell: float = 0.5) -> torch.Tensor:
    """A map of one smooth hill at a place in metres from its centre."""
    axis = (torch.arange(size) + 0.5 - size / 2) * cell
    return torch.exp(-((axis[None] - x) ** 2 + (axis[:, None] - y) ** 2) / 2)[None]


def test_what_an_agent_saw_is_put_where_it_is_for_the_ego() -> None:
    # The collaborator stands 3 m ahead and 2 m left of the ego, turned left by 90 degrees.
    ego_from_agent = torch.eye(4, dtype=torch.float64)
    ego_from_agent[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    ego_from_agent[:2, 3] = torch.tensor([3.0, 2.0])
    pairwise = torch.eye(4, dtype=torch.float64).expand(1, 2, 2, 4, 4).clone()
    pairwise[0, 1, 0], pairwise[0, 0, 1] = ego_from_agent, torch.linalg.inv(ego_from_agent)
    for centre in ((0.0, 0.0), (2.0, -1.0)):
        layout = AgentLayout((2,), pairwise=pairwise, extent_m=(24.0, 24.0), centre_m=centre)
        own = torch.tensor([4.0, 1.0, 0.0, 1.0], dtype=torch.float64)
        seen = ego_from_agent @ own
        group = torch.stack([bump(0, 0), bump(float(own[0]) - centre[0], float(own[1]) - centre[1])])
        expected = bump(float(seen[0]) - centre[0], float(seen[1]) - centre[1])
        torch.testing.assert_close(into_ego(group, layout, 0)[1], expected, rtol=0, atol=0.02)
        motion = about_centre(in_cells(pairwise[0, :, 0], layout, (48, 48)), (48, 48))
        moved = shifted(group, motion)[1]
        assert abs(int(moved.argmax()) // 48 - int(expected.argmax()) // 48) <= 1
        assert abs(int(moved.argmax()) % 48 - int(expected.argmax()) % 48) <= 1


def test_attention_of_a_training_is_that_of_a_detection() -> None:
    torch.manual_seed(0)
    query, key, value = (torch.randn(6, 2, 16, 8, requires_grad=True) for _ in range(3))
    bias = torch.randn(1, 2, 16, 16, requires_grad=True)
    inputs = (query, key, value, bias)

    def gradients(attend: Callable[..., Tensor]) -> tuple[Tensor, ...]:
        mask = bias.masked_fill(torch.arange(16) == 3, -torch.inf)
        found = attend(query, key, value, attn_mask=mask)
        with torch.no_grad():
            torch.testing.assert_close(found, attention(query, key, value, mask))
        return torch.autograd.grad(found.square().sum(), inputs)

    found = gradients(lambda *heads, attn_mask: attention(*heads, attn_mask))
    for ours, theirs in zip(found, gradients(functional.scaled_dot_product_attention), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


def test_attention_in_half_precision_is_near_that_in_single() -> None:
    torch.manual_seed(0)
    heads = [torch.randn(6, 2, 64, 8, requires_grad=True) for _ in range(3)]
    mask = torch.randn(1, 2, 64, 64)
    with torch.autocast("cpu", torch.bfloat16):
        found = attention(*heads, mask)
    assert found.dtype == torch.bfloat16
    torch.testing.assert_close(found.float(), attention(*heads, mask), rtol=0.0, atol=0.02)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 1.0])
def test_dropout_keeps_the_mean_and_drops_its_share(share: float) -> None:
    torch.manual_seed(0)
    layer, x = Dropout(share), torch.ones(1999, 1001, requires_grad=True)
    y = layer(x)
    dropped = round(256 * share) / 256 if round(256 * share) else share
    assert float((y == 0).float().mean()) == pytest.approx(dropped, abs=0.0005 if dropped > share else 0.0004)
    assert share == 1.0 or float(y.detach().mean()) == pytest.approx(1.0, abs=0.002)
    (gradient,) = torch.autograd.grad(y.sum(), x)
    assert torch.equal(gradient, y.detach())
    assert torch.equal(layer.eval()(x), x)
