"""Import of OpenCOOD's and CoAlign's PointPillar checkpoints: the method is found by the names of its tensors."""

from collections.abc import Mapping
from pathlib import Path

import msgspec
import torch
from torch import Tensor

from dsrc.models.detector import Detector
from dsrc.models.fusion.where2comm import gaussian
from dsrc.models.settings import ModelSettings
from dsrc.models.storage.names import COMPRESSOR, FUSIONS, SAMPLER, SINGLE, Rule, renamed_tensor
from dsrc.models.storage.published import filled, published_tensors
from dsrc.ops.grid import GridSpec
from sim.errors import CheckpointError, SettingsError, complaint, did_you_mean
from sim.settings import convert

_SIGNS = {
    "v2vnet": "fusion_net.msg_cnn.",
    "v2xvit": "fusion_net.encoder.",
    "ermvp": "sampler.",
    "cobevt": "fusion_net.mlp_head.",
    "where2comm": "fusion_net.naive_communication.",
}
"""Beginning of a name that only this method has."""
_WITHOUT_WEIGHTS = ("early", "late", "none", "attention", "max", "max_map", "coalign")
_ONE_MAP = ("max_map", "v2vnet", "v2xvit", "cobevt", "ermvp")

_RANGES_M = {
    "late": (-70.4, -40.0, -3.0, 70.4, 40.0, 1.0),
    "v2xvit": (-140.8, -38.4, -3.0, 140.8, 38.4, 1.0),
    "cobevt": (-140.8, -38.4, -3.0, 140.8, 38.4, 1.0),
    "where2comm": (-140.8, -38.4, -5.0, 140.8, 38.4, 3.0),
    "ermvp": (-140.8, -38.4, -5.0, 140.8, 38.4, 3.0),
}
"""Ranges of the methods' published recipes, where they are not the default of grids."""
_SCORE_THRESHOLD = 0.2
_SCORE_THRESHOLDS = {"v2xvit": 0.27}


class PublishedTraining(msgspec.Struct, frozen=True, kw_only=True):
    """Training of a published network, as far as no tensor tells it.

    Attributes:
        method: key of `dsrc.models.fusion.FUSIONS`, for tensors that fit several methods; None takes the one that fits.
        range_m: detection range, as of `GridSpec`; None is the published recipe's.
        cell_m: side of its pillars, m.
        shrink_stride: stride of the first shrink convolution; None is the published recipe's.
        left_handed: the clouds had y to the right, as OPV2V's and V2XSet's.
        intensity_steps: steps between 0 and 1 of their intensities, None for any number.
        own_frame: every agent encodes its cloud in its own frame: `proj_first: false`.
        max_agents: number of agents that are fused, where the tensors do not tell it.
        anchor_lwh: size of the anchors, m; None is a car's.
        direction_start: start of the direction classes, `dir_offset`, rad.
    """

    method: str | None = None
    range_m: tuple[float, float, float, float, float, float] | None = None
    cell_m: float = 0.4
    shrink_stride: int | None = None
    left_handed: bool = True
    intensity_steps: int | None = 255
    own_frame: bool = False
    max_agents: int = 5
    anchor_lwh: tuple[float, float, float] | None = None
    direction_start: float = 0.7853


def import_opencood(path: Path, origin: PublishedTraining | None = None) -> Detector:
    """Import a state dict of OpenCOOD or a fork of it: the same maps of the same points.

    Fusions are as released: masks, absent agents and unused layers as in their classes' `released`. All else that no
    tensor tells is as in the published recipes: two anchors of a car, 32 points per pillar, a score threshold of 0.2,
    0.27 for V2X-ViT, boxes longer than 6 m along x or y dropped.

    Args:
        path: `net_epoch....pth` of a PointPillar model.

    Raises:
        CheckpointError: the file is missing, damaged, of another network, or of one that is not reproduced exactly;
            names the first tensor that does not fit.
        SettingsError: the tensors fit several methods and none is named, or not the one that is; or a number of the
            training is out of its range.
    """
    origin = origin or PublishedTraining()
    tensors = published_tensors(path)
    method = _method(path, tensors, origin.method)
    try:
        grid = GridSpec(origin.range_m or _RANGES_M.get(method, GridSpec().range_m), origin.cell_m)
        ModelSettings(grid=grid)  # needs cells in eights
    except ValueError as error:
        raise SettingsError(f"{path}: {error}") from None
    try:
        plain = msgspec.to_builtins(_settings(tensors, method, grid, origin))
        settings = convert(plain, ModelSettings, f"{path}: settings", SettingsError)
        state = _as_ours(path, _renamed(path, tensors, method), tensors, settings)
    except KeyError as error:
        raise CheckpointError(complaint(path, "state", f"a tensor {error.args[0]}", "none")) from None
    except (ValueError, IndexError, TypeError, ArithmeticError) as error:  # of tensors without the axes that ours have
        raise CheckpointError(complaint(path, "state", f"tensors of '{method}'", str(error))) from None
    return filled(path, settings, state)


