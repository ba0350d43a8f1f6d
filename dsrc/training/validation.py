"""Validation metrics: average precision and heading accuracy, of a network in training and of its detector file."""

import math
from collections.abc import Iterable, Sequence

import torch

from dsrc.evaluation.metrics.ap import FrameResult, evaluate
from dsrc.evaluation.metrics.heading_accuracy import heading_share
from dsrc.models.detector import Detector
from dsrc.models.inputs.batch import Batch

THRESHOLDS = (0.3, 0.5, 0.7)


def best_device() -> str:
    """Return `cuda` where there is a GPU, else `cpu`."""
    return "cuda" if torch.cuda.is_available() else "cpu"


def detections_of(detector: Detector, batch: Batch) -> list[FrameResult]:
    """Return detections and ground truth of a batch, row by row (with late fusion agent by agent).

    A teacher reads its own clouds, a student the sensors'.
    """
    pillars = batch.teacher if detector.settings.role == "teacher" else batch.student
    if pillars is None:
        raise ValueError("the batch was collated for another network")
    found = detector.decode(detector(pillars, batch.layout))
    return [FrameResult(f, truth) for f, truth in zip(found, batch.boxes, strict=True)]


def metrics_of(results: Sequence[FrameResult]) -> dict[str, float]:
    """Return the average precisions by their names in logs, and the share of correct headings.

    NaN without ground truth, or without headings.
    """
    curves = evaluate(results, thresholds=THRESHOLDS).curves
    precision = {f"val/ap_bev_{round(100 * t)}": float(curves["bev", t].ap) for t in THRESHOLDS}
    return {**precision, "val/heading": heading_share(results)}


@torch.inference_mode()
def validate(detector: Detector, batches: Iterable[Batch]) -> dict[str, float]:
    """Return the metrics of a detector over batches; 0 without ground truth, as in a training."""
    device = detector.cls_head.weight.device
    results = [result for batch in batches for result in detections_of(detector.eval(), batch.to(device))]
    return {name: 0.0 if math.isnan(value) else value for name, value in metrics_of(results).items()}
