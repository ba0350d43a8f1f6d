"""Cars and vans that stay in a scenario's area: those that may carry a LiDAR for a whole drive."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from sim.boxes import CLASSES
from sim.scenario import Scenario
from sim.traffic.base import Actors

CARRIERS = ("car", "van")
"""Classes that may carry a LiDAR: the published detection ranges (3 m below to 1 m above the sensor) lose the ground
and every box from a sensor on the roof of a truck or bus."""


def staying_ids(drive: Iterable[Actors], scenario: Scenario) -> NDArray[np.int64]:
    """Return the ids of the carriers inside the area at every instant, at least one instant, ascending."""
    instants = iter(drive)
    ids = carrier_ids(next(instants), scenario)
    for actors in instants:
        ids = np.intersect1d(ids, carrier_ids(actors, scenario), assume_unique=True)
    return ids


def carrier_ids(actors: Actors, scenario: Scenario) -> NDArray[np.int64]:
    """Return the ids of the cars and vans on the road and inside the area, ascending."""
    chosen = np.isin(actors.boxes.label, [CLASSES.index(name) for name in CARRIERS]) & ~actors.parked()
    if scenario.network.area_m is not None:
        x_min, y_min, x_max, y_max = scenario.network.area_m
        x, y = actors.boxes.center[:, 0], actors.boxes.center[:, 1]
        chosen = chosen & (x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max)
    return actors.boxes.object_id[chosen]
