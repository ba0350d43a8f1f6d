"""Names of tensors in OpenCOOD's and CoAlign's PointPillar checkpoints, per method, and ours."""

from dsrc.models.storage.reference_names import AROUND_BACKBONE, Rule

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
COBEVT: tuple[Rule, ...] = (
    *(
        (rf"layers\.(\d+)\.{theirs}\.fn\.{part}", rf"blocks.\1.{ours}.inner.{new}")
        for theirs, ours in (("window_attention", "near"), ("grid_attention", "spread"))
        for part, new in (
            (r"to_qkv\.(.*)", r"qkv.\2"),
            (r"to_out\.0\.(.*)", r"out.\2"),
            (r"relative_position_bias_table\.weight", "bias"),
        )
    ),
    (r"layers\.(\d+)\.window_ffd\.fn\.net\.(.*)", r"blocks.\1.near_forward.inner.\2"),
    (r"layers\.(\d+)\.grid_ffd\.fn\.net\.(.*)", r"blocks.\1.spread_forward.inner.\2"),
    (r"layers\.(\d+)\.window_attention\.norm\.(.*)", r"blocks.\1.near.norm.\2"),
    (r"layers\.(\d+)\.grid_attention\.norm\.(.*)", r"blocks.\1.spread.norm.\2"),
    (r"layers\.(\d+)\.window_ffd\.norm\.(.*)", r"blocks.\1.near_forward.norm.\2"),
    (r"layers\.(\d+)\.grid_ffd\.norm\.(.*)", r"blocks.\1.spread_forward.norm.\2"),
    (r"mlp_head\.2\.(.*)", r"norm.\1"),
    (r"mlp_head\.3\.(.*)", r"out.\1"),
    (r".*\.relative_position_index", None),
)
ERMVP: tuple[Rule, ...] = (
    # Layers that are made and never called.
    (r"layers\.\d+\.(grid_(attention|ffd)\..*|WindowAttentionGlobal\.fn\.proj\..*)", None),
    *COBEVT,
    (r"layers\.(\d+)\.WindowAttentionGlobal\.norm\.(.*)", r"blocks.\1.whole.norm.\2"),
    (r"layers\.(\d+)\.windowGlobal_ffd\.norm\.(.*)", r"blocks.\1.whole_forward.norm.\2"),
    (r"layers\.(\d+)\.windowGlobal_ffd\.fn\.net\.(.*)", r"blocks.\1.whole_forward.inner.\2"),
    *(
        (rf"layers\.(\d+)\.WindowAttentionGlobal\.fn\.{part}", rf"blocks.\1.whole.inner.{new}")
        for part, new in (
            (r"relative_position_bias_table\.weight", "bias"),
            (r"qkv\.(.*)", r"key_value.\2"),
            (r"to_out\.0\.(.*)", r"out.\2"),
            (r"to_q_global\.(\d)\.conv\.0\.(.*)", r"shorten.\2.around.\3"),
            (r"to_q_global\.(\d)\.conv\.2\.fc\.0\.(.*)", r"shorten.\2.squeeze.\3"),
            (r"to_q_global\.(\d)\.conv\.2\.fc\.2\.(.*)", r"shorten.\2.excite.\3"),
            (r"to_q_global\.(\d)\.conv\.3\.(.*)", r"shorten.\2.across.\3"),
        )
    ),
)
SAMPLER: tuple[Rule, ...] = ((r"score_pred_net\.(.*)", r"sampler.score.\1"), (r"v_proj\..*", None))
"""Of ERMVP's sampler, which stands beside its fusion."""

V2XVIT: tuple[Rule, ...] = (
    (r"encoder\.rte\.emb\.lin\.(.*)", r"delay.\1"),
    # A table of sinusoids, and a layer that is never called.
    (r"encoder\.(rte\.emb\.emb\.weight|prior_feed\..*)", None),
    *(
        (rf"encoder\.layers\.(\d+)\.0\.layers\.0\.0\.{part}", rf"blocks.\1.agents.{new}")
        for part, new in (
            (r"norm\.(.*)", r"norm.\2"),
            (r"fn\.relation_att", "relation_score"),
            (r"fn\.relation_msg", "relation_message"),
            (r"fn\.k_linears\.(.*)", r"key.\2"),
            (r"fn\.q_linears\.(.*)", r"query.\2"),
            (r"fn\.v_linears\.(.*)", r"value.\2"),
            (r"fn\.a_linears\.(.*)", r"out.\2"),
        )
    ),
    *(
        (rf"encoder\.layers\.(\d+)\.0\.layers\.0\.1\.{part}", rf"blocks.\1.windows.{new}")
        for part, new in (
            (r"norm\.(.*)", r"norm.\2"),
            (r"fn\.pwmsa\.(\d)\.pos_embedding", r"inner.branches.\2.bias"),
            (r"fn\.pwmsa\.(\d)\.to_qkv\.(.*)", r"inner.branches.\2.qkv.\3"),
            (r"fn\.pwmsa\.(\d)\.to_out\.0\.(.*)", r"inner.branches.\2.out.\3"),
            (r"fn\.split_attn\.fc1\.(.*)", r"inner.squeeze.\2"),
            (r"fn\.split_attn\.bn1\.(.*)", r"inner.norm.\2"),
            (r"fn\.split_attn\.fc2\.(.*)", r"inner.split.\2"),
        )
    ),
    (r"encoder\.layers\.(\d+)\.1\.norm\.(.*)", r"blocks.\1.feed.norm.\2"),
    (r"encoder\.layers\.(\d+)\.1\.fn\.net\.(.*)", r"blocks.\1.feed.inner.\2"),
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
