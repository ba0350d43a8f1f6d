"""Comfort by nuPlan's bounds.

As nuPlan does (`state_extractors.py` of its devkit, kept by NAVSIM's `pdm_comfort_metrics.py`), signals are smoothed by
Savitzky-Golay filters over a second and differentiated by them: accelerations by quadratics over 0.8 s, jerk as the
derivative of these over 1.5 s, yaw rate as that of the heading over 1.5 s, yaw acceleration as the second derivative of
cubics over 1.5 s. Windows are 8 and 15 samples at its 10 Hz; at other steps as many as take the same time.
"""

import math

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.metrics.driven import Motion

_SHORT_S, _LONG_S = 0.8, 1.5
BOUNDS = {
    "longitudinal_mps2": (-4.05, 2.40),
    "lateral_mps2": (-4.89, 4.89),
    "jerk_mps3": (-8.37, 8.37),
    "longitudinal_jerk_mps3": (-4.13, 4.13),
    "yaw_rate_radps": (-0.95, 0.95),
    "yaw_acceleration_radps2": (-1.93, 1.93),
}
"""Lowest and highest comfortable value of each signal: nuPlan's `metrics_description.md`."""


class Comfort(msgspec.Struct, frozen=True, kw_only=True):
    """Comfort of an episode.

    Attributes:
        comfortable: every signal stayed within its bounds; NaN for an episode too short to differentiate, else 0 or 1.
        share: share of steps with all signals within their bounds.
        worst: largest ratio of a signal to its bound; 1 is at the bound.
    """

    comfortable: float
    share: float
    worst: float


def comfort(motion: Motion, step_s: float) -> Comfort:
    """Return the comfort of a motion.

    Source: nuPlan's `ego_is_comfortable`; see the module for the smoothing.

    Args:
        step_s: time between two steps, s.
    """
    found = signals(motion, step_s)
    if not found:
        return Comfort(comfortable=math.nan, share=math.nan, worst=math.nan)
    within = np.array([(BOUNDS[name][0] < v) & (v < BOUNDS[name][1]) for name, v in found.items()])
    ratio = [np.maximum(v / BOUNDS[name][1], v / BOUNDS[name][0]).max() for name, v in found.items()]
    return Comfort(comfortable=float(within.all()), share=float(within.all(axis=0).mean()), worst=float(max(ratio)))


def signals(motion: Motion, step_s: float) -> dict[str, NDArray[np.float64]]:
    """Return the (T,) smoothed signals by the names of `BOUNDS`; none for fewer than four steps."""
    from scipy.signal import savgol_filter  # two seconds: a worker that only drives does not need it

    n = len(motion)
    if n < 4:
        return {}
    short, long = min(round(_SHORT_S / step_s), n), min(round(_LONG_S / step_s), n)
    short, long = max(short, 3), max(long, 4)
    yaw = np.unwrap(motion.boxes.yaw)
    forward = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    left = np.stack([-forward[:, 1], forward[:, 0]], axis=1)
    along = savgol_filter((motion.acceleration * forward).sum(axis=1), short, 2)
    across = savgol_filter((motion.acceleration * left).sum(axis=1), short, 2)
    size = savgol_filter(np.linalg.norm(motion.acceleration, axis=1), short, 2)
    return {
        "longitudinal_mps2": along,
        "lateral_mps2": across,
        "jerk_mps3": savgol_filter(size, long, 2, deriv=1, delta=step_s),
        "longitudinal_jerk_mps3": savgol_filter(along, long, 2, deriv=1, delta=step_s),
        "yaw_rate_radps": savgol_filter(yaw, long, 2, deriv=1, delta=step_s),
        "yaw_acceleration_radps2": savgol_filter(yaw, long, 3, deriv=2, delta=step_s),
    }
