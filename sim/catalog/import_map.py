"""Map import: a scenario folder with scenario.toml, converted network and roadside objects.

Area, demand and agents are chosen such that a drive can be made with each of ten seeds, tried by `sim.catalog.dry_run`.
"""

import logging
import re
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from sim.catalog.dry_run import STAY_S, carried, least_traffic, longest_stay, rates
from sim.catalog.mix import read_mix, with_mix
from sim.errors import ScenarioError, complaint
from sim.reading import parsing
from sim.roads.convert import ConvertedMap, TrafficSide, convert_map, is_network, map_kind
from sim.roads.focus import PlaceArea, beside_road, busiest_place
from sim.scenario import DemandSpec

log = logging.getLogger(__name__)

SEEDS = range(1, 11)
"""Seeds whose drives an imported map must give."""

_AGENTS = 3
_OSM = "Map data (c) OpenStreetMap contributors, ODbL 1.0"


def import_map(
    source: Path,
    name: str = "",
    out: Path | None = None,
    seeds: Sequence[int] = SEEDS,
    traffic_side: TrafficSide = "auto",
    mix: str = "",
) -> Path:
    """Import a map as a scenario, with traffic around its busiest junction or on its longest road.

    Args:
        source: a .net.xml(.gz), an OpenStreetMap extract (.osm, .osm.gz, .osm.bz2, .osm.pbf, or
            Overpass's .json) or OpenDRIVE (.xodr).
        name: of the scenario; default: from the file.
        out: folder to make; default: one of that name here.
        seeds: seeds whose drives must be possible.
        traffic_side: side on which traffic keeps; `auto`: as the map or its country has it.
        mix: weights of the classes of road users, see `sim.catalog.mix`; default: those of a European town.

    Returns:
        The folder: `dsrc generate FOLDER` takes it.

    Raises:
        ScenarioError: the file is missing, of an unknown format, refused by netconvert, without a road for cars, or
            its roads are too short for a drive; or the folder is not empty.
        SettingsError: the mix names an unknown class, or no cars.
    """
    weights = read_mix(mix)
    source = Path(source)
    kind = map_kind(source)
    name = name or re.sub("[^A-Za-z0-9_-]+", "_", source.name[: -len(kind)]).strip("_") or "place"
    if not re.fullmatch("[A-Za-z0-9_-]+", name):
        raise ScenarioError(complaint("scenario import", "name", "letters, digits, _ and -", name))
    folder = Path(out) if out is not None else Path(name)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ScenarioError(complaint(folder, "scenario import", "a folder that is empty or not there", "files"))
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as work:
        made = Path(work) / "made"
        made.mkdir()
        found = convert_map(source, made, traffic_side)
        with parsing(source, "map", ScenarioError):
            _write_scenario(made / "scenario.toml", source, name, found, seeds, weights)
        if folder.is_dir():
            folder.rmdir()
        shutil.move(made, folder)
    return folder


def _write_scenario(
    path: Path, source: Path, name: str, found: ConvertedMap, seeds: Sequence[int], mix: Mapping[str, float]
) -> None:
    """Write a scenario whose demand and agents hold for every seed."""
    from sim.roads.networks import read_network

    focus = None
    if "<edge " in found.net.read_text(encoding="utf-8"):
        net = read_network(found.net)
        focus = busiest_place(net)
    if focus is None:
        raise ScenarioError(complaint(source, "map", "a road for cars", "none"))
    carries = carried(net, focus)
    kept = with_mix(carries, mix)
    if "car" not in kept.type_mix:
        raise ScenarioError(complaint(source, "map", "a route for cars", "none"))
    unit = beside_road(net, focus.xy)

    def write(vehicles_per_hour: float, vehicles: int) -> None:
        demand = with_mix(msgspec.structs.replace(carries, vehicles_per_hour=vehicles_per_hour), mix)
        path.write_text(_scenario(source, name, found, focus, demand, vehicles, unit), encoding="utf-8")

    rate = 0.0
    for rate in rates(net, focus, kept):
        write(rate, _AGENTS)
        log.info("%s: dry run of seeds %d to %d, %.0f vehicles per hour", source.name, seeds[0], seeds[-1], rate)
        if least_traffic(path, seeds, _AGENTS)[0] >= _AGENTS:
            return
    staying, seen = least_traffic(path, seeds, 0)
    if staying < 1 and (unit is None or seen < 1):
        expected = f"cars that stay in the area for {STAY_S:g} s with each of the seeds {seeds[0]} to {seeds[-1]}"
        raise ScenarioError(complaint(source, "map", expected, longest_stay(net, focus)))
    write(rate, min(staying, _AGENTS))
    if staying < _AGENTS:
        log.warning("%s: %s", source.name, _few(staying))


def _few(vehicles: int) -> str:
    if vehicles == 0:
        return f"the roadside unit is the only agent, since no car is sure to stay in the area for {STAY_S:g} s"
    return f"{vehicles} connected vehicle{'s' if vehicles > 1 else ''} in place of {_AGENTS}: no more are sure to stay"


def _scenario(
    source: Path,
    name: str,
    found: ConvertedMap,
    focus: PlaceArea,
    demand: DemandSpec,
    vehicles: int,
    unit: tuple[float, float, float] | None,
) -> str:
    """Return the text of a scenario.toml."""
    from sim.roads.polygons import has_buildings

    kind = map_kind(source)
    mapped = found.polygons is not None and has_buildings(found.polygons)
    area = ", ".join(f"{value:.1f}" for value in focus.area_m)
    mix = ", ".join(f"{label} = {weight:g}" for label, weight in demand.type_mix.items())
    lines = [
        f'name = "{name}"',
        f'description = "Imported from {source.name.translate(str.maketrans("", "", chr(34) + chr(92)))}."',
        "warmup_s = 120.0",
        "duration_s = 60.0",
        "seed = 1",
        *([] if kind == ".xodr" or is_network(source) else [f'attribution = "{_OSM}"']),
        "",
        "[network]",
        'file = "map.net.xml"',
        "round = false  # it has been rounded",
        *(['polygons = "map.poly.xml"'] if found.polygons is not None else []),
        f"area_m = [{area}]",
        *([] if mapped else ["front_gardens = 0.4"]),
        "",
        "[demand]",
        f"vehicles_per_hour = {demand.vehicles_per_hour:.1f}",
        f"bicycles_per_hour = {demand.bicycles_per_hour}",
        f"persons_per_hour = {demand.persons_per_hour}",
        *([f"type_mix = {{ {mix} }}"] if demand.type_mix != DemandSpec().type_mix else []),
        f"focus_m = [{focus.xy[0]}, {focus.xy[1]}]",
        f"max_vehicles = {demand.max_vehicles}",
        f"parked_per_km = {demand.parked_per_km}",
        "",
        "[agents]",
        f"vehicles = {vehicles}",
        'lidar = "opv2v-64"',
        "within_m = 80.0",
    ]
    if unit is not None:
        lines += [
            "",
            "[[agents.roadside]]",
            "# Beside the road, facing the focus.",
            f"xyz_m = [{unit[0]}, {unit[1]}, 5.0]",
            f"yaw_deg = {unit[2]}",
            "pitch_deg = 15.0",
            'lidar = "dair-roadside"',
        ]
    return "\n".join(lines) + "\n"
