"""Roadside objects of a map: trees, lamps, poles, bollards, hedges, fences and walls."""

import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import shapely

from sim.errors import ScenarioError
from sim.geometry import Array
from sim.reading import parsing, read_bytes
from sim.world.furniture.barriers import HEIGHT_M

_POINTS = {
    "natural.tree": "tree",
    "highway.street_lamp": "lamp",
    "man_made.utility_pole": "pole",
    "barrier.bollard": "bollard",
}
_ROW_EVERY_M = 8.0
_BELIEVED_M = (0.3, 6.0)


@dataclass(frozen=True, slots=True, eq=False)
class MapObjects:
    """Roadside objects in the coordinates of the network.

    Attributes:
        points: "tree", "lamp", "pole" or "bollard" -> (N, 2) positions, m.
        barriers: (kind, line, height in m) of each.
    """

    points: dict[str, Array] = field(default_factory=dict)
    barriers: tuple[tuple[str, shapely.LineString, float], ...] = ()


def read_map_objects(path: Path) -> MapObjects:
    """Read the supported objects of a .poly.xml file, buildings excepted.

    Raises:
        ScenarioError: the file is missing or of another format.
    """
    content = read_bytes(path, ".poly.xml file", ScenarioError)
    with parsing(path, ".poly.xml file", ScenarioError):
        root = ET.fromstring(content)
        found: dict[str, list[list[float]]] = {}
        for poi in root.iter("poi"):
            kind = _POINTS.get(poi.get("type", ""))
            if kind and poi.get("x") and poi.get("y"):
                found.setdefault(kind, []).append([float(poi.get("x", "")), float(poi.get("y", ""))])
        barriers = []
        for poly in root.iter("poly"):
            kind = poly.get("type", "")
            name = kind.removeprefix("barrier.")
            if kind != "natural.tree_row" and name not in HEIGHT_M:
                continue
            corners = [[float(value) for value in place.split(",")[:2]] for place in poly.get("shape", "").split()]
            line = shapely.LineString(corners) if len(corners) > 1 else shapely.LineString()
            if not np.isfinite(corners).all() or line.length < 0.5:
                continue
            if kind == "natural.tree_row":
                at = np.arange(0.5 * _ROW_EVERY_M, line.length, _ROW_EVERY_M)
                row = shapely.get_coordinates(shapely.line_interpolate_point(line, at))
                found.setdefault("tree", []).extend(row.tolist())
            else:
                barriers.append((name, line, _height(poly, HEIGHT_M[name])))
    return MapObjects({kind: np.array(places) for kind, places in found.items()}, tuple(barriers))


def _height(poly: ET.Element, usual_m: float) -> float:
    for param in poly.iter("param"):
        if param.get("key") == "height":
            try:
                height = float(param.get("value", "").removesuffix("m"))
            except ValueError:
                continue
            if _BELIEVED_M[0] <= height <= _BELIEVED_M[1]:
                return height
    return usual_m
