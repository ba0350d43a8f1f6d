"""Catalogs of OpenSCENARIO: references replaced by the entries that they name.

Source: ASAM OpenSCENARIO XML 1.0 to 1.3, "Catalogs": a file of a directory in `CatalogLocations` holds the catalog of a
name; parameters of an entry have values of their own, which a reference may assign.
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path

from sim.errors import DataError, complaint
from sim.traffic.tracks.xml_file import read_xml_bytes

_DEEPEST = 4
"""Most references inside one another: a maneuver with a trajectory has two."""
_MOST = 2000
"""Most references of one depth."""
_READ = ("ScenarioObject", "ManeuverGroup", "FollowTrajectoryAction", "TrajectoryRef")
"""Elements whose references decide what road users are and how they move; those to controllers and the like do not."""


def expand_catalogs(path: Path, root: ET.Element) -> None:
    """Replace the references to vehicles, pedestrians, maneuvers and trajectories by their entries.

    Raises:
        DataError: a catalog or an entry is not there, or entries refer to one another without end; names it.
    """
    folders = [path.parent / folder.get("path", "") for folder in root.iterfind("CatalogLocations/*/Directory[@path]")]
    catalogs: dict[str, ET.Element] = {}
    for _ in range(_DEEPEST + 1):
        found = [
            (parent, row)
            for parent in root.iter()
            if parent.tag in _READ
            for row, child in enumerate(parent)
            if child.tag == "CatalogReference"
        ]
        if not found:
            return
        if len(found) > _MOST:
            raise DataError(complaint(path, "CatalogReference", f"at most {_MOST}", len(found)))
        for parent, row in found:
            parent[row] = _entry(path, folders, catalogs, parent[row])
    raise DataError(complaint(path, "CatalogReference", f"at most {_DEEPEST} inside one another", "more"))


def _entry(path: Path, folders: list[Path], catalogs: dict[str, ET.Element], reference: ET.Element) -> ET.Element:
    """Return a copy of the entry that a reference names, with its parameters' values."""
    name, entry_name = reference.get("catalogName", ""), reference.get("entryName", "")
    field = f"CatalogReference {name}: {entry_name}"
    if name not in catalogs:
        named = (one for one in _catalogs(folders, name) if one.get("name") == name)
        catalog = next(named, None)
        if catalog is None:
            places = ", ".join(str(folder) for folder in folders) or "no CatalogLocations"
            raise DataError(complaint(path, field, "a file with this catalog", f"none in {places}"))
        catalogs[name] = catalog
    found = next((one for one in catalogs[name] if one.get("name") == entry_name), None)
    if found is None:
        raise DataError(complaint(path, field, "an entry of this name", "none"))
    entry = deepcopy(found)
    values = {
        f"${one.get('name')}": one.get("value", "")
        for one in entry.iterfind("ParameterDeclarations/ParameterDeclaration")
    }
    for given in reference.iterfind("ParameterAssignments/ParameterAssignment"):
        values[f"${given.get('parameterRef', '').removeprefix('$')}"] = given.get("value", "")
    for element in entry.iter():
        for key, text in element.items():
            element.set(key, values.get(text, text))
    return entry


def _catalogs(folders: list[Path], name: str) -> Iterator[ET.Element]:
    """Yield the catalogs in folders, first those of files that have the catalog's name."""
    for folder in folders:
        files = [folder] if folder.is_file() else sorted(folder.glob("*.xosc"))
        for file in sorted(files, key=lambda one: one.stem != name):
            try:
                catalog = ET.fromstring(read_xml_bytes(file, "OpenSCENARIO catalog")).find("Catalog")
            except ET.ParseError as error:
                raise DataError(complaint(file, "OpenSCENARIO catalog", "XML", str(error))) from None
            if catalog is not None:
                yield catalog
