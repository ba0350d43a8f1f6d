"""Robustness: corruption errors, their mean, and mean average precision."""

import math
from collections.abc import Mapping

import numpy as np


def corruption_errors(clean: float, by_corruption: Mapping[str, float]) -> dict[str, float]:
    """Corruption errors: the share of the clean average precision lost, (clean - corrupted) / clean.

    Source: the DSRC paper, equation 10. NaN where the clean average precision is 0 or NaN.
    """
    if not clean > 0:
        return dict.fromkeys(by_corruption, math.nan)
    return {kind: (clean - ap) / clean for kind, ap in by_corruption.items()}


def mce(clean: float, by_corruption: Mapping[str, float]) -> float:
    """Mean corruption error; smaller is better, NaN without corruptions.

    It compares a detector with itself: one that finds little in clean frames has little to lose. Read it together with
    `mean_ap`.
    """
    errors = corruption_errors(clean, by_corruption)
    return float(np.mean(list(errors.values()))) if errors else math.nan


def mean_ap(clean: float, by_corruption: Mapping[str, float]) -> float:
    """Mean average precision over clean frames and all corruptions."""
    return float(np.mean([clean, *by_corruption.values()]))
