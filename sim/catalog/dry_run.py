"""Dry run of an imported map: the demand that its roads carry, and the traffic that each seed then has.

Traffic runs in processes of its own, as libsumo holds one simulation per process: a map may be imported while another
simulation runs, and a network that makes SUMO hang or crash is told in one line.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
from shapely.geometry import LineString, box

from sim.bodies.vehicle_types import types_of
from sim.errors import ScenarioError, UserError, complaint, one_line
from sim.roads.focus import PlaceArea
from sim.roads.network import Network
from sim.scenario import DemandSpec
from sim.traffic.staying import CARRIERS

STAY_S = 10.0
"""Length of a drive of 100 frames, s: agents stay in the area for all of it."""

_EXPECTED = 8.0
"""Cars and vans that should stay at any time: fewer than three do then with 1 % of the seeds."""

_RATES = (600.0, 4000.0)
_PER_LANE_KM = 450.0
_MORE = 1.7
_MOST_S = 300.0


def carried(net: Network, focus: PlaceArea) -> DemandSpec:
    """Return the demand of an area without a rate of vehicles: the classes that have routes there."""
    from sim.traffic.sumo.routes import candidate_routes, walkable_edges

    def has_routes(label: str) -> bool:
        classes = {kind.vclass for kind in types_of(label)}
        return all(candidate_routes(net, vclass, focus.area_m, focus.xy).edges for vclass in sorted(classes))

    return DemandSpec(
        # Outside of towns cars would queue behind a bicycle, with an empty road before it.
        bicycles_per_hour=80.0 if (focus.cycle or focus.walk) and has_routes("bicycle") else 0.0,
        persons_per_hour=300.0 if focus.walk and walkable_edges(net, focus.area_m) else 0.0,
        type_mix={label: weight for label, weight in DemandSpec().type_mix.items() if has_routes(label)},
        focus_m=focus.xy,
        max_vehicles=120,
        parked_per_km=60.0,
    )


def rates(net: Network, focus: PlaceArea, demand: DemandSpec) -> Iterator[float]:
    """Yield rates of vehicles per hour to try, rising: first what lanes carry, or more for `_EXPECTED` that stay."""
    share = sum(demand.type_mix.get(label, 0.0) for label in CARRIERS) / sum(demand.type_mix.values())
    probability, stay_s = _stays(net, focus)
    staying_s = share * float(probability @ np.maximum(stay_s - STAY_S, 0.0))
    wanted = 3600.0 * _EXPECTED / max(staying_s, 1e-9)
    rate = float(np.clip(max(_PER_LANE_KM * focus.lanes_km, wanted), *_RATES))
    while True:
        yield round(rate, -2)
        if rate == _RATES[1]:
            return
        rate = min(rate * _MORE, _RATES[1])


def longest_stay(net: Network, focus: PlaceArea) -> str:
    """Return how long a car stays in the area on its longest route, as what was found."""
    return f"{_stays(net, focus)[1].max():.1f} s at most at the speed limits"


def _stays(net: Network, focus: PlaceArea) -> tuple[np.ndarray, np.ndarray]:
    """Return (R,) probability of each route of cars, and (R,) time that it takes within the area, s."""
    from sim.traffic.sumo.routes import candidate_routes

    routes, area = candidate_routes(net, "passenger", focus.area_m, focus.xy), box(*focus.area_m)
    edges = {edge.getID(): edge for edge in net.getEdges(withInternal=False)}
    inside_s = {
        name: LineString([p[:2] for p in edges[name].getShape()]).intersection(area).length / edges[name].getSpeed()
        for name in {name for route in routes.edges for name in route}
    }
    return routes.probability, np.array([sum(inside_s[name] for name in route) for route in routes.edges])


def least_traffic(scenario: Path, seeds: Sequence[int], enough: int) -> tuple[int, int]:
    """Return the fewest cars and vans that stay in the area for `STAY_S`, and the fewest that are seen there.

    Args:
        scenario: path of its scenario.toml.
        seeds: seeds to try; with each the traffic runs for the scenario's warm-up and `STAY_S`.
        enough: fewer that stay end the dry run.

    Raises:
        ScenarioError: the traffic cannot run, or not within five minutes.
    """
    cuts = np.linspace(0, len(seeds), min(len(seeds), os.cpu_count() or 1) + 1).round().astype(int)
    shares = [list(seeds[low:high]) for low, high in pairwise(cuts.tolist())]
    root = str(Path(__file__).resolve().parents[2])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([root, os.environ.get("PYTHONPATH", "")])}
    jobs = [
        subprocess.Popen(
            [sys.executable, "-m", "sim.catalog.dry_run", str(scenario), str(enough), *map(str, share)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, errors="replace", env=environment,
        )
        for share in shares
    ]  # fmt: skip
    try:
        found = [row for job in jobs for row in _counted(job, scenario)]
    finally:
        for job in jobs:
            job.kill()
            job.wait()
    return min(staying for staying, _ in found), min(seen for _, seen in found)


def _counted(job: subprocess.Popen[str], scenario: Path) -> list[tuple[int, int]]:
    try:
        said, errors = job.communicate(timeout=_MOST_S)
    except subprocess.TimeoutExpired:
        raise ScenarioError(complaint(scenario, "traffic", f"a dry run within {_MOST_S:g} s", "longer")) from None
    # Libraries print lines of their own before.
    last = json.loads(said.splitlines()[-1]) if job.returncode == 0 and said else one_line(errors[-300:], 300)
    if isinstance(last, str):
        raise ScenarioError(last or complaint(scenario, "traffic", "a dry run", f"exit code {job.returncode}"))
    return [(int(staying), int(seen)) for staying, seen in last]


def _main(scenario_file: str, enough: str, *seeds: str) -> None:
    """Print the counts of each seed, or an error, as one line of JSON."""
    answer: object
    try:
        answer = list(_counts(Path(scenario_file), int(enough), [int(seed) for seed in seeds]))
    except UserError as error:
        answer = str(error)
    sys.stdout.write(f"\n{json.dumps(answer)}\n")


def _counts(scenario_file: Path, enough: int, seeds: Sequence[int]) -> Iterator[tuple[int, int]]:
    from sim.catalog.load import load_scenario
    from sim.traffic.open import open_traffic
    from sim.traffic.staying import carrier_ids

    scenario = load_scenario(scenario_file)
    # Parked cars take no part.
    scenario = msgspec.structs.replace(scenario, demand=msgspec.structs.replace(scenario.demand, parked_per_km=0.0))
    for seed in seeds:
        with open_traffic(scenario, seed) as traffic:
            ids = carrier_ids(traffic.actors, scenario)
            seen = set(ids.tolist())
            for _ in range(round(STAY_S / scenario.step_s)):
                here = carrier_ids(traffic.step(), scenario)
                ids = np.intersect1d(ids, here, assume_unique=True)
                seen |= set(here.tolist())
        yield len(ids), len(seen)
        if len(ids) < enough:
            return


if __name__ == "__main__":
    _main(*sys.argv[1:])
