"""Rows of results: one method under one condition, or a summary over all conditions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dsrc.evaluation.metrics.ap import EvalResult
from dsrc.evaluation.metrics.robustness import mce, mean_ap

CLEAN = "clean"
MEAN_AP = "mean_ap"
MCE = "mce"
MEAN_CORRUPTED = "mean_corrupted"


@dataclass(frozen=True, slots=True)
class Row:
    """Result of a method under a condition, or a summary.

    Attributes:
        method: name as shown.
        condition: `clean`, a corruption, the text of faults, or a summary: `mean_ap` over clean and all corruptions,
            `mce`.
        severity: of the corruption, 1 to 5; 0 for clean, faults and summaries.
        frames: number of frames.
        truth: number of ground-truth boxes.
        detections: number of detected boxes.
        metrics: average precisions by name, see `metric_name`, and the numbers of `choice_metrics`; in an `mce` row the
            mean corruption errors of the former.
        seconds_per_frame: median time of a detection; not in result files, for it differs between runs.
        bytes_per_frame: bytes sent by collaborators, mean over the frames; None without a channel.
        message_age_s: age of the messages used, mean; None without a channel or a message.
        heard: share of collaborators with a message used; None without a channel or a collaborator.
        result: curves behind the metrics; None where they are not kept.
    """

    method: str
    condition: str
    severity: int
    frames: int
    truth: int
    detections: int
    metrics: dict[str, float]
    seconds_per_frame: float | None = field(default=None, compare=False)
    bytes_per_frame: float | None = None
    message_age_s: float | None = None
    heard: float | None = None
    result: EvalResult | None = field(default=None, compare=False, repr=False)


def make_row(
    method: str,
    condition: str,
    severity: int,
    result: EvalResult,
    seconds: NDArray[np.float64] | None = None,
    traffic: NDArray[np.float64] | None = None,
) -> Row:
    """Row of a result.

    Args:
        condition: `clean` or a corruption.
        severity: 0 for clean.
        seconds: (F,) time of the detection in each frame.
        traffic: (F, 4) of each frame: bytes sent, collaborators, collaborators with a message used, sum of the ages of
            these messages, s; None without a channel.
    """
    sent, others, heard, age_s = (None,) * 4 if traffic is None else traffic.sum(axis=0).tolist()
    return Row(
        method=method,
        condition=condition,
        severity=severity,
        frames=result.frames,
        truth=result.truth,
        detections=result.detections,
        metrics=result.metrics(),
        seconds_per_frame=None if seconds is None or not len(seconds) else float(np.median(seconds)),
        bytes_per_frame=None if sent is None or not result.frames else sent / result.frames,
        message_age_s=age_s / heard if heard else None,
        heard=heard / others if others else None,
        result=result,
    )


def summary_rows(rows: Sequence[Row]) -> list[Row]:
    """The `mean_ap` and the `mce` row of each method that has clean and corrupted rows."""
    summaries = []
    for method in methods_of(rows):
        own = {row.condition: row for row in rows if row.method == method}
        clean = own.get(CLEAN)
        corrupted = {kind: row for kind, row in own.items() if row.severity}
        if clean is None or not corrupted:
            continue
        for condition, formula in ((MEAN_AP, mean_ap), (MCE, mce)):
            metrics = {
                name: formula(ap, {kind: row.metrics[name] for kind, row in corrupted.items()})
                for name, ap in clean.metrics.items()
                if name.startswith("ap_")
            }
            summaries.append(Row(method, condition, 0, clean.frames, clean.truth, 0, metrics))
    return summaries


def methods_of(rows: Sequence[Row]) -> list[str]:
    """Names of the methods, in the order of their first rows."""
    return list(dict.fromkeys(row.method for row in rows))


def conditions_of(rows: Sequence[Row]) -> list[str]:
    """Conditions without summaries, in the order of their first rows."""
    return [c for c in dict.fromkeys(row.condition for row in rows) if c not in (MEAN_AP, MCE)]


def find_row(rows: Sequence[Row], method: str, condition: str) -> Row | None:
    """Row of a method under a condition; None if missing."""
    return next((row for row in rows if row.method == method and row.condition == condition), None)


def metric_of(row: Row | None, name: str) -> float:
    """Metric of a row, NaN where either is missing."""
    return math.nan if row is None else row.metrics.get(name, math.nan)


def condition_title(condition: str) -> str:
    """Title of a condition in tables and figures; of faults the text, as it is read again."""
    titles = {MEAN_AP: "mean AP", MCE: "mCE", MEAN_CORRUPTED: "mean of the corruptions"}
    return titles.get(condition, condition if ":" in condition else condition.replace("_", " "))
