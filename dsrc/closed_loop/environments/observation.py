"""highway-env's Kinematics observation, computed without a data frame, and seen from any origin.

highway-env builds a pandas table of every vehicle in every step, most of the time of a step; the numbers are the same.
"""

import math

import numpy as np
from highway_env.envs.common.observation import KinematicObservation
from highway_env.vehicle.kinematics import Vehicle
from numpy.typing import NDArray

from dsrc.closed_loop.environments.roads import Origin

_X, _Y, _VX, _VY, _HEADING, _PRESENCE = range(6)
_COLUMNS = {"x": _X, "y": _Y, "vx": _VX, "vy": _VY, "heading": _HEADING, "presence": _PRESENCE}
_OF_HEADING = {"cos_h": np.cos, "sin_h": np.sin}


class Kinematics(KinematicObservation):
    """Rows of the ego and the vehicles near it, as `KinematicObservation` of highway-env.

    Args:
        env: with a road and an ego.
        origin: of positions and headings; those of the plane for None.
        settings: of highway-env's observation.
    """

    def __init__(self, env: object, origin: Origin | None = None, **settings: object) -> None:
        super().__init__(env, **settings)
        self.origin = origin or Origin()

    @classmethod
    def serves(cls, settings: dict) -> bool:
        """Return whether settings of highway-env's observation are those of this one: others need its table."""
        known = {*_COLUMNS, *_OF_HEADING}
        return settings["type"] == "Kinematics" and known.issuperset(settings.get("features") or cls.FEATURES)

    def observe(self) -> NDArray[np.float32]:
        """Return (vehicles_count, F) values, the ego first; zeros fill rows without a vehicle."""
        rows = np.zeros((self.vehicles_count, len(self.features)), np.float32)
        if not self.env.road:
            return rows
        ego = self.observer_vehicle
        near = self.env.road.close_objects_to(
            ego,
            self.env.PERCEPTION_DISTANCE,
            count=self.vehicles_count - 1,
            see_behind=self.see_behind,
            sort=self.order == "sorted",
            vehicles_only=not self.include_obstacles,
        )
        states = np.array([self._state(one) for one in [ego, *near[: self.vehicles_count - 1]]])
        if not self.absolute:
            states[1:, [_X, _Y, _VX, _VY]] -= states[0, [_X, _Y, _VX, _VY]]
        if self.normalize and not self.features_range:
            self.normalize_obs({})  # it derives the ranges from the lanes
        for column, name in enumerate(self.features):
            turned = _OF_HEADING.get(name)
            values = states[:, _COLUMNS[name]] if turned is None else turned(states[:, _HEADING])
            if self.normalize and name in self.features_range:
                low, high = self.features_range[name]
                values = 2.0 * (values - low) / (high - low) - 1.0
                values = np.clip(values, -1.0, 1.0) if self.clip else values
            rows[: len(values), column] = values
        if self.order == "shuffled":
            self.env.np_random.shuffle(rows[1:])
        return rows

    def _state(self, vehicle: Vehicle) -> tuple[float, ...]:
        """Return x, y, vx, vy, heading and presence of a vehicle, seen from the origin."""
        x, y = self.origin.seen(vehicle.position)
        heading = vehicle.heading - self.origin.heading
        speed = vehicle.speed
        return (x, y, speed * math.cos(heading), speed * math.sin(heading), heading, 1.0)
