"""Names of tensors in published checkpoints, of DSRC, OpenCOOD and CoAlign, and ours.

Modules of the reference that never compute anything (a batch norm of its backbone, half of its reconstruction head)
are left out.
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence

from torch import Tensor

Rule = tuple[str, str | Callable[[re.Match[str]], str] | None]
"""Pattern of a published name and our name, None for a tensor that the published network never uses."""

AROUND_BACKBONE: tuple[Rule, ...] = (
    (r"pillar_vfe\.pfn_layers\.0\.linear\.(.*)", r"encoder.linear.\1"),
    (r"pillar_vfe\.pfn_layers\.0\.norm\.(.*)", r"encoder.norm.\1"),
    (r"backbone\.deblocks\.(.*)", r"decoder.\1"),
    (r"shrink_conv\.layers\.0\.double_conv\.(.*)", r"shrink.\1"),
    (r"(cls_head|reg_head)\.(.*)", r"\1.\2"),
)
"""Names that OpenCOOD and its forks share: pillars, decoder, shrink convolutions, heads."""
_DETECTOR: tuple[Rule, ...] = (
    *AROUND_BACKBONE,
    (r"backbone\.resnet\.layer([123])\.(.*)", lambda m: f"backbone.stages.{int(m[1]) - 1}.{m[2]}"),
)


def detector_state(reference: Mapping[str, Tensor], teacher: bool = False) -> dict[str, Tensor]:
    """Rename a reference state to that of a `Detector`.

    Args:
        teacher: take the modules with the suffix `_teacher` instead of the student's.
    """
    chosen = {}
    for name, tensor in reference.items():
        module, _, rest = name.partition(".")
        if module.endswith("_teacher") == teacher:
            chosen[f"{module.removesuffix('_teacher')}.{rest}"] = tensor
    return renamed_state(chosen, _DETECTOR)


def renamed_state(tensors: Mapping[str, Tensor], rules: Iterable[Rule]) -> dict[str, Tensor]:
    """Rename tensors by the first rule that fits each; the others, and those that are never used, are left out."""
    found = ((renamed_tensor(name, rules), tensor) for name, tensor in tensors.items())
    return {name: tensor for name, tensor in found if name}


def renamed_tensor(name: str, rules: Iterable[Rule]) -> str | None:
    """Rename one tensor by the first rule that fits; None for one that is never used, an empty name if no rule fits."""
    for pattern, ours in rules:
        if match := re.fullmatch(pattern, name):
            return None if ours is None else ours(match) if callable(ours) else match.expand(ours)
    return ""


def _below(theirs: str, ours: str, parts: Sequence[tuple[str, str]]) -> tuple[Rule, ...]:
    r"""Return the rules of the tensors below a layer of a block, whose number is \1 in our names."""
    return tuple((rf"{theirs}\.{part}", f"{ours}.{new}") for part, new in parts)


_BACKBONES: tuple[Rule, ...] = (
    # A layer that pads comes first in each of their stages.
    (r"backbone\.blocks\.(\d)\.(\d+)\.(.*)", lambda m: f"backbone.stages.{m[1]}.{int(m[2]) - 1}.{m[3]}"),
    (r"backbone\.resnet\.layer(\d)\.(.*)", r"backbone.stages.\1.\2"),
)

SINGLE: tuple[Rule, ...] = (*AROUND_BACKBONE, *_BACKBONES, (r"dir_head\.(.*)", r"direction_head.\1"))
"""Of all that is not fusion."""

COMPRESSOR: tuple[Rule, ...] = ((r"naive_compressor\.(en|de)coder\.(.*)", r"compressors.0.\1code.\2"),)
"""Of the compressor of methods that fuse one map."""

V2VNET: tuple[Rule, ...] = (
    (r"msg_cnn\.(.*)", r"message.\1"),
    (r"mlp\.(.*)", r"out.\1"),
    (r"conv_gru\.cell_list\.0\.conv_can\.(.*)", r"candidate.\1"),
    (r"conv_gru\.cell_list\.0\.conv_gates\.(.*)", r"update.\1"),
)
_ATTENTION = (
    (r"norm\.(.*)", r"norm.\2"),
    (r"fn\.to_qkv\.(.*)", r"inner.qkv.\2"),
    (r"fn\.to_out\.0\.(.*)", r"inner.out.\2"),
    (r"fn\.relative_position_bias_table\.weight", "inner.bias"),
)
_FORWARD = ((r"norm\.(.*)", r"norm.\2"), (r"fn\.net\.(.*)", r"inner.\2"))
COBEVT: tuple[Rule, ...] = (
    *_below(r"layers\.(\d+)\.window_attention", r"blocks.\1.near", _ATTENTION),
    *_below(r"layers\.(\d+)\.window_ffd", r"blocks.\1.near_forward", _FORWARD),
    *_below(r"layers\.(\d+)\.grid_attention", r"blocks.\1.spread", _ATTENTION),
    *_below(r"layers\.(\d+)\.grid_ffd", r"blocks.\1.spread_forward", _FORWARD),
    (r"mlp_head\.2\.(.*)", r"norm.\1"),
    (r"mlp_head\.3\.(.*)", r"out.\1"),
    (r".*\.relative_position_index", None),
)
_WHOLE = (
    (r"norm\.(.*)", r"norm.\2"),
    (r"fn\.relative_position_bias_table\.weight", "inner.bias"),
    (r"fn\.qkv\.(.*)", r"inner.key_value.\2"),
    (r"fn\.to_out\.0\.(.*)", r"inner.out.\2"),
    (r"fn\.to_q_global\.(\d)\.conv\.0\.(.*)", r"inner.shorten.\2.around.\3"),
    (r"fn\.to_q_global\.(\d)\.conv\.2\.fc\.0\.(.*)", r"inner.shorten.\2.squeeze.\3"),
    (r"fn\.to_q_global\.(\d)\.conv\.2\.fc\.2\.(.*)", r"inner.shorten.\2.excite.\3"),
    (r"fn\.to_q_global\.(\d)\.conv\.3\.(.*)", r"inner.shorten.\2.across.\3"),
)
ERMVP: tuple[Rule, ...] = (
    # Layers that are made and never called.
    (r"layers\.\d+\.(grid_(attention|ffd)\..*|WindowAttentionGlobal\.fn\.proj\..*)", None),
    *COBEVT,
    *_below(r"layers\.(\d+)\.WindowAttentionGlobal", r"blocks.\1.whole", _WHOLE),
    *_below(r"layers\.(\d+)\.windowGlobal_ffd", r"blocks.\1.whole_forward", _FORWARD),
)
SAMPLER: tuple[Rule, ...] = ((r"score_pred_net\.(.*)", r"sampler.score.\1"), (r"v_proj\..*", None))
"""Of ERMVP's sampler, which stands beside its fusion."""

