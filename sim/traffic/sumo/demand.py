"""SUMO demand: seeded trips of vehicles, bicycles and pedestrians as a .rou.xml."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sim.bodies.fleet import Fleet
from sim.bodies.vehicle_types import VehicleType
from sim.errors import ScenarioError, complaint
from sim.files import write_file
from sim.roads.network import Network
from sim.roads.networks import resolve_trips
from sim.scenario import Scenario
from sim.streams import Stream, random_generator
from sim.traffic.sumo.routes import Routes, candidate_routes, walkable_edges
from sim.traffic.sumo.trips import read_trips

AFTER_S = 1800.0
"""Duration of trips after the nominal end, s, for runs that continue."""


def write_demand(scenario: Scenario, net: Network, seed: int, path: Path) -> Path:
    """Write vTypes, vehicles, bicycles and persons of a scenario, sorted by departure.

    One random stream per kind: adding bicycles leaves the cars as they were.

    Args:
        scenario: gives rates, mix, area and duration.
        seed: equal seeds write equal bytes.
        path: the .rou.xml, written atomically.

    Raises:
        ScenarioError: a class that the scenario asks for has no route in the network.
    """
    streams = random_generator(seed, Stream.DEMAND).spawn(3)
    kinds = _Kinds(Fleet.of(scenario, seed))
    end_s = scenario.warmup_s + scenario.duration_s + AFTER_S
    motor = _recorded if scenario.demand.trips else _vehicles
    trips = [
        *motor(scenario, net, kinds, streams[0], end_s),
        *_bicycles(scenario, net, kinds, streams[1], end_s),
        *_persons(scenario, net, kinds, streams[2], end_s),
    ]
    trips.sort()
    body = [kind.xml() for kind in kinds.used.values()] + [text for _, _, text in trips]
    write_file(path, "<routes>\n  " + "\n  ".join(body) + "\n</routes>\n", edited=True)
    return path


def _vehicles(
    scenario: Scenario, net: Network, kinds: "_Kinds", rng: np.random.Generator, end_s: float
) -> Iterator[tuple[float, str, str]]:
    labels = sorted(name for name, weight in scenario.demand.type_mix.items() if weight > 0)
    weights = np.array([scenario.demand.type_mix[name] for name in labels])
    routes: dict[str, Routes] = {}
    for index, depart_s in enumerate(_departures(scenario.demand.vehicles_per_hour, rng, end_s)):
        kind = kinds.draw(labels[int(rng.choice(len(labels), p=weights / weights.sum()))], rng)
        if kind.vclass not in routes:
            routes[kind.vclass] = _require(scenario, net, kind.vclass)
        yield _vehicle(f"v{index}", kinds.own(kind, f"v{index}"), routes[kind.vclass], depart_s, rng)


def _recorded(
    scenario: Scenario, net: Network, kinds: "_Kinds", rng: np.random.Generator, end_s: float
) -> Iterator[tuple[float, str, str]]:
    """Yield the recorded trips from a seeded start time on, in vehicles of `sim.bodies.vehicle_types`."""
    demand = scenario.demand
    labels = sorted(name for name, weight in demand.type_mix.items() if weight > 0)
    weights = np.array([demand.type_mix[name] for name in labels])
    first_s, last_s = demand.trips_s
    begin_s = rng.uniform(first_s, max(first_s, last_s - scenario.warmup_s - scenario.duration_s))
    known = {edge.getID() for edge in net.getEdges(withInternal=False)}
    for index, trip in enumerate(read_trips(resolve_trips(scenario))):
        drawn = labels[int(rng.choice(len(labels), p=weights / weights.sum()))] if labels else trip.label
        kind = kinds.draw(drawn if trip.label not in ("pedestrian", "bicycle") else trip.label, rng)
        after_s = trip.depart_s - begin_s
        if not 0.0 <= after_s < end_s or not known.issuperset(trip.edges):
            continue
        name = f"{'p' if trip.label == 'pedestrian' else 'v'}{index}"
        start = f'type="{kinds.own(kind, name).name}" depart="{after_s:.2f}"'
        ends = f'from="{trip.edges[0]}" to="{trip.edges[-1]}"'
        if trip.label == "pedestrian":
            way = f'edges="{" ".join(trip.edges)}"' if trip.is_route else ends
            text = f'<person id="{name}" {start}><walk {way}/></person>'
        else:
            start = f'id="{name}" {start} departLane="best" departSpeed="max"'
            via = f' via="{" ".join(trip.edges[1:-1])}"' if len(trip.edges) > 2 else ""
            if trip.is_route:
                text = f'<vehicle {start}><route edges="{" ".join(trip.edges)}"/></vehicle>'
            else:
                text = f"<trip {start} {ends}{via}/>"
        yield round(after_s, 2), name, text


def _bicycles(
    scenario: Scenario, net: Network, kinds: "_Kinds", rng: np.random.Generator, end_s: float
) -> Iterator[tuple[float, str, str]]:
    if scenario.demand.bicycles_per_hour == 0:
        return
    routes = _require(scenario, net, "bicycle")
    for index, depart_s in enumerate(_departures(scenario.demand.bicycles_per_hour, rng, end_s)):
        kind = kinds.own(kinds.draw("bicycle", rng), f"b{index}")
        yield _vehicle(f"b{index}", kind, routes, depart_s, rng)


def _vehicle(
    name: str, kind: VehicleType, routes: Routes, depart_s: float, rng: np.random.Generator
) -> tuple[float, str, str]:
    edges = routes.edges[int(rng.choice(len(routes.edges), p=routes.probability))]
    text = (
        f'<vehicle id="{name}" type="{kind.name}" depart="{depart_s:.2f}" departLane="best" departSpeed="max">'
        f'<route edges="{" ".join(edges)}"/></vehicle>'
    )
    return round(depart_s, 2), name, text


def _persons(
    scenario: Scenario, net: Network, kinds: "_Kinds", rng: np.random.Generator, end_s: float
) -> Iterator[tuple[float, str, str]]:
    """Yield walks between two random points of connected sidewalks and footways."""
    if scenario.demand.persons_per_hour == 0:
        return
    stretches = walkable_edges(net, scenario.network.area_m)
    if not stretches:
        message = complaint(scenario.name, "demand.persons_per_hour", "sidewalks or footways in the area", "none")
        raise ScenarioError(message)
    lengths = np.array([sum(edge.getLength() for edge in stretch) for stretch in stretches])
    for index, depart_s in enumerate(_departures(scenario.demand.persons_per_hour, rng, end_s)):
        kind = kinds.own(kinds.draw("pedestrian", rng), f"p{index}")
        stretch = stretches[int(rng.choice(len(stretches), p=lengths / lengths.sum()))]
        start, goal = (stretch[int(row)] for row in rng.integers(len(stretch), size=2))
        at_m, to_m = (rng.uniform(0.05, 0.95) * edge.getLength() for edge in (start, goal))
        text = (
            f'<person id="p{index}" type="{kind.name}" depart="{depart_s:.2f}" departPos="{at_m:.2f}">'
            f'<walk from="{start.getID()}" to="{goal.getID()}" arrivalPos="{to_m:.2f}"/></person>'
        )
        yield round(depart_s, 2), f"p{index}", text


def _require(scenario: Scenario, net: Network, vclass: str) -> Routes:
    network, demand = scenario.network, scenario.demand
    area = network.area_m if demand.through_area else None
    focus = demand.focus_m
    if focus is None and network.area_m:
        x_min, y_min, x_max, y_max = network.area_m
        focus = (0.5 * (x_min + x_max), 0.5 * (y_min + y_max))
    routes = candidate_routes(net, vclass, area, focus)
    if not routes.edges:
        expected = f"a network with a route for class '{vclass}' through the area"
        raise ScenarioError(complaint(scenario.name, "demand", expected, "no route"))
    return routes


def _departures(per_hour: float, rng: np.random.Generator, end_s: float) -> Iterator[float]:
    """Yield the times of a Poisson process: a longer run begins with the same trips."""
    now_s = 0.0
    while per_hour > 0:
        now_s += rng.exponential(3600.0 / per_hour)
        if now_s >= end_s:
            return
        yield now_s


class _Kinds:
    """Types that trips use, by id: all of a fleet of fixed sizes, else one for each road user."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self.used: dict[str, VehicleType] = {} if fleet.varied else {kind.name: kind for kind in fleet.types()}

    def draw(self, label: str, rng: np.random.Generator) -> VehicleType:
        """Return a type of a label, drawn by the weights."""
        kinds = self._fleet.types_of(label)
        weights = np.array([kind.weight for kind in kinds])
        return kinds[int(rng.choice(len(kinds), p=weights / weights.sum()))]

    def own(self, kind: VehicleType, name: str) -> VehicleType:
        """Return the type of a road user, and use it."""
        own = self._fleet.own(kind, name)
        self.used[own.name] = own
        return own
