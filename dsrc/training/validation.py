"""What a validation measures, while a network trains and of the file that it becomes."""

import math
from collections.abc import Iterable, Sequence

import torch

from dsrc.evaluation.metrics.ap import FrameResult, evaluate
from dsrc.evaluation.metrics.heading_accuracy import heading_share
from dsrc.models.detector import Detector
from dsrc.models.inputs.batch import Batch

THRESHOLDS = (0.3, 0.5, 0.7)


def best_device() -> str:
    """Return where a detector is fast: the GPU where there is one."""
    return "cuda" if torch.cuda.is_available() else "cpu"


def detections_of(detector: Detector, batch: Batch) -> list[FrameResult]:
    """Return what a network detects in a batch beside the ground truth, row by row: with late fusion agent by agent.

    A teacher gets its clouds, a student its own.
    """
    pillars = batch.teacher if detector.settings.role == "teacher" else batch.student
    if pillars is None:
        raise ValueError("the batch was collated for another network")
    found = detector.decode(detector(pillars, batch.layout))
    return [FrameResult(f, truth) for f, truth in zip(found, batch.boxes, strict=True)]


def metrics_of(results: Sequence[FrameResult]) -> dict[str, float]:
    """Return the average precisions of frames by their names in logs, and the share of headings that are right.

    NaN where there is no ground truth, or no heading.
    """
    curves = evaluate(results, thresholds=THRESHOLDS).curves
    precision = {f"val/ap_bev_{round(100 * t)}": float(curves["bev", t].ap) for t in THRESHOLDS}
    return {**precision, "val/heading": heading_share(results)}


@torch.inference_mode()
def validate(detector: Detector, batches: Iterable[Batch]) -> dict[str, float]:
    """Return the metrics of a detector over batches; without ground truth they are 0, as in a training."""
    device = detector.cls_head.weight.device
    results = [result for batch in batches for result in detections_of(detector.eval(), batch.to(device))]
    return {name: 0.0 if math.isnan(value) else value for name, value in metrics_of(results).items()}
