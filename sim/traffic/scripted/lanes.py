"""Lanes below the paths of scripted actors."""

import math

import numpy as np
import shapely

from sim.encounters import network_file
from sim.encounters.types import ScriptedActor
from sim.geometry import Array
from sim.roads.networks import read_network
from sim.scenario import Scenario

LANE_EVERY_M = 1.0
"""Distance between two look-ups along a path, m."""


class LaneLookup:
    """Lookup of the lanes below paths, on the network of a scenario."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        net = read_network(network_file(scenario, seed))
        lanes = [lane for edge in net.getEdges(withInternal=True) for lane in edge.getLanes()]
        lanes = [lane for lane in lanes if len(lane.getShape()) > 1]
        self._names = [lane.getID() for lane in lanes]
        self._half = np.array([0.5 * lane.getWidth() for lane in lanes])
        self._lines = [shapely.LineString(np.array(lane.getShape())[:, :2]) for lane in lanes]
        self._tree = shapely.STRtree(self._lines)

    def along(self, actor: ScriptedActor) -> tuple[str, ...]:
        """Return the lane at every `LANE_EVERY_M` of an actor's path, "" off the lanes.

        Of several lanes the nearest one in the same direction counts.
        """
        at = np.arange(0.0, actor.path.length + LANE_EVERY_M, LANE_EVERY_M)
        places, headings, _ = actor.path.at(at)
        return self._below(places[:, :2], headings, directed=actor.kind.label != "pedestrian")

    def at(self, x: float, y: float, heading: float) -> str:
        """Return the lane below a vehicle, "" off the lanes."""
        return self._below(np.array([[x, y]]), np.array([heading]), directed=True)[0]

    def _below(self, xy: Array, headings: Array, *, directed: bool) -> tuple[str, ...]:
        points = shapely.points(xy)
        found: list[tuple[float, str]] = [(math.inf, "")] * len(xy)
        for place, line in self._tree.query(points, predicate="dwithin", distance=2.5).T:
            gap = self._lines[line].distance(points[place])
            if gap > self._half[line]:
                continue
            here = self._lines[line].project(points[place])
            a, b = (self._lines[line].interpolate(max(here + d, 0.0)) for d in (-0.5, 0.5))
            turned = math.cos(math.atan2(b.y - a.y, b.x - a.x) - headings[place])
            if directed:
                gap += 10.0 * (turned < 0.3)
            found[place] = min(found[place], (gap, self._names[line]))
        return tuple(name for _, name in found)
