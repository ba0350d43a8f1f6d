"""Building outlines of .poly.xml files, as written by SUMO's polyconvert."""

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from sim.errors import ScenarioError, complaint
from sim.mesh.solids import rings_of
from sim.reading import LARGEST_BYTES, parsing, read_bytes, read_text

STOREY_M = 3.0
"""Height of a storey, m."""

_BELIEVED_M = (2.0, 400.0)
"""Plausible range of heights, m; others are errors of the map."""


@dataclass(frozen=True, slots=True, eq=False)
class BuildingOutline:
    """Building of a .poly.xml file.

    Attributes:
        shape: valid polygon or polygons in the coordinates of the network, m.
        height_m: m; None where the file does not give it.
    """

    shape: shapely.Geometry
    height_m: float | None


def has_buildings(path: Path) -> bool:
    """Return whether a .poly.xml file has any building; a map may have only trees.

    Raises:
        ScenarioError: the file is missing or not text.
    """
    return ' type="building' in read_text(path, ".poly.xml file", ScenarioError, LARGEST_BYTES)


def read_outlines(path: Path) -> list[BuildingOutline]:
    """Read the buildings of a .poly.xml file: polygons whose type begins with `building`.

    Roofs on posts (`building.roof`) have no walls and are left out, as are polygons without an area. Crossing outlines
    are repaired.

    Raises:
        ScenarioError: the file is missing, of another format or without buildings.
    """
    content = read_bytes(path, ".poly.xml file", ScenarioError)
    with parsing(path, ".poly.xml file", ScenarioError):
        return _outlines(path, ET.fromstring(content))


def _outlines(path: Path, root: ET.Element) -> list[BuildingOutline]:
    outlines = []
    for poly in root.iter("poly"):
        kind = poly.get("type", "")
        # A part stands within the outline of its building.
        if not kind.startswith("building") or kind == "building.roof" or kind.startswith("building:part"):
            continue
        if poly.get("geo", "false").lower() in ("1", "true", "yes"):
            expected = "coordinates of the network (polyconvert without --proj.plain-geo)"
            raise ScenarioError(complaint(path, f"poly '{poly.get('id')}': geo", expected, "degrees"))
        shape = _valid(_corners(path, poly))
        if not shape.is_empty:
            outlines.append(BuildingOutline(shape, _height(poly)))
    if not outlines:
        raise ScenarioError(complaint(path, "poly", "at least one with a type that begins with 'building'", "none"))
    return outlines


def _corners(path: Path, poly: ET.Element) -> NDArray[np.float64]:
    """Return (K, 2) corners of a polygon."""
    text = poly.get("shape", "")
    try:
        corners = np.array([[float(value) for value in place.split(",")[:2]] for place in text.split()], np.float64)
        corners = corners.reshape(-1, 2)
    except ValueError:
        corners = np.full((1, 2), np.nan)
    if not np.isfinite(corners).all():
        raise ScenarioError(complaint(path, f"poly '{poly.get('id')}': shape", "finite numbers as x,y x,y ...", text))
    return corners


def _valid(corners: NDArray[np.float64]) -> shapely.Geometry:
    """Return the area within (K, 2) corners as valid polygons; may be empty."""
    if len(corners) < 3:
        return shapely.Polygon()
    return shapely.union_all(rings_of(shapely.make_valid(shapely.Polygon(corners))))


def _height(poly: ET.Element) -> float | None:
    """Return the height of a building from its parameters, m; None without a plausible value."""
    given = {param.get("key", ""): param.get("value", "") for param in poly.iter("param")}
    for key, unit_m in (("height", 1.0), ("building:levels", STOREY_M)):
        try:
            height = unit_m * float(given[key].removesuffix("m").replace(",", "."))
        except (KeyError, ValueError):
            continue
        if math.isfinite(height) and _BELIEVED_M[0] <= height <= _BELIEVED_M[1]:
            return height
    return None
