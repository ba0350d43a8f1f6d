"""Map import: a scenario folder with scenario.toml, converted network and roadside objects."""

import re
import shutil
import tempfile
from pathlib import Path

from sim.errors import ScenarioError, complaint
from sim.reading import parsing
from sim.roads.convert import ConvertedMap, convert_map, map_kind
from sim.roads.focus import JunctionArea, beside_junction, densest_junction

_OSM = "Map data (c) OpenStreetMap contributors, ODbL 1.0"


def import_map(source: Path, name: str = "", out: Path | None = None) -> Path:
    """Import a map as a scenario, with traffic around its busiest junction.

    Args:
        source: a .net.xml(.gz), an OpenStreetMap extract (.osm, .osm.gz, .osm.bz2, .osm.pbf) or OpenDRIVE (.xodr).
        name: of the scenario; default: from the file.
        out: folder to make; default: one of that name here.

    Returns:
        The folder: `dsrc generate FOLDER` takes it.

    Raises:
        ScenarioError: the file is missing, of an unknown format, refused by netconvert or without a road for cars; or
            the folder is not empty.
    """
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
        found = convert_map(source, made)
        with parsing(source, "map", ScenarioError):
            (made / "scenario.toml").write_text(_scenario(source, kind, name, found), encoding="utf-8")
        if folder.is_dir():
            folder.rmdir()
        shutil.move(made, folder)
    return folder


def _scenario(source: Path, kind: str, name: str, found: ConvertedMap) -> str:
    from sim.roads.networks import read_network
    from sim.roads.polygons import has_buildings

    focus = None
    if "<edge " in found.net.read_text(encoding="utf-8"):
        net = read_network(found.net)
        focus = densest_junction(net)
    if focus is None:
        raise ScenarioError(complaint(source, "map", "a road for cars", "none"))
    unit = beside_junction(net, focus.xy)
    mapped = found.polygons is not None and has_buildings(found.polygons)
    area = ", ".join(f"{value:.1f}" for value in focus.area_m)
    lines = [
        f'name = "{name}"',
        f'description = "Imported from {source.name.translate(str.maketrans("", "", chr(34) + chr(92)))}."',
        "warmup_s = 120.0",
        "duration_s = 60.0",
        "seed = 1",
        *([f'attribution = "{_OSM}"'] if ".osm" in kind or kind == ".pbf" else []),
        "",
        "[network]",
        'file = "map.net.xml"',
        "round = false  # it has been rounded",
        *(['polygons = "map.poly.xml"'] if found.polygons is not None else []),
        f"area_m = [{area}]",
        *([] if mapped else ["front_gardens = 0.4"]),
        "",
        *_demand(focus),
        "",
        "[agents]",
        "vehicles = 3",
        'lidar = "opv2v-64"',
        "within_m = 80.0",
    ]
    if unit is not None:
        lines += [
            "",
            "[[agents.roadside]]",
            "# Beside the junction, facing it.",
            f"xyz_m = [{unit[0]}, {unit[1]}, 5.0]",
            f"yaw_deg = {unit[2]}",
            "pitch_deg = 15.0",
            'lidar = "dair-roadside"',
        ]
    return "\n".join(lines) + "\n"


def _demand(focus: JunctionArea) -> list[str]:
    """Return the demand that the lanes of the area can carry."""
    vehicles = min(max(450.0 * focus.lanes_km, 600.0), 3000.0)
    return [
        "[demand]",
        f"vehicles_per_hour = {round(vehicles, -2):.1f}",
        f"bicycles_per_hour = {80.0 if focus.cycle else 0.0}",
        f"persons_per_hour = {300.0 if focus.walk else 0.0}",
        f"focus_m = [{focus.xy[0]}, {focus.xy[1]}]",
        "max_vehicles = 120",
        "parked_per_km = 60.0",
    ]
