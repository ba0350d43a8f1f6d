"""Placement and Cast: place of a sensor that the recording lacks, and its sweep."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.sweep import Sweep
from sim.geometry import pose_matrix


@dataclass(frozen=True, slots=True)
class Placement:
    """Place of a sensor on a carrier.

    Attributes:
        xyz_m: in the carrier's body frame, m.
        yaw_deg: counter-clockwise from the carrier's heading.
        pitch_deg: positive looks down.
    """

    xyz_m: tuple[float, float, float]
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(4, 4) body_from_lidar."""
        yaw, pitch = math.radians(self.yaw_deg), math.radians(self.pitch_deg)
        return np.asarray(pose_matrix(np.array(self.xyz_m), yaw, pitch), np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Cast:
    """Sweep of a sensor that the recording lacks.

    Attributes:
        sweep: its points.
        rays: that were cast.
        seconds: that it took.
    """

    sweep: Sweep
    rays: int
    seconds: float
