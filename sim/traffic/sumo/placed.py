"""SUMO vehicles that are placed on a lane or off, and the drivers who yield to them."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.traffic.base import Actors, Limits
from sim.traffic.reactions import YieldShim

# Bits of SUMO's speed mode, see `sim.traffic.sumo.traffic`: its own; harder brakes than the comfortable ones for who
# yields to what SUMO does not see; no limits for a vehicle that is placed.
SUMO_SPEED_MODE, _YIELD_SPEED_MODE, _FREE_SPEED_MODE = 31, 31 - 4, 0
# Ways of SUMO to map a place to its lanes, and how far off them it may be.
_ON_ITS_ROUTE, _EXACTLY_THERE, _ANYWHERE_M = 1, 2, 1e5


class PlacedVehicles:
    """Poses of placed vehicles, by name, and the brakes of others for them."""

    def __init__(self) -> None:
        self._shim = YieldShim()
        self._poses: dict[str, tuple[float, float, float, float]] = {}
        self._lane_changes: dict[str, int] = {}
        self._yielding: set[str] = set()

    def __contains__(self, name: str) -> bool:
        return name in self._poses

    @property
    def yielding(self) -> bool:
        """Whether drivers yield, also to a vehicle that is no longer there."""
        return bool(self._yielding)

    def put(self, sumo: Any, name: str, front: NDArray[np.float64], yaw: float, speed_mps: float) -> None:
        """Place a vehicle with its front bumper at a (2,) position, m, a heading, rad, and a speed, m/s."""
        if name not in self._poses:
            self._lane_changes[name] = sumo.vehicle.getLaneChangeMode(name)
            sumo.vehicle.setLaneChangeMode(name, 0)
        sumo.vehicle.setSpeedMode(name, _FREE_SPEED_MODE)
        self._poses[name] = (float(front[0]), float(front[1]), float(90.0 - np.degrees(yaw)) % 360.0, speed_mps)

    def release(self, sumo: Any, name: str) -> None:
        """Put a placed vehicle back on its route, with its lane changes of before; others stay as they are."""
        if name not in self._poses:
            return
        sumo.vehicle.setLaneChangeMode(name, self._lane_changes.pop(name))
        x, y, angle_deg, _ = self._poses.pop(name)
        if not sumo.vehicle.getLaneID(name):
            # SUMO would remove it in the next step.
            sumo.vehicle.moveToXY(name, "", -1, x, y, angle_deg, _ON_ITS_ROUTE, _ANYWHERE_M)

    def remove(self, name: str) -> None:
        """Forget a vehicle that has left."""
        self._poses.pop(name, None)
        self._lane_changes.pop(name, None)
        self._yielding.discard(name)

    def move(self, sumo: Any) -> list[str]:
        """Move all placed vehicles, which SUMO needs before every step; return their names."""
        for name, (x, y, angle_deg, speed_mps) in self._poses.items():
            sumo.vehicle.moveToXY(name, "", -1, x, y, angle_deg, _EXACTLY_THERE)
            sumo.vehicle.setPreviousSpeed(name, speed_mps)
            # A command of before would hold SUMO's speed, which the ego reads as its own.
            sumo.vehicle.setSpeed(name, speed_mps)
        return list(self._poses)

    def slow_others(
        self,
        sumo: Any,
        actors: Actors,
        drivers: list[int],
        route: Callable[[int, float], NDArray[np.float64]],
        limits: Callable[[int], Limits],
        step_s: float,
    ) -> None:
        """Set the speeds of the drivers who yield in the next step, and give back those who do no longer.

        A vehicle that a command took from its driver meanwhile is left as it is.

        Args:
            sumo: the libsumo module of the running simulation.
            drivers: ids of the vehicles that SUMO drives.
        """
        ids = {name: int(object_id) for name, object_id in zip(actors.name, actors.boxes.object_id, strict=True)}
        unseen = [ids[name] for name in self._poses if name in ids]
        speeds = self._shim.speeds(actors, unseen, drivers, route, limits, step_s)
        slow = {actors.name[actors.row(driver)]: speed for driver, speed in speeds.items()}
        for name in (self._yielding - slow.keys()) & {actors.name[actors.row(driver)] for driver in drivers}:
            sumo.vehicle.setSpeedMode(name, SUMO_SPEED_MODE)
            sumo.vehicle.setSpeed(name, -1.0)
        for name, speed in slow.items():
            sumo.vehicle.setSpeedMode(name, _YIELD_SPEED_MODE)
            sumo.vehicle.setSpeed(name, speed)
        self._yielding = set(slow)
