"""Parked cars in bays at the kerb, seeded."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import shapely

from sim.bodies.fleet import Fleet
from sim.bodies.vehicle_types import VehicleType
from sim.geometry import Array, wrap_angle
from sim.roads.kerbside import houses_of
from sim.roads.network import Edge, Network
from sim.roads.network import Lane as RoadLane
from sim.roads.networks import resolve_polygons
from sim.rows import Rows
from sim.scenario import Scenario
from sim.streams import Stream, random_generator
from sim.traffic.base import PARKED

NEAR_M = 120.0
"""Margin around `network.area_m` within which cars are parked, m."""

BAY_M = (6.2, 2.2)
"""Length and width of a bay, m."""

_FROM_END_M = 15.0
"""Distance of bays from junctions, m, for the view of turning drivers."""

_FROM_LANE_M = 0.35
_SPEED_MPS = (5.0, 14.5)
_BEND_RAD = 0.12
_UNIT_CLEAR_M = 4.0
_LONGEST_M = 5.6
"""Longest body that keeps to its bay wherever it stands in it, m."""


@dataclass(frozen=True, slots=True, eq=False)
class ParkedCars(Rows):
    """P parked cars beside lanes.

    Attributes:
        base: (P, 3) centres of their footprints on the road, m.
        yaw: (P,) rad.
        kind: (P,) their types, each of its own size in worlds of version 2.
        bays: polygons of all bays, empty ones included.
    """

    SHARED: ClassVar = ("bays",)

    base: Array
    yaw: Array
    kind: tuple[VehicleType, ...]
    bays: shapely.Geometry


def parked_cars(scenario: Scenario, net: Network, seed: int) -> ParkedCars:
    """Park `demand.parked_per_km` cars and vans per km of kerb that has room, around the scenario's area.

    There is room at the kerb of a street of at most 50 km/h whose outermost lane is for cars, where neither another
    lane nor a footway, a junction or a roadside unit is.

    Args:
        scenario: gives the rate, the area and the roadside units.
    """
    share = scenario.demand.parked_per_km * BAY_M[0] / 1000.0
    rng = random_generator(seed, Stream.PARKED_CARS)
    base, yaw, bays = [], [], []
    kinds: list[VehicleType] = []
    if share > 0:
        lanes = [lane for edge in net.getEdges(withInternal=True) for lane in edge.getLanes()]
        taken = _Ground(net, lanes, scenario)
        fleet = Fleet.of(scenario, seed)
        fitting = [
            kind for label in ("car", "van") for kind in fleet.types_of(label) if fleet.largest(kind)[0] <= _LONGEST_M
        ]
        for edge in sorted(net.getEdges(withInternal=False), key=lambda edge: edge.getID()):
            lane = _kerb_lane(edge)
            if lane is None or not taken.reaches(lane):
                continue
            for middle, heading, bay in _slots(lane, net.kerb_side):
                # Drawn for every bay, so that no car depends on bays elsewhere.
                lot, kind = float(rng.uniform()), _draw(fitting, rng)
                aside, along = rng.uniform(0.0, 0.15), rng.uniform(-0.3, 0.3)
                turned = float(wrap_angle(heading + rng.normal(0.0, 0.015)))
                if not taken.claim(bay):
                    continue
                bays.append(bay)
                if lot < share:
                    kind = fleet.own(kind, f"{PARKED}{len(kinds)}")
                    out = 0.5 * lane.getWidth() + _FROM_LANE_M + 0.5 * kind.size[1] + aside
                    # A wide one stands no farther out than its bay.
                    out = min(out, 0.5 * lane.getWidth() + _FROM_LANE_M + BAY_M[1] - 0.5 * kind.size[1])
                    ahead = np.array([np.cos(heading), np.sin(heading)])
                    kerb = net.kerb_side * np.array([-ahead[1], ahead[0]])
                    base.append([*(middle[:2] + out * kerb + along * ahead), middle[2]])
                    yaw.append(turned)
                    kinds.append(kind)
    return ParkedCars(
        np.array(base, np.float64).reshape(-1, 3),
        np.array(yaw, np.float64),
        tuple(kinds),
        shapely.union_all(bays) if bays else shapely.Polygon(),
    )


class _Ground:
    """Occupied ground: lanes, junctions, surroundings of roadside units, other bays, and all beyond the area."""

    def __init__(self, net: Network, lanes: Sequence[RoadLane], scenario: Scenario) -> None:
        area = scenario.network.area_m or net.getBoundary()
        self._frame = shapely.box(*area).buffer(NEAR_M, join_style="mitre")
        lanes = [lane for lane in lanes if len(lane.getShape()) > 1 and self.reaches(lane)]
        lines = [np.array(lane.getShape())[:, :2] for lane in lanes]
        shapes = [
            shapely.LineString(line).buffer(0.5 * lane.getWidth(), cap_style="flat")
            for lane, line in zip(lanes, lines, strict=True)
        ]
        corners = [node.getShape() for node in net.getNodes()]
        shapes += [shapely.Polygon([corner[:2] for corner in shape]).buffer(0) for shape in corners if len(shape) > 2]
        units = [shapely.Point(unit.xyz_m[:2]).buffer(_UNIT_CLEAR_M) for unit in scenario.agents.roadside]
        self._shapes = [*shapes, *units, *houses_of(resolve_polygons(scenario))]
        self._tree = shapely.STRtree(self._shapes)
        self._bays: list[shapely.Polygon] = []

    def reaches(self, lane: RoadLane) -> bool:
        """Return whether a lane lies within the area and its margin."""
        return bool(self._frame.intersects(shapely.LineString([corner[:2] for corner in lane.getShape()])))

    def claim(self, bay: shapely.Polygon) -> bool:
        """Occupy a bay; False if it is not free."""
        core = bay.buffer(-0.1)
        if not self._frame.contains(core) or len(self._tree.query(core, predicate="intersects")):
            return False
        if any(core.intersects(other) for other in self._bays):
            return False
        self._bays.append(bay)
        return True


def _slots(lane: RoadLane, side: float) -> list[tuple[Array, float, shapely.Polygon]]:
    """Return (centre on the lane's line, heading, bay) along the straight parts of a lane."""
    line = np.array(lane.getShape3D(), np.float64)
    step = np.hypot(*np.diff(line[:, :2], axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(step)])
    found = []
    length, width = BAY_M
    for start in np.arange(_FROM_END_M, along[-1] - _FROM_END_M - length, length):
        at = start + np.array([0.0, 0.5, 1.0]) * length
        ends = np.column_stack([np.interp(at, along, line[:, k]) for k in range(3)])
        first, last = ends[1, :2] - ends[0, :2], ends[2, :2] - ends[1, :2]
        bend = np.arctan2(first[0] * last[1] - first[1] * last[0], first @ last)
        if abs(bend) > _BEND_RAD:
            continue
        way = (ends[2, :2] - ends[0, :2]) / max(float(np.hypot(*(ends[2, :2] - ends[0, :2]))), 1e-9)
        kerb = side * np.array([-way[1], way[0]])
        near, far = 0.5 * lane.getWidth(), 0.5 * lane.getWidth() + _FROM_LANE_M + width
        corners = [ends[0, :2] + far * kerb, ends[2, :2] + far * kerb, ends[2, :2] + near * kerb]
        bay = shapely.Polygon([*corners, ends[0, :2] + near * kerb])
        found.append((ends[1], float(np.arctan2(way[1], way[0])), bay))
    return found


def _kerb_lane(edge: Edge) -> RoadLane | None:
    """Return the outermost car lane of a street with only footways beside it; None for other streets."""
    if not _SPEED_MPS[0] <= edge.getSpeed() <= _SPEED_MPS[1]:
        return None
    for lane in edge.getLanes():
        if lane.allows("passenger"):
            return lane
        if lane.allows("bicycle"):
            return None
    return None


def _draw(kinds: Sequence[VehicleType], rng: np.random.Generator) -> VehicleType:
    weights = np.array([kind.weight * (1.0 if kind.label == "car" else 0.2) for kind in kinds])
    return kinds[int(rng.choice(len(kinds), p=weights / weights.sum()))]
