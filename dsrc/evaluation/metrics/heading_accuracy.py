"""Whether a heading can be trusted: front and back look alike to every overlap, and not to a planner."""

from collections.abc import Sequence

import numpy as np

from dsrc.evaluation.metrics.ap import FrameResult, judge

RIGHT_RAD = np.pi / 4


def heading_share(results: Sequence[FrameResult], threshold: float = 0.5) -> float:
    """Return the share of the true positives that head within 45 degrees of their box; NaN without any.

    Args:
        results: of frames.
        threshold: least bird's-eye IoU of a true positive.
    """
    matched = judge(results, (threshold,)).matched["bev", threshold]
    ranked = [np.argsort(-frame.detections.score, kind="stable") for frame in results]
    found = [frame.detections.boxes.yaw[order] for frame, order in zip(results, ranked, strict=True)]
    truth = np.concatenate([np.zeros(0), *(frame.truth.yaw for frame in results)])
    hit = matched >= 0
    off = np.concatenate([np.zeros(0), *found])[hit] - truth[matched[hit]]
    return float((np.cos(off) >= np.cos(RIGHT_RAD)).mean()) if hit.any() else float("nan")