def _method(path: Path, tensors: Mapping[str, Tensor], asked: str | None) -> str:
    """Return the fusion that the tensors are of, or of several the one that was asked for."""
    foreign = next((name for name in tensors if "_teacher." in name or ".conv3." in name), None)
    if foreign is not None or not any(name.startswith("pillar_vfe.") for name in tensors):
        expected = "the tensors of a PointPillar network of OpenCOOD (pillar_vfe..., backbone...)"
        hint = "; DSRC's own are of the family dsrc" if foreign else ""
        raise CheckpointError(complaint(path, "state", expected, foreign or next(iter(tensors), "nothing"), hint))
    fusing = [name for name in tensors if name.startswith(("fusion_net.", "sampler."))]
    fitting = [method for method, sign in _SIGNS.items() if any(name.startswith(sign) for name in fusing)][:1]
    if fusing and not fitting:
        expected = f"a fusion of {', '.join(_SIGNS)}, or one without weights"
        raise CheckpointError(complaint(path, "state", expected, f"{fusing[0]} {tuple(tensors[fusing[0]].shape)}"))
    shrink = tensors.get("shrink_conv.layers.0.double_conv.0.weight")
    if fitting == ["where2comm"]:
        fitting.append("attention")  # what it is with `fully: true`
    elif not fitting:
        fitting = [name for name in _WITHOUT_WEIGHTS if shrink is not None or name not in _ONE_MAP]
    if asked is not None:
        if asked not in fitting:
            hint = did_you_mean(asked, fitting)
            raise SettingsError(complaint(path, "method", f"one that fits, of {', '.join(fitting)}", asked, hint))
        return asked
    if fusing:
        return fitting[0]
    if any(name.startswith("backbone.resnet.") for name in tensors):
        return "coalign"
    if shrink is not None and shrink.shape[-1] == 1:
        return "max_map"
    raise SettingsError(complaint(path, "method", f"one that fits, of {', '.join(fitting)}", "several", "; name one"))


