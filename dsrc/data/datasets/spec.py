"""Split file of a dataset: a TOML of splits, each a product of scenarios, seeds, frames, sensors and agent counts.

    name = "crossings"

    [[split.train]]
    scenarios = ["four_way", "ingolstadt"]
    seeds = [0, 1, 2]
    vehicles = [2, 4]        # 2 scenarios x 3 seeds x 2 agent counts = 12 drives

    [[split.test]]
    scenarios = ["braunschweig"]
    seeds = [0]
    frames = [200]

A drive is a work item, keyed by the hash of all settings that decide its bytes.
"""

import hashlib
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from dsrc.data.changes import in_world, parked_along, with_sensors
from dsrc.data.drive_folder import TRAFFIC_LOG
from dsrc.data.write import DriveSpec
from dsrc.options.drives import DriveOptions
from sim.catalog.load import ROOT, load_scenario
from sim.errors import DataError, ScenarioError, SettingsError, complaint
from sim.reading import parsing
from sim.scenario import Scenario
from sim.settings import read_tables, read_toml
from sim.traffic.log import read_log_columns

SPLIT_FILE = "split.toml"

_Count = Annotated[int, Meta(ge=1)]
_Seed = Annotated[int, Meta(ge=0, lt=2**31)]


class DriveGroup(DriveOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Group of drives: one of each combination.

    Attributes:
        scenarios: names of shipped scenarios, or paths of .toml files beside this one.
        seeds: of everything random.
        frames: synchronised frames per drive.
        vehicles: numbers of vehicles with a LiDAR; empty for the scenario's.
        lidars: presets of the vehicles' LiDARs; empty for the scenario's.
        roadside_lidars: presets of the roadside units' LiDARs; empty for the scenario's.
        roadside: keep the roadside units.
        mount: x y z in the body frame, m, and pitch, deg, of the vehicles' LiDARs; unset: the scenario's.
        world: version of the scenarios' world, see `sim.scenario.Scenario`; unset: theirs.
        parked_per_km: parked cars and vans per km of kerb with room, none in encounters; unset: the scenarios'.
    """

    scenarios: Annotated[tuple[str, ...], Meta(min_length=1)]
    seeds: Annotated[tuple[_Seed, ...], Meta(min_length=1)]
    frames: Annotated[tuple[_Count, ...], Meta(min_length=1)] = (100,)
    vehicles: tuple[Annotated[int, Meta(ge=0)], ...] = ()
    lidars: tuple[str, ...] = ()
    roadside_lidars: tuple[str, ...] = ()
    roadside: bool = True
    mount: tuple[float, float, float, float] | None = None
    world: Literal[1, 2] | None = None
    parked_per_km: Annotated[float, Meta(ge=0)] | None = None


class DatasetSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Content of a split file.

    Attributes:
        name: of the dataset.
        description: one line.
        recorded: folder beside the file with SPLIT/DRIVE/traffic.npz and world.npz, from which drives are rendered
            instead of simulated; "" for none.
        split: groups of drives by split.
    """

    name: Annotated[str, Meta(pattern="^[A-Za-z0-9_-]+$")]
    description: str = ""
    recorded: str = ""
    split: Annotated[dict[Annotated[str, Meta(pattern="^[A-Za-z0-9_-]+$")], tuple[DriveGroup, ...]], Meta(min_length=1)]


@dataclass(frozen=True, slots=True)
class DriveItem:
    """Drive of a dataset.

    Attributes:
        split: its split.
        name: its folder below the split.
        spec: its specification.
        recorded: folder of its traffic log, None for a simulated drive.
        proof: of a recorded encounter, see `sensors.recording.encounter_check`.
    """

    split: str
    name: str
    spec: DriveSpec
    recorded: Path | None = None
    proof: dict | None = None

    @property
    def path(self) -> str:
        """SPLIT/DRIVE."""
        return f"{self.split}/{self.name}"

    @property
    def key(self) -> str:
        """Hash of the settings: equal keys, equal bytes."""
        text = msgspec.json.encode(self.spec.settings(), order="sorted")
        return hashlib.sha256(text).hexdigest()


MOST_DRIVES = 100_000
"""Most drives of a group."""


def find_split_file(name_or_path: str | Path) -> Path | None:
    """Return the split file of a shipped dataset or of a path; None for anything else, such as a scenario."""
    path = Path(name_or_path)
    for candidate in (path / SPLIT_FILE, ROOT / str(name_or_path) / SPLIT_FILE):
        if len(path.parts) and candidate.is_file():
            return candidate
    if path.suffix != ".toml" or not path.is_file():
        return None
    try:
        fields = read_tables(path, DataError).keys()
    except DataError:
        return None
    # A file without splits is a scenario only where it defines its traffic.
    return path if "split" in fields or not fields & {"network", "demand", "conflict"} else None


def list_datasets() -> dict[str, str]:
    """Return the descriptions of the shipped datasets by name."""
    return {path.parent.name: read_dataset(path).description for path in sorted(ROOT.glob(f"*/{SPLIT_FILE}"))}


def read_dataset(path: Path) -> DatasetSpec:
    """Read a split file.

    Raises:
        SettingsError: the file is invalid; the message names the field.
    """
    return read_toml(path, DatasetSpec, SettingsError)


def expand(dataset: DatasetSpec, path: Path) -> list[DriveItem]:
    """Return the drives of a dataset, in the order of its file.

    Args:
        path: of the file, for files beside it and for messages.

    Raises:
        SettingsError: a setting is out of its range, two drives have one name, or two splits share a scenario's seed.
        ScenarioError: a scenario or a LiDAR is unknown.
        DataError: a recorded log is damaged.
    """
    items: dict[str, DriveItem] = {}
    taken: dict[tuple[str, int], str] = {}
    groups = [(split, row, group) for split, listed in dataset.split.items() for row, group in enumerate(listed)]
    with parsing(path, "dataset", SettingsError):
        for split, row, group in groups:
            where = f"{path}: split.{split}[{row}]"
            for item in _drives(dataset, split, group, path, where):
                if item.path in items:
                    hint = "; give it another seed, or list what differs in one group"
                    raise SettingsError(complaint(where, "seeds", "drives of different names", item.name, hint))
                other = taken.setdefault((item.spec.scenario.name, item.spec.seed), split)
                if other != split:
                    found = f"{item.spec.scenario.name} with seed {item.spec.seed}, which {other} has too"
                    raise SettingsError(complaint(where, "seeds", f"seeds that only {split} has", found))
                items[item.path] = item
    return list(items.values())


def _drives(dataset: DatasetSpec, split: str, group: DriveGroup, path: Path, where: str) -> Iterator[DriveItem]:
    vehicles: Sequence[int | None] = group.vehicles or (None,)
    lidars: Sequence[str | None] = group.lidars or (None,)
    roadside: Sequence[str | None] = group.roadside_lidars or (None,)
    count = math.prod(map(len, (group.scenarios, group.seeds, group.frames, vehicles, lidars, roadside)))
    if count > MOST_DRIVES:
        raise SettingsError(complaint(where, "drives", f"at most {MOST_DRIVES} in a group", count))
    combinations = itertools.product(group.scenarios, group.seeds, group.frames, vehicles, lidars, roadside)
    for name, seed, frames, number, lidar, roadside_lidar in combinations:
        axes = group.frames, vehicles, lidars, roadside
        words = f"{frames}f", f"{number}v", lidar, roadside_lidar
        marks = [word for axis, word in zip(axes, words, strict=True) if len(axis) > 1]
        stem = Path(name).parent.name if name.endswith("scenario.toml") else Path(name).stem
        drive = "_".join([stem, str(seed), *map(str, marks)])
        folder = path.parent / dataset.recorded / split / drive
        recorded = folder if dataset.recorded and (folder / TRAFFIC_LOG).is_file() else None
        if recorded is None:
            beside = path.parent / name
            try:
                scenario, proof = load_scenario(beside if beside.is_file() else name), None
            except ScenarioError as error:
                raise ScenarioError(f"{where}: scenarios: {error}") from None
        else:
            scenario, about = log_settings(recorded / TRAFFIC_LOG)
            proof = about.get("proof")
            if in_world(scenario, group.world).uneven != scenario.uneven:
                expected = f"{2 if scenario.uneven else 1}, on whose ground {recorded} was recorded"
                raise SettingsError(complaint(where, "world", expected, group.world))
            if parked_along(scenario, group.parked_per_km) != scenario:
                expected = f"{scenario.demand.parked_per_km:g}, as {recorded} was recorded"
                raise SettingsError(complaint(where, "parked_per_km", expected, group.parked_per_km))
        if number is not None and scenario.conflict is not None and recorded is None:
            raise SettingsError(complaint(where, "vehicles", f"none, as {name} names who carries a LiDAR", number))
        scenario = with_sensors(scenario, number, lidar, roadside_lidar, group.roadside, group.mount)
        scenario = parked_along(in_world(scenario, group.world), group.parked_per_km)
        spec = DriveSpec(scenario, seed, frames, **group.shared())
        spec.check(where)
        yield DriveItem(split, drive, spec, recorded, proof)


def log_settings(path: Path) -> tuple[Scenario, dict]:
    """Return the scenario of a traffic log and its other settings.

    Raises:
        DataError: the log is damaged or lacks its scenario.
    """
    about = msgspec.json.decode(str(read_log_columns(path)["about"]))
    with parsing(path, "traffic log"):
        try:
            scenario = msgspec.convert(about.pop("scenario", None), Scenario)
        except msgspec.ValidationError as error:
            raise DataError(
                f"{path}: about.scenario: not one of this version: {error}; record the drive again"
            ) from None
        for name, kind in {"seed": int, "frames": int, "interval_s": (int, float)}.items():
            if not isinstance(about.get(name), kind) or isinstance(about[name], bool):  # type: ignore[arg-type]
                raise DataError(complaint(path, f"about.{name}", "a number", about.get(name, "nothing")))
        return scenario, about
