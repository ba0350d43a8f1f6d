"""Commands `dsrc scenario`: the shipped scenarios, and new ones from maps."""

import sys
from pathlib import Path

import msgspec
from tyro.conf import Positional

from dsrc.cli.list import print_names
from dsrc.options.fields import File, Folder, Scenario


class List(msgspec.Struct, frozen=True):
    """List the scenarios and data sets; `dsrc list scenarios` is the same.

    Examples:
        dsrc scenario list
    """

    def run(self) -> None:
        """Print one line for each."""
        print_names("scenarios")


class Show(msgspec.Struct, frozen=True):
    """Print a scenario's settings as JSON, defaults and the attributions of its sources included.

    Examples:
        dsrc scenario show four_way

    Attributes:
        scenario: shipped scenario, or path of a scenario.toml.
    """

    scenario: Scenario

    def run(self) -> None:
        """Load, check and print it."""
        from dsrc.data.datasets.spec import find_split_file
        from sensors.presets import scenario_lidars
        from sim.catalog.attribution import attributions
        from sim.catalog.load import load_scenario
        from sim.errors import SettingsError, complaint

        if find_split_file(str(self.scenario)) is not None:
            hint = f"; run: dsrc dataset build {self.scenario}"
            raise SettingsError(complaint("scenario show", "scenario", "a scenario", "a dataset", hint))
        scenario = load_scenario(self.scenario)
        scenario_lidars(scenario)  # unknown sensors are refused here as in `dsrc generate`
        scenario = msgspec.structs.replace(scenario, attribution="; ".join(attributions(scenario)))
        sys.stdout.write(f"{msgspec.json.format(msgspec.json.encode(scenario).decode(), indent=2)}\n")


class Import(msgspec.Struct, frozen=True):
    """Make a scenario of a SUMO network, an OpenStreetMap extract or an OpenDRIVE file.

    The roads, and from OpenStreetMap the houses, trees, lamps, hedges, fences and walls, become a folder that
    `dsrc generate` takes.

    Examples:
        dsrc scenario import my_town.osm.pbf
        dsrc scenario import crossing.xodr --name crossing --out scenarios/crossing

    Attributes:
        map: .net.xml, .net.xml.gz, .osm, .osm.gz, .osm.bz2, .osm.pbf or .xodr.
        name: name of the scenario; default: the file's.
        out: new folder; default: the scenario's name, here.
    """

    map: Positional[File]
    name: str = ""
    out: Folder | None = None

    def run(self) -> None:
        """Convert the map and print the new folder."""
        from sim.catalog.import_map import import_map

        folder = import_map(Path(self.map), self.name, self.out)
        sys.stdout.write(f"{folder}\ndsrc generate {folder} --out data\n")
