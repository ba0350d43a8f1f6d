"""Tracks of SUMO: what `sumo --fcd-output` writes, with the sizes of the vehicle types in files beside it.

Source: https://sumo.dlr.de/docs/Simulation/Output/FCDOutput.html and Vehicle_Type_Parameter_Defaults.html: x and y are
those of the middle of a vehicle's front bumper, and of the middle of a person; angles are degrees clockwise from north.
"""

import logging
import math
import re
from array import array
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sim.bodies.vehicle_types import TYPES
from sim.errors import DataError, UserError, complaint
from sim.geometry import center_from_sumo
from sim.reading import parsing
from sim.traffic.tracks.base import Recording, Track, make_track
from sim.traffic.tracks.xml_file import children, number_of, read_xml_bytes

_Kind = tuple[str, float, float, float]
"""Class, length, width and height, m."""

_Types = dict[str, _Kind | None]
"""Kinds by the name of their type; None for what is no road user."""

_CAR, _RESCUE = ("car", 5.0, 1.8, 1.5), ("van", 6.5, 2.16, 2.86)
_VCLASSES: dict[str, _Kind] = {
    "passenger": _CAR,
    "taxi": _CAR,
    "emergency": _RESCUE,
    "delivery": _RESCUE,
    "truck": ("truck", 7.1, 2.4, 2.4),
    "trailer": ("truck", 16.5, 2.55, 4.0),
    "bus": ("bus", 12.0, 2.5, 3.4),
    "coach": ("bus", 14.0, 2.6, 4.0),
    "motorcycle": ("motorcycle", 2.2, 0.9, 1.5),
    "moped": ("motorcycle", 2.1, 0.8, 1.7),
    "bicycle": ("bicycle", 1.6, 0.65, 1.7),
    "scooter": ("bicycle", 1.2, 0.5, 1.7),
    "pedestrian": ("pedestrian", 0.6, 0.6, 1.75),  # SUMO's own size is that of a place in a crowd
    "wheelchair": ("pedestrian", 0.8, 0.7, 1.4),
}
"""Class, length, width and height of SUMO's vehicle classes, m; all others but rails and ships are cars."""
_NO_ROAD_USER = re.compile("rail(?!er)|tram|subway|ship(?!ping)|container|drone|aircraft|cable_car")
_WORDS = {"bike": "bicycle", "ped": "pedestrian", "person": "pedestrian", "lorry": "truck", "van": "delivery"}
_WORDS |= {name: name for name in _VCLASSES} | {"car": "passenger", "veh": "passenger"}
_FILES_OF_TYPES = ("*.rou.xml", "*.add.xml")
_MOST_FILES = 50
_FAR_M, _SHARE = 20.0, 0.1
"""Way by the speeds from which on the places must have gone this share of it, or they are no metres."""

_log = logging.getLogger(__name__)


@dataclass
class _Samples:
    """Samples of a road user: time, x, y, z, angle, slope and speed of each; what is not given is NaN."""

    type_id: str
    walks: bool
    rows: list[array] = field(default_factory=list)


def read_fcd(path: Path) -> tuple[Recording, ...]:
    """Read vehicles and persons; persons in vehicles, containers, trains and ships are left out.

    The types of vehicles that route and additional files (`.rou.xml`, `.add.xml`) in the same folder define have their
    sizes and classes. Any other has those of the vehicle class in its name, or of a car, which is logged.

    Raises:
        DataError: no such file, a value is missing or wrong, or the places are no metres; names the object.
    """
    found: dict[str, _Samples] = {}
    with parsing(path, "FCD output of SUMO"):
        for step in children(read_xml_bytes(path, "FCD output of SUMO"), "timestep"):
            time_s = number_of(path, "timestep: time", step.get("time"))
            for one in step:
                if one.tag in ("vehicle", "person") and not one.get("vehicle"):
                    name = one.get("id", "")
                    samples = found.setdefault(name, _Samples(one.get("type", ""), one.tag == "person"))
                    samples.rows.append(_row(path, name, time_s, one.attrib))
    types = _types_beside(path)
    unknown: set[str] = set()
    tracks = [_track(path, name, samples, types, unknown) for name, samples in found.items()]
    if unknown:
        _log.warning("%s: no file beside it defines the types %s: taken as cars", path, ", ".join(sorted(unknown)[:5]))
    return (Recording(tuple(one for one in tracks if one is not None)),)


