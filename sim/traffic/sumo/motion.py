"""Motion of the bodies of road users between steps: headings, velocities and accelerations."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# A body turns as if trailing wheels followed its front bumper without slip, at this share of its length behind it: SUMO
# itself turns it with the corners of its lane. The middle of the box would turn too fast, the rear axle would swing the
# front out.
_TRAIL, _LEAST_TRAIL_M = 0.65, 1.8


class BodyMotion:
    """State of all bodies one step ago, by number; a body without one is new.

    Args:
        step_s: traffic step, s.
    """

    def __init__(self, step_s: float) -> None:
        self._step_s = step_s
        self._trail, self._xy, self._velocity = (np.zeros((0, 2)) for _ in range(3))  # NaN: none

    def make_room(self, bodies: int) -> None:
        """Make room for the states of bodies `0` to `bodies - 1`."""
        if bodies <= len(self._xy):
            return
        more = np.full((bodies - len(self._xy), 2), np.nan)
        self._trail, self._xy, self._velocity = (
            np.concatenate([former, more]) for former in (self._trail, self._xy, self._velocity)
        )

    def lift(self, number: int) -> None:
        """Forget the trailing wheels of a body: its next heading is the given one."""
        self._trail[number] = np.nan

    def forget(self, number: int) -> None:
        """Make a body new."""
        self._trail[number] = self._xy[number] = self._velocity[number] = np.nan

    def follow(self, numbers: Integers, front: Array, angle_deg: Array, length_m: Array) -> Array:
        """Move the trailing wheels of bodies and return their (N,) headings, in SUMO's degrees.

        Args:
            numbers: (N,) of the bodies.
            front: (N, 2) front bumpers, m.
            angle_deg: (N,) SUMO's headings, used in the first step.
            length_m: (N,) lengths of the bodies.
        """
        trail = self._trail[numbers]
        yaw = np.radians(90.0 - angle_deg)
        drawn = front - trail
        # The dot product rounds once, as that of single vectors does.
        distance = np.sqrt((drawn[:, None, :] @ drawn[:, :, None])[:, 0])
        along = np.where(np.isnan(trail), np.column_stack([np.cos(yaw), np.sin(yaw)]), drawn / distance)
        self._trail[numbers] = front - np.maximum(_TRAIL * length_m, _LEAST_TRAIL_M)[:, None] * along
        return 90.0 - np.degrees(np.arctan2(along[:, 1], along[:, 0]))

    def is_new(self, numbers: Integers) -> NDArray[np.bool_]:
        """Return (N,) whether bodies had no place one step ago."""
        return np.isnan(self._xy[numbers, 0])

    def velocities(self, numbers: Integers, xy: Array, first: Array) -> tuple[Array, Array]:
        """Move bodies and return (N, 2) velocities, m/s, and accelerations, m/s2, by differences between the steps.

        Args:
            numbers: (N,) of the bodies.
            xy: (N, 2) centres now, m.
            first: (N, 2) velocities of those that are new, m/s; they do not accelerate.
        """
        velocity = np.where(np.isnan(self._xy[numbers]), first, (xy - self._xy[numbers]) / self._step_s)
        change = (velocity - self._velocity[numbers]) / self._step_s
        self._xy[numbers], self._velocity[numbers] = xy, velocity
        return velocity, np.where(np.isnan(change), 0.0, change)
