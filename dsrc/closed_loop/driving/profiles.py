"""Speed profiles of the ego: a first acceleration for a while, then another one."""

from dataclasses import dataclass

import numpy as np

from sim.geometry import Array
from sim.rows import Rows


@dataclass(frozen=True, slots=True, eq=False)
class Profiles(Rows):
    """Speed profiles: P profiles at T instants.

    Attributes:
        first_mps2: (P,) first acceleration.
        then_mps2: (P,) acceleration after it.
        along_m: (P, T) distance covered, m.
        speed_mps: (P, T) speed.
    """

    first_mps2: Array
    then_mps2: Array
    along_m: Array
    speed_mps: Array


def profiles_of(
    speed_mps: float, top_mps: float, first_mps2: Array, then_mps2: Array, change_s: float, time_s: Array
) -> Profiles:
    """Return profiles that change their acceleration once, between standstill and a top speed.

    Args:
        top_mps: speed up to which they accelerate, at least the present one.
        first_mps2: (P,) acceleration up to `change_s`.
        then_mps2: (P,) acceleration after it.
        time_s: (T,) instants from 0 on, s.
    """
    first = speed_mps + first_mps2[:, None] * np.minimum(time_s, change_s)
    first = np.clip(first, 0.0, top_mps)
    speed = np.clip(first + then_mps2[:, None] * np.maximum(time_s - change_s, 0.0), 0.0, top_mps)
    along = np.zeros_like(speed)
    along[:, 1:] = np.cumsum(0.5 * (speed[:, 1:] + speed[:, :-1]) * np.diff(time_s), axis=1)
    return Profiles(first_mps2, then_mps2, along, speed)
