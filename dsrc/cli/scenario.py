"""Commands `dsrc list` and `dsrc scenario`: names that options take, scenarios, and new ones from maps."""

import re
import shutil
import sys
from collections.abc import Callable, Sequence
from inspect import getdoc
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from tyro.conf import Positional

from dsrc.cli.progress import log_lines, made, progress
from dsrc.cli.toml_files import require_kind
from dsrc.options.fields import File, Folder, Output, Scenario, choice
from dsrc.runs.executors import Pool
from dsrc.tables.table import Table

NAMED = ("lidars", "corruptions", "scenarios", "methods", "recipes", "channels")


class ListNames(msgspec.Struct, frozen=True):
    """List the LiDARs, corruptions, scenarios, methods, recipes or channels that options take by name.

    Examples:
        dsrc list lidars
        dsrc list corruptions

    Attributes:
        what: what to list.
    """

    what: Positional[Annotated[str, choice(NAMED)]]

    def run(self) -> None:
        """Print a line for each."""
        print_names(self.what)


def print_names(what: str) -> None:
    """Print the table of what has a name.

    Raises:
        SettingsError: nothing of that word has names.
    """
    from sim.errors import SettingsError, complaint, did_you_mean

    if what not in _TABLES:
        raise SettingsError(complaint("list", "what", "something with names", what, did_you_mean(what, NAMED)))
    # A reader that is no terminal gets a line for each.
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else 1000
    sys.stdout.write(f"{_TABLES[what]().text(width)}\n")


_SHAPES = re.compile(r",? \(N.*? to \(.*?\)")
"""Shapes of tensors in a docstring."""


def _lidars() -> Table:
    from sensors.presets import LIDARS

    rows = ((name, len(one.elevation_deg), one.columns, one.rate_hz, one.range_max_m) for name, one in LIDARS.items())
    return Table.of(("lidar", "beams", "columns", "Hz", "range m"), rows)


def _corruptions() -> Table:
    from sensors.corruptions import CORRUPTIONS, FAMILIES
    from sensors.corruptions.registry import Corruption

    def families(one: Corruption) -> str:
        return ", ".join(family for family in FAMILIES if family == "physical" or one.paper_settings is not None)

    rows = ((kind, families(one), _module_line(one.apply or one.in_frame)) for kind, one in CORRUPTIONS.items())
    return Table.of(("corruption", "families", "what it does"), rows, 3)


def _scenarios() -> Table:
    from dsrc.data.datasets.spec import list_datasets
    from sim.catalog.load import list_scenarios, load_scenario

    known = [load_scenario(name) for name in list_scenarios()]
    rows = [("encounter" if one.conflict else "place", one.name, one.description) for one in known]
    rows.sort(key=lambda row: row[0], reverse=True)  # places first
    rows += [("data set", *one) for one in list_datasets().items()]
    return Table.of(("", "scenario", "what it is"), rows, 3)


def _methods() -> Table:
    from dsrc.models.fusion import FUSIONS
    from dsrc.training.recipes import METHODS

    def row(name: str) -> Sequence[object]:
        fusion = str(METHODS[name]["fusion"])
        said = _SHAPES.sub("", _first_line(FUSIONS[fusion]))
        return name, fusion, "" if METHODS[name].get("sdd") is False else "SDD+PCP+REC", said

    return Table.of(("method", "fusion", "designs", "fusion of the agents"), map(row, METHODS), 4)


def _recipes() -> Table:
    from dsrc.training.recipes import RECIPES

    def row(name: str) -> Sequence[object]:
        recipe = RECIPES[name]()
        x0, y0, _, x1, y1, _ = recipe.model.grid.range_m
        return name, _first_line(RECIPES[name]), recipe.epochs, recipe.batch_size, f"{x1 - x0:g} x {y1 - y0:g}"

    return Table.of(("recipe", "what it is", "epochs", "batch", "area m"), map(row, RECIPES), 2)


def _channels() -> Table:
    from sim.radio import PRESETS

    rows = ((name, one.medium, one.range_m, one.rate_mbps, one.delay_s) for name, one in PRESETS.items())
    return Table.of(("channel", "medium", "range m", "Mb/s", "delay s"), rows, 2)