def _settings(tensors: Mapping[str, Tensor], method: str, grid: GridSpec, origin: PublishedTraining) -> ModelSettings:
    residual = any(name.startswith("backbone.resnet.") for name in tensors)
    stages = [
        _convolutions(tensors, f"backbone.resnet.layer{k}." if residual else f"backbone.blocks.{k}.") for k in range(3)
    ]
    shrink = tensors.get("shrink_conv.layers.0.double_conv.0.weight")
    widths = tuple(tensors[f"backbone.deblocks.{k}.0.weight"].shape[1] for k in range(3))
    stride = None
    if shrink is not None:
        # Else that of the method's published recipe.
        learned = method in _ONE_MAP or method == "where2comm"
        stride = origin.shrink_stride or (2 if learned and shrink.shape[-1] == 3 else 1)
    compressor = tensors.get("naive_compressor.encoder.0.weight")
    agents = origin.max_agents
    if method in ("cobevt", "ermvp"):
        rows = len(tensors["fusion_net.layers.0.window_attention.fn.relative_position_bias_table.weight"])
        agents = (rows // 49 + 1) // 2
    return ModelSettings(
        grid=grid,
        fusion=method,
        backbone="resnet" if residual else "plain",
        released=method in ("v2vnet", "v2xvit", "cobevt", "ermvp"),
        left_handed=origin.left_handed,
        intensity_steps=origin.intensity_steps,
        own_frame=origin.own_frame,
        compress=len(compressor[0]) // len(compressor) if compressor is not None and method in _ONE_MAP else 1,
        sdd=False,
        pcp=False,
        rec=False,
        box_order="hwl",
        padded_slots=True,
        pillar_channels=len(tensors["pillar_vfe.pfn_layers.0.linear.weight"]),
        stage_channels=tuple(len(stage[0]) for stage in stages),  # type: ignore[arg-type]
        stage_blocks=tuple(len(stage) // 2 if residual else len(stage) - 1 for stage in stages),  # type: ignore[arg-type]
        decoder_channels=widths[0] if len(set(widths)) == 1 else widths,
        shrink_channels=0 if shrink is None else len(shrink),
        shrink_kernel=3 if shrink is None else shrink.shape[-1],  # type: ignore[arg-type]
        shrink_stride=stride,  # type: ignore[arg-type]
        attention_channels=_attention_channels(tensors) if method == "v2xvit" else None,
        anchor_lwh=origin.anchor_lwh,
        direction="dir_head.weight" in tensors,
        direction_start=origin.direction_start if "dir_head.weight" in tensors else None,
        max_agents=agents,
        team_by="folders",
        score_threshold=_SCORE_THRESHOLDS.get(method, _SCORE_THRESHOLD),
        max_extent_m=6.0,
    )


def _convolutions(tensors: Mapping[str, Tensor], prefix: str) -> list[Tensor]:
    """Return the weights of a stage's convolutions, shortcuts left out."""
    found = [t for name, t in tensors.items() if name.startswith(prefix) and t.ndim == 4 and "downsample" not in name]
    if not found:
        raise KeyError(f"{prefix}...weight")
    return found


def _attention_channels(tensors: Mapping[str, Tensor]) -> tuple[int, ...]:
    block = "fusion_net.encoder.layers.0.0.layers.0"
    windows = [len(tensors[f"{block}.1.fn.pwmsa.{k}.to_qkv.weight"]) // 3 for k in range(3)]
    return len(tensors[f"{block}.0.fn.q_linears.0.weight"]), *windows


def _renamed(path: Path, tensors: Mapping[str, Tensor], method: str) -> dict[str, tuple[str, Tensor]]:
    rules: dict[str, tuple[Rule, ...]] = {"": (*SINGLE, *(COMPRESSOR if method in _ONE_MAP else ()))}
    rules["fusion_net."] = FUSIONS.get("where2comm" if method == "attention" else method, ())
    rules["sampler."] = SAMPLER if method == "ermvp" else ()
    state = {}
    for name, tensor in tensors.items():
        part = next((part for part in ("fusion_net.", "sampler.") if name.startswith(part)), "")
        ours = renamed_tensor(name.removeprefix(part), rules[part])
        if ours == "":
            found = f"{name} {tuple(tensor.shape)}"
            raise CheckpointError(complaint(path, "state", f"no tensor beside those of '{method}'", found))
        if ours is not None:
            state[f"fusion.{ours}" if part else ours] = name, tensor
    return state


def _as_ours(
    path: Path, state: dict[str, tuple[str, Tensor]], tensors: Mapping[str, Tensor], settings: ModelSettings
) -> dict[str, tuple[str, Tensor]]:
    """Return the state with what our layers have in another form."""
    changed = dict(state)
    channels = settings.shrink_channels
    if settings.fusion == "v2vnet":
        for name, gates in (("update", 2), ("candidate", 1)):
            for end, shape in (("weight", (gates * channels, 3 * channels, 3, 3)), ("bias", (gates * channels,))):
                published, tensor = state[f"fusion.{name}.{end}"]
                if tuple(tensor.shape) != shape:
                    raise CheckpointError(complaint(path, f"state: {published}", f"shape {shape}", tuple(tensor.shape)))
                # The reset gate comes first; it and the weights for the hidden state, the last, meet zeros only.
                tensor = tensor[-channels:]
                changed[f"fusion.{name}.{end}"] = published, tensor[:, : 2 * channels] if end == "weight" else tensor
    if settings.fusion in ("v2vnet", "cobevt", "ermvp"):
        changed["fusion.keep"] = "fusion_net", torch.zeros(channels)
    if settings.direction:
        for end in ("weight", "bias"):
            published, tensor = state[f"direction_head.{end}"]
            if len(tensor) != 4:
                raise CheckpointError(
                    complaint(path, f"state: {published}", "two directions per anchor", tuple(tensor.shape))
                )
            # The second wins where its logit is higher.
            changed[f"direction_head.{end}"] = published, tensor[1::2] - tensor[::2]
    if settings.fusion == "where2comm":
        _check_smoothing(path, tensors)
    return changed


def _check_smoothing(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Compare Where2comm's Gaussian, which a file may hold with other sizes, with ours."""
    name = "fusion_net.naive_communication.gaussian_filter"
    wanted = {"weight": gaussian(5, 1.0), "bias": torch.zeros(1)}
    for end, expected in wanted.items():
        found = tensors.get(f"{name}.{end}")
        if found is None or found.shape != expected.shape or not torch.allclose(found.float(), expected, atol=1e-5):
            size = "none" if found is None else f"another one, {tuple(found.shape)}"
            raise CheckpointError(
                complaint(path, f"state: {name}.{end}", "a Gaussian of 5 x 5 cells, deviation 1", size)
            )
