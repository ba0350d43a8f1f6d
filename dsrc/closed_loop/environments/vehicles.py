"""Vehicles of highway-env for perceived tracks: their lanes are looked up when somebody asks for them."""

from typing import Any

import numpy as np
from highway_env.road.road import Road
from highway_env.vehicle.kinematics import Vehicle
from numpy.typing import NDArray


class TrackedVehicle(Vehicle):
    """Vehicle of a track; most observations need no lane of it.

    Args:
        position: (2,) in highway-env's plane, m.
        heading: in highway-env's plane, rad.
        speed: along its heading, m/s.
        size: length and width, m.
    """

    _lane_index: Any = None

    def __init__(
        self, road: Road, position: NDArray[np.float64], heading: float, speed: float, size: tuple[float, float]
    ) -> None:
        super().__init__(None, position, heading, speed)
        self.road = road
        self.LENGTH, self.WIDTH = size
        self.diagonal = float(np.hypot(*size))

    @property
    def lane_index(self) -> Any:
        """Index of the nearest lane."""
        if self._lane_index is None and self.road is not None:
            self._lane_index = self.road.network.get_closest_lane_index(self.position, self.heading)
        return self._lane_index

    @lane_index.setter
    def lane_index(self, index: object) -> None:
        self._lane_index = index

    @property
    def lane(self) -> Any:
        """The nearest lane."""
        index = self.lane_index
        return None if index is None else self.road.network.get_lane(index)

    @lane.setter
    def lane(self, lane: object) -> None:
        """Ignore a lane: the index says which one it is."""
