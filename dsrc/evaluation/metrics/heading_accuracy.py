"""Heading accuracy: the share of right headings, which no overlap measures since front and back are alike to it."""

from collections.abc import Sequence

import numpy as np

from dsrc.evaluation.metrics.ap import FrameResult, match_frames

RIGHT_RAD = np.pi / 4


def heading_share(results: Sequence[FrameResult], threshold: float = 0.5) -> float:
    """Share of true positives within 45 degrees of their box's heading; NaN without true positives.

    Args:
        results: detections and true boxes of frames.
        threshold: least bird's-eye IoU of a true positive.
    """
    matched = match_frames(results, (threshold,)).matched["bev", threshold]
    ranked = [np.argsort(-frame.detections.score, kind="stable") for frame in results]
    found = [frame.detections.boxes.yaw[order] for frame, order in zip(results, ranked, strict=True)]
    truth = np.concatenate([np.zeros(0), *(frame.truth.yaw for frame in results)])
    hit = matched >= 0
    off = np.concatenate([np.zeros(0), *found])[hit] - truth[matched[hit]]
    return float((np.cos(off) >= np.cos(RIGHT_RAD)).mean()) if hit.any() else float("nan")