def _row(path: Path, name: str, time_s: float, given: dict[str, str]) -> array:
    about = f"object '{name}' at {time_s:g} s"
    needed = [number_of(path, f"{about}: {key}", given.get(key)) for key in ("x", "y", "angle")]
    z, slope, speed = (
        number_of(path, f"{about}: {key}", given[key]) if key in given else math.nan for key in ("z", "slope", "speed")
    )
    return array("d", (time_s, *needed[:2], z, needed[2], slope, speed))


def _track(path: Path, name: str, samples: _Samples, types: _Types, unknown: set[str]) -> Track | None:
    kind = _VCLASSES["pedestrian"]
    if not samples.walks or samples.type_id in types:
        known = _kind_of(samples.type_id, types, unknown)
        if known is None:
            return None
        kind = known
    class_name, *size = kind
    time_s, x, y, z, angle, slope, speed = np.array(samples.rows, np.float64).T
    went = float(np.hypot(np.diff(x), np.diff(y)).sum())
    by_speed = float((np.nan_to_num(speed[1:]) * np.diff(time_s)).sum())
    if by_speed > _FAR_M and went < _SHARE * by_speed:
        expected, hint = f"metres, about {by_speed:.0f} m of way by its speeds", "; write it without --fcd-output.geo"
        raise DataError(complaint(path, f"object '{name}': x, y", expected, f"{went:g}", hint))
    if (np.abs(angle) > 360.0).any():
        raise DataError(complaint(path, f"object '{name}': angle", "degrees within 360", f"{np.abs(angle).max():g}"))
    reach = np.full(len(x), 0.0 if samples.walks else size[0])
    base, yaw, _ = center_from_sumo(np.column_stack([x, y, z]), angle, np.nan_to_num(slope), reach)
    center = base + np.array([0.0, 0.0, 0.5 * size[2]])
    return make_track(path, name, class_name, size, time_s, center, yaw)


def _kind_of(type_id: str, types: _Types, unknown: set[str]) -> _Kind | None:
    """Return the class and the size of a type; None for what is no road user."""
    for known in (type_id, type_id.partition("@")[0]):  # "@" is in SUMO's copies of a type for one vehicle
        if known in types:
            return types[known]
    if type_id in TYPES:
        return (TYPES[type_id].label, *TYPES[type_id].size)
    name = type_id.lower()
    if _NO_ROAD_USER.search(name):
        return None
    words = sorted((word for word in _WORDS if re.search(f"(?<![a-z]){word}|{word}(type)?(?![a-z])", name)), key=len)
    if not words:
        unknown.add(type_id)
    return _VCLASSES[_WORDS[words[-1]]] if words else _CAR


def _types_beside(path: Path) -> _Types:
    """Return class and size of the vehicle types that files in the folder define; a file that is none is logged."""
    types: _Types = {}
    files = sorted(file for pattern in _FILES_OF_TYPES for file in path.parent.glob(pattern))
    for file in files[:_MOST_FILES]:
        try:
            with parsing(file, "file of SUMO"):
                for one in children(read_xml_bytes(file, "file of SUMO"), "vType"):
                    types[one.get("id", "")] = _kind(file, one.attrib)
        except UserError as error:
            _log.warning("%s", error)
    return types


def _kind(path: Path, given: dict[str, str]) -> _Kind | None:
    vclass = given.get("vClass", "passenger")
    if _NO_ROAD_USER.match(vclass):
        return None
    class_name, *usual = _VCLASSES.get(vclass, _CAR)
    if class_name == "pedestrian":
        return (class_name, usual[0], usual[1], usual[2])
    names = ("length", "width", "height")
    about = f"vType '{given.get('id', '')}'"
    length, width, height = (
        number_of(path, f"{about}: {name}", given[name]) if name in given else value
        for name, value in zip(names, usual, strict=True)
    )
    return class_name, length, width, height
