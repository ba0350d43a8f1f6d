"""Faults of localisation: where an agent believes to be, against where it is."""

import math

import numpy as np
from numpy.typing import NDArray

from dsrc.faults.fault import Faults
from dsrc.faults.kinds import Bias, Drift, Size
from sim.geometry import invert, pose_matrix
from sim.streams import Stream, random_generator


def pose_error(faults: Faults, seed: int, agent_id: int, ego_id: int, time_s: float) -> NDArray[np.float64]:
    """Return (3,) error ahead, m, aside to the left, m, and of the heading, rad, at a time of the episode.

    Noise of helpers is no part of it: it is that of their messages, `pose_error` of the radio.
    """
    error = np.zeros(3)
    for fault in faults:
        settings = fault.settings
        if not fault.at(time_s) or not fault.on(agent_id, ego_id):
            continue
        if isinstance(settings, Bias):
            error += [settings.ahead_m, settings.aside_m, math.radians(settings.turn_deg)]
        elif isinstance(settings, Drift):
            rate = np.array([settings.ahead_mps, settings.aside_mps, math.radians(settings.turn_deg_s)])
            error += rate * (time_s - fault.from_s)
        elif isinstance(settings, Size) and agent_id == ego_id:
            rng = random_generator(seed, Stream.FAULT, fault.kind, 1 + round(1e3 * time_s), agent_id)
            error += rng.standard_normal(3) * [settings.size, settings.size, math.radians(settings.size)]
    return error


def believed_from_true(body: NDArray[np.float64], error: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (4, 4) transform of the world that an error of the pose `body` (4, 4) makes."""
    return body @ pose_matrix([error[0], error[1], 0.0], error[2]) @ invert(body)