_TABLES: dict[str, Callable[[], Table]] = {
    "lidars": _lidars,
    "corruptions": _corruptions,
    "scenarios": _scenarios,
    "methods": _methods,
    "recipes": _recipes,
    "channels": _channels,
}


def _first_line(thing: Any) -> str:
    return (
        (getdoc(thing) or "")
        .partition("\n")[0]
        .removeprefix("Return the recipe ")
        .removeprefix("of ")
        .removesuffix(".")
    )


def _module_line(function: Any) -> str:
    """Return the first line of the module of a function, without the name before its colon."""
    line = _first_line(sys.modules[function.__module__])
    return line.partition(": ")[2] or line


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
        from sensors.presets import scenario_lidars
        from sim.catalog.attribution import attributions
        from sim.catalog.load import load_scenario

        require_kind("scenario show", self.scenario, "scenario")
        scenario = load_scenario(self.scenario)
        scenario_lidars(scenario)  # unknown sensors are refused here as in `dsrc generate`
        scenario = msgspec.structs.replace(scenario, attribution="; ".join(attributions(scenario)))
        sys.stdout.write(f"{msgspec.json.format(msgspec.json.encode(scenario).decode(), indent=2)}\n")


class Check(msgspec.Struct, frozen=True, kw_only=True):
    """Check that a scenario can be driven and recorded, and prove its encounter by rays.

    The last columns: how fast the ego comes, from which speed it stops in time for what it sees itself, and what that
    costs; without a speed where the gap decides.

    Examples:
        dsrc scenario check my_town
        dsrc scenario check behind_lorries.toml --seed 0 1 2

    Attributes:
        scenario: shipped scenario, or path of a scenario.toml.
        seed: seeds of everything random; default: the scenario's.
    """

    scenario: Positional[Scenario]
    seed: tuple[int, ...] = ()

    def run(self) -> None:
        """Print a line for each seed."""
        from sensors.recording.encounter_check import find_encounter
        from sensors.recording.safe_speed import safe_speed
        from sensors.recording.scenario_check import check_scenario
        from sim.catalog.load import load_scenario

        require_kind("scenario check", self.scenario, "scenario")
        scenario, rows = load_scenario(self.scenario), list[Sequence[object]]()
        head: tuple[str, ...] = ("scenario", "seed", "can be driven and recorded")
        for seed in self.seed or (scenario.seed,):
            check_scenario(self.scenario, seed)
            if scenario.conflict is None:
                rows.append((scenario.name, seed, "yes"))
                continue
            found = find_encounter(scenario, seed)
            one = found.proof
            refused = ", ".join(f"{count} {reason}" for reason, count in found.rejected.items())
            sees = [one.critical_ttc_s, one.ego_ttc_s, one.helper_ttc_s]
            safe = safe_speed(found.scenario, seed)
            speeds = ("", "", "") if safe is None else (safe.comes_mps, safe.safe_mps, safe.costs_s)
            rows.append(
                (scenario.name, seed, *("never" if s is None else s for s in sees), one.helper, refused, *speeds)
            )
        if scenario.conflict is not None:
            times = ("critical s", "ego sees s", "helper sees s", "helper", "refused draws")
            head = ("scenario", "seed", *times, "comes m/s", "safe m/s", "costs s")
        sys.stdout.write(f"{Table.of(head, rows).text(shutil.get_terminal_size().columns)}\n")


class Import(msgspec.Struct, frozen=True):
    """Make a scenario of a SUMO network, an OpenStreetMap extract or an OpenDRIVE file.

    The roads, and the map's houses, trees, lamps, hedges, fences and walls, become a folder that `dsrc generate` takes.
    Area, demand and agents are chosen such that seeds 1 to 10 give a drive.

    Examples:
        dsrc scenario import my_town.osm.pbf
        dsrc scenario import crossing.xodr --name crossing --out scenarios/crossing
        dsrc scenario import hanoi.osm.pbf --mix car=2,motorcycle=7,bus=0.5,bicycle=0.5

    Attributes:
        map: .net.xml, .net.xml.gz, .osm, .osm.gz, .osm.bz2, .osm.pbf, .json (Overpass) or .xodr.
        name: name of the scenario; default: the file's.
        out: new folder; default: the scenario's name, here.
        traffic_side: side on which traffic keeps; auto: as the map or its country has it.
        mix: weights of classes of road users, CLASS=WEIGHT with commas; default: of a European town.
    """

    map: Positional[File]
    name: str = ""
    out: Folder | None = None
    traffic_side: Literal["auto", "left", "right"] = "auto"
    mix: str = ""

    def run(self) -> None:
        """Convert the map and print the new folder."""
        from sim.catalog.import_map import import_map

        log_lines("sim.catalog.import_map", on_terminals=True)
        folder = import_map(Path(self.map), self.name, self.out, traffic_side=self.traffic_side, mix=self.mix)
        made(folder, "a scenario", "generate", folder, "--out", "data")