_AGENTS = (
    (r"norm\.(.*)", r"norm.\2"),
    (r"fn\.relation_att", "relation_score"),
    (r"fn\.relation_msg", "relation_message"),
    (r"fn\.k_linears\.(.*)", r"key.\2"),
    (r"fn\.q_linears\.(.*)", r"query.\2"),
    (r"fn\.v_linears\.(.*)", r"value.\2"),
    (r"fn\.a_linears\.(.*)", r"out.\2"),
)
_WINDOWS = (
    (r"norm\.(.*)", r"norm.\2"),
    (r"fn\.pwmsa\.(\d)\.pos_embedding", r"inner.branches.\2.bias"),
    (r"fn\.pwmsa\.(\d)\.to_qkv\.(.*)", r"inner.branches.\2.qkv.\3"),
    (r"fn\.pwmsa\.(\d)\.to_out\.0\.(.*)", r"inner.branches.\2.out.\3"),
    (r"fn\.split_attn\.fc1\.(.*)", r"inner.squeeze.\2"),
    (r"fn\.split_attn\.bn1\.(.*)", r"inner.norm.\2"),
    (r"fn\.split_attn\.fc2\.(.*)", r"inner.split.\2"),
)
V2XVIT: tuple[Rule, ...] = (
    (r"encoder\.rte\.emb\.lin\.(.*)", r"delay.\1"),
    # A table of sinusoids, and a layer that is never called.
    (r"encoder\.(rte\.emb\.emb\.weight|prior_feed\..*)", None),
    *_below(r"encoder\.layers\.(\d+)\.0\.layers\.0\.0", r"blocks.\1.agents", _AGENTS),
    *_below(r"encoder\.layers\.(\d+)\.0\.layers\.0\.1", r"blocks.\1.windows", _WINDOWS),
    *_below(r"encoder\.layers\.(\d+)\.1", r"blocks.\1.feed", _FORWARD),
)
WHERE2COMM: tuple[Rule, ...] = ((r"naive_communication\.gaussian_filter\.(weight|bias)", None),)
"""Fixed numbers alone."""

FUSIONS: dict[str, tuple[Rule, ...]] = {
    "v2vnet": V2VNET,
    "v2xvit": V2XVIT,
    "cobevt": COBEVT,
    "ermvp": ERMVP,
    "where2comm": WHERE2COMM,
}
"""Rules of the fusions that have tensors, below `fusion_net.`, by method."""
