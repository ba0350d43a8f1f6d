"""Pose error: localisation error of collaborators.

| severity                           | 1    | 2   | 3   | 4   | 5   |
|------------------------------------|------|-----|-----|-----|-----|
| lateral and longitudinal std, m    | 0.05 | 0.1 | 0.2 | 0.4 | 0.8 |
| heading std, degrees               | 0.05 | 0.1 | 0.2 | 0.4 | 0.8 |

Level 3 is the noisy setting of V2X-ViT (Xu et al., ECCV 2022). There errors are independent between frames; those of a
satellite receiver are correlated over time, as an Ornstein-Uhlenbeck process (Sensors 2020, 20(21), 6050), and do not
average out in a tracker or a temporal fusion. Each of the three errors here is such a process
with standard deviation s and correlation exp(-|t - t'| / T), made as a sum of cosines (Rahimi, Recht 2007),

    e(t) = s sqrt(2 / K) * sum over k of cos(w_k t + phi_k),    w_k ~ Cauchy(0, 1 / T), phi_k ~ U(0, 2 pi), K = 64

whose frequencies follow the spectral density of that process. It is a pure function of the agent's stream and the time.
The correlation time T = 30 s is assumed. The error of a roadside unit is that of its survey and constant.

Only the reported pose has the error, `Sweep.world_from_lidar`; the points are as measured, their fate is kept, and
`world_from_body`, `path` and ground truth are true. The ego has no error: detections are evaluated in its frame, and
only errors relative to it matter (as in OpenCOOD).
"""

import math
from dataclasses import replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.levels import SeveritySettings
from sensors.frame import Frame
from sensors.sweep import Sweep
from sim.geometry import invert, pose_matrix

_WAVES = 64


class PoseError(SeveritySettings, frozen=True, kw_only=True):
    """Settings of `in_frame`.

    Attributes:
        lateral_m: standard deviation of the lateral error, m.
        longitudinal_m: standard deviation of the longitudinal error, m.
        heading_deg: standard deviation of the heading error, degrees.
        correlation_s: correlation time T, s.
    """

    LEVELS: ClassVar = {
        "lateral_m": (0.05, 0.1, 0.2, 0.4, 0.8),
        "longitudinal_m": (0.05, 0.1, 0.2, 0.4, 0.8),
        "heading_deg": (0.05, 0.1, 0.2, 0.4, 0.8),
    }
    RANGES: ClassVar = {
        "lateral_m": (0.0, 100.0),
        "longitudinal_m": (0.0, 100.0),
        "heading_deg": (0.0, 180.0),
        "correlation_s": (1e-3, 1e6),
    }

    lateral_m: float = 0.2
    longitudinal_m: float = 0.2
    heading_deg: float = 0.2
    correlation_s: float = 30.0


def in_frame(frame: Frame, row: int, settings: PoseError, rng: np.random.Generator) -> Sweep:
    """Return the sweep of the agent in a row of the frame with its erroneous pose.

    Args:
        rng: of the agent, restarted for every frame of a drive.
    """
    agent = frame.agents[row]
    ahead, aside, turn = pose_errors(settings, frame.time_s if agent.kind == "vehicle" else 0.0, rng)
    if ahead == aside == turn == 0.0:
        return agent.sweep
    body = agent.world_from_body
    believed_from_true = body @ pose_matrix([ahead, aside, 0.0], turn) @ invert(body)
    return replace(agent.sweep, world_from_lidar=believed_from_true @ agent.sweep.world_from_lidar)


def pose_errors(settings: PoseError, time_s: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return (3,) longitudinal error, m, lateral error, m, and heading error, rad, at a time of the drive."""
    frequency = rng.standard_cauchy((3, _WAVES)) / settings.correlation_s
    phase = rng.uniform(0.0, 2.0 * math.pi, (3, _WAVES))
    unit = math.sqrt(2.0 / _WAVES) * np.cos(frequency * time_s + phase).sum(axis=1)
    return unit * [settings.longitudinal_m, settings.lateral_m, math.radians(settings.heading_deg)]