class Mine(msgspec.Struct, frozen=True, kw_only=True):
    """Make encounters of a map: conflicts whose road user is hidden from the ego and seen by a helper, proven by rays.

    Examples:
        dsrc scenario mine helsinki --out mined --count 20
        dsrc scenario mine my_town --out mined

    Attributes:
        scenario: shipped scenario, or path of a scenario.toml; all of its map is searched.
        out: folder of a folder for each encounter, which `drive` takes as a whole; an interrupted run resumes.
        count: encounters, fewer where the map has no more.
        seed: seed for which they are proven, and of the order of places.
    """

    scenario: Positional[Scenario]
    out: Folder
    count: int = 20
    seed: int = 0
    pool: Pool = Pool()
    output: Output = Output()

    def run(self) -> None:
        """Search the map and print what was found and what was refused."""
        from collections import Counter

        from dsrc.data.mine import mine
        from sensors.recording.mining import PROVEN
        from sim.catalog.load import load_scenario
        from sim.errors import SettingsError

        require_kind("scenario mine", self.scenario, "scenario")
        if not self.scenario.endswith(".toml") and Path(self.scenario).is_file():
            raise SettingsError(f"scenario mine: {self.scenario} is a map; run: dsrc scenario import {self.scenario}")
        with progress("places") as report:
            found = mine(load_scenario(self.scenario), Path(self.out), self.count, self.seed, self.pool, report)
        kept = [one for one in found if one.verdict == PROVEN][: self.count]
        rows = [(one.kind, one.hidden_by, one.place, one.hidden_s, one.helper, one.verdict) for one in kept]
        refused = Counter((one.kind, one.hidden_by, one.verdict) for one in found if one.verdict != PROVEN)
        width = shutil.get_terminal_size().columns
        head = ("kind", "hidden by", "place", "hidden s", "seen by", "verdict")
        sys.stderr.write(f"{Table.of(head, rows).text(width)}\n")
        reasons = ((*key, number) for key, number in sorted(refused.items()))
        sys.stderr.write(f"{Table.of(('refused', 'hidden by', 'why', 'candidates'), reasons, 3).text(width)}\n")
        names = [one.scenario.name for one in kept if one.scenario is not None]
        what = f"{len(names)} encounter{'' if len(names) == 1 else 's'}"
        made([Path(self.out) / name for name in names], what, "drive", self.out)


class Export(msgspec.Struct, frozen=True, kw_only=True):
    """Write one seed of a scenario for other simulators: OpenSCENARIO 1.1, with OpenDRIVE beside it.

    All road users follow their trajectories, with times. Of an encounter it is the draw that `dsrc generate` takes.

    Examples:
        dsrc scenario export lta_truck --seed 0 --out esmini

    Attributes:
        scenario: shipped scenario, or path of a scenario.toml.
        seed: seed of everything random; default: the scenario's.
        out: folder of NAME_SEED.xosc and NAME_SEED.xodr.
    """

    scenario: Positional[Scenario]
    out: Folder
    seed: int | None = None
    output: Output = Output()

    def run(self) -> None:
        """Simulate the traffic and print the files."""
        from sensors.recording.encounter_check import with_proven_encounter
        from sim.catalog.load import load_scenario
        from sim.exchange.export import export

        require_kind("scenario export", self.scenario, "scenario")
        scenario = load_scenario(self.scenario)
        seed = scenario.seed if self.seed is None else self.seed
        if scenario.conflict is not None:
            scenario = with_proven_encounter(scenario, seed)
        made(export(scenario, seed, Path(self.out)), "a scenario of OpenSCENARIO and its roads")
