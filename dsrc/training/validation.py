"""Metrics of a network in training and of its detector file: average precision and heading accuracy.

They are called `val/...` on frames that are not trained on, and `train/...` where nothing is held out, as by the recipe
that overfits: there they say that a network learns, and nothing of what it does elsewhere.
"""

import math
from collections.abc import Iterable, Sequence

import torch

from dsrc.evaluation.metrics.ap import FrameResult, evaluate
from dsrc.evaluation.metrics.heading_accuracy import heading_share
from dsrc.models.detector import Detector
from dsrc.models.inputs.batch import Batch

THRESHOLDS = (0.3, 0.5, 0.7)
_METRICS = (*(f"ap_bev_{round(100 * t)}" for t in THRESHOLDS), "heading")


def prefixed(name: str, unseen: bool) -> str:
    """Return the name in logs of a metric on frames that are held out (`unseen`), or else trained on."""
    return f"{'val' if unseen else 'train'}/{name}"


def is_metric(name: str) -> bool:
    """Return whether a name in logs is a metric's, on either kind of frames, and not a loss's."""
    return name.removeprefix("val/").removeprefix("train/") in _METRICS


def frames_named(unseen: bool) -> str:
    """Return what the frames of the metrics are called in messages."""
    return "validation frames" if unseen else "training frames"


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


def metrics_of(results: Sequence[FrameResult], unseen: bool) -> dict[str, float]:
    """Return the average precisions by their names in logs, and the share of correct headings.

    NaN without ground truth, or without headings.

    Args:
        unseen: the frames are not trained on.
    """
    curves = evaluate(results, thresholds=THRESHOLDS).curves
    values = (*(float(curves["bev", t].ap) for t in THRESHOLDS), heading_share(results))
    return {prefixed(name, unseen): value for name, value in zip(_METRICS, values, strict=True)}


@torch.inference_mode()
def validate(detector: Detector, batches: Iterable[Batch], unseen: bool) -> dict[str, float]:
    """Return the metrics of a detector over batches, see `metrics_of`; 0 without ground truth, as in a training."""
    device = detector.cls_head.weight.device
    results = [result for batch in batches for result in detections_of(detector.eval(), batch.to(device))]
    return {name: 0.0 if math.isnan(value) else value for name, value in metrics_of(results, unseen).items()}
