"""CoAlign: attention fusion per scale behind a residual backbone, with optional pose correction."""

from dsrc.models.fusion.attention import AttentionFusion


class CoAlign(AttentionFusion):
    """Multi-scale attention per cell, (N, C, H, W) to (B, C, H, W), behind a backbone of basic residual blocks.

    Source: CoAlign, arXiv 2211.07214, Section IV-B (multiscale fusion). Its correction of pose errors, the
    agent-object pose graph of Section IV-A, is `dsrc.models.pose_graph`, run before the clouds are encoded where
    `align_poses` is set, for this or any other method.

    Released: the authors' network has a direction head and a positive class weight of 2, for any fusion; one common
    preset leaves both out here. DSRC without its distillation is this with another backbone.
    """
