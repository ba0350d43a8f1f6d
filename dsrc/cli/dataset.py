"""Commands that write or read drives: `dsrc generate`, `dsrc corrupt` and `dsrc dataset`."""

import sys
from typing import Annotated, Literal

import msgspec
from tyro.conf import Positional, arg

from dsrc.cli.options import CORRUPTIONS, Data, Folder, Scenario, Severity, choice
from dsrc.cli.progress import progress
from dsrc.data.datasets.changes import Changes
from dsrc.data.executors import Pool

Splits = Positional[Annotated[str, arg(metavar="SPLITS")]]


class Generate(msgspec.Struct, frozen=True, kw_only=True):
    """Simulate one drive of a scenario and write it as an OPV2V tree.

    The same seed writes the same bytes; an interrupted drive resumes. `dsrc dataset build` makes many drives.

    Attributes:
        scenario: shipped scenario, or path of a scenario.toml.
        out: parent folder; the drive becomes FOLDER/SCENARIO_SEED.
        frames: synchronised frames.
        seed: seed of everything random; default: the scenario's.
        interval_s: time between frames, a multiple of the LiDAR's 0.1 s, s.
        motion: instant of a sweep to which its points are motion-compensated; raw: not at all.
        connected_vehicles: list the other agents among an agent's vehicles; OPV2V leaves them out.
        visibility: measure the visible share of every object, for a fifth of the time.
    """

    scenario: Scenario
    out: Folder
    frames: int = 100
    seed: int | None = None
    interval_s: float = 0.1
    motion: Literal["middle", "start", "end", "raw"] = "middle"
    connected_vehicles: bool = True
    visibility: bool = True

    def run(self) -> None:
        """Write the drive and print its folder."""
        from dsrc.data.datasets.spec import find_split_file
        from dsrc.data.write import generate
        from sim.catalog.load import load_scenario
        from sim.errors import SettingsError, complaint

        if find_split_file(self.scenario) is not None:
            hint = f"; run: dsrc dataset build {self.scenario}"
            raise SettingsError(complaint("generate", "scenario", "a scenario", "a dataset", hint))
        options = msgspec.structs.asdict(self) | {"scenario": load_scenario(self.scenario)}
        with progress(f"generate {self.scenario}") as report:
            drive = generate(**options, progress=report)
        sys.stdout.write(f"{drive}\n")


class Corrupt(msgspec.Struct, frozen=True, kw_only=True):
    """Write drives again under weather or with failing sensors.

    The bytes are the same for any number of workers; an interrupted run resumes.

    Attributes:
        data: a drive, or a folder of drives.
        corruption: kind of the corruption.
        out: folder of the corrupted drives, which keep their names.
        seed: seed of the corruption; every drive draws its own weather and faults from it.
    """

    data: Data
    corruption: Annotated[str, choice(CORRUPTIONS)]
    level: Severity = Severity()
    out: Folder
    seed: int = 0
    pool: Pool = Pool()

    def run(self) -> None:
        """Write the drives and print their folder."""
        from dsrc.data.datasets.corrupt import corrupt_dataset

        with progress(f"corrupt {self.corruption}, severity {self.level.severity}") as report:
            corrupt_dataset(
                self.data,
                self.out,
                self.corruption,
                self.level.severity,
                self.level.family,
                seed=self.seed,
                pool=self.pool,
                progress=report,
            )
        sys.stdout.write(f"{self.out}\n")


class Build(msgspec.Struct, frozen=True, kw_only=True):
    """Generate a dataset from a TOML of splits, with checksums and data cards.

    The bytes are the same for any number of workers; an interrupted build resumes.

    Attributes:
        dataset: shipped dataset, or path of a TOML of splits.
        out: folder of the dataset; drives are FOLDER/SPLIT/DRIVE.
        splits: splits to build; default: all.
        cards: write a data card beside each split.
    """

    dataset: Splits
    out: Folder
    splits: tuple[str, ...] = ()
    cards: bool = True
    pool: Pool = Pool()

    def run(self) -> None:
        """Write the dataset and print its folder."""
        from dsrc.data.datasets.build import generate_dataset

        with progress(f"build {self.dataset}") as report:
            folder = generate_dataset(self.dataset, self.out, self.splits, self.pool, self.cards, report)
        sys.stdout.write(f"{folder}\n")


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """Simulate a dataset's traffic anew and keep logs and worlds in the folder `recorded` of its TOML.

    Attributes:
        dataset: shipped dataset, or path of a TOML of splits.
    """

    dataset: Splits
    pool: Pool = Pool()

    def run(self) -> None:
        """Record the traffic and print the folder."""
        from dsrc.data.datasets.build import record_dataset

        with progress(f"record {self.dataset}") as report:
            folder = record_dataset(self.dataset, self.pool, report)
        sys.stdout.write(f"{folder}\n")


class Render(msgspec.Struct, frozen=True, kw_only=True):
    """Render drives anew from their traffic logs: other sensors, agents or mountings, without SUMO.

    An interrupted run resumes.

    Attributes:
        data: a drive, a folder of drives, or a traffic log.
        out: folder of the new drives, which keep their names.
    """

    data: Data
    out: Folder
    changes: Changes = Changes()
    pool: Pool = Pool()

    def run(self) -> None:
        """Write the drives and print their folders."""
        from dsrc.data.datasets.render import render

        with progress(f"render {self.data}") as report:
            made = render(self.data, self.out, self.changes, self.pool, report)
        sys.stdout.writelines(f"{drive}\n" for drive in made)


class Check(msgspec.Struct, frozen=True, kw_only=True):
    """List the faults of a dataset folder, file by file; exit code 2 if there is one.

    Attributes:
        data: a drive, or a folder of drives or splits, in any supported format.
    """

    data: Data
    pool: Pool = Pool()

    def run(self) -> None:
        """Read every file and print the faults."""
        from dsrc.data.datasets.check import check_dataset
        from sim.errors import DataError

        with progress(f"check {self.data}") as report:
            faults = check_dataset(self.data, self.pool, report)
        sys.stdout.writelines(f"{fault}\n" for fault in faults)
        if faults:
            raise DataError(f"{self.data}: {len(faults)} fault{'s' if len(faults) > 1 else ''} found")
        sys.stdout.write(f"{self.data}: no faults\n")


class Card(msgspec.Struct, frozen=True, kw_only=True):
    """Write a data card: counts, histograms and pictures of a split.

    Attributes:
        data: a drive, or a folder of drives, in any supported format.
        out: folder of the card; default: DATA.card.
    """

    data: Data
    out: Folder | None = None
    pool: Pool = Pool()

    def run(self) -> None:
        """Write the card and print its folder."""
        from dsrc.data.datasets.card import write_card

        sys.stdout.write(f"{write_card(self.data, self.out, self.pool)}\n")


class Convert(msgspec.Struct, frozen=True, kw_only=True):
    """Convert drives to OPV2V, DAIR-V2X-C, KITTI or MCAP; an interrupted run resumes.

    Attributes:
        data: a drive, or a folder of drives, in any supported format; a split of a DAIR-V2X-C tree is TREE/val.
        to: new format; mcap, for Foxglove, needs the package mcap.
        out: folder of the new tree.
        agent_id: agent whose sweeps are written to KITTI and DAIR: ego, all (KITTI) or an id; default: ego.
        view: labels of KITTI: those in the picture of a nominal camera, or all around.
    """

    data: Data
    to: Literal["opv2v", "dair", "kitti", "mcap"]
    out: Folder
    agent_id: Annotated[str | None, arg(metavar="{ego,all,INT}")] = None
    view: Literal["camera", "around"] = "camera"
    pool: Pool = Pool()

    def run(self) -> None:
        """Write the tree and print its folder."""
        from dsrc.data.datasets.convert import convert

        with progress(f"convert to {self.to}") as report:
            convert(self.data, self.out, self.to, agent=self.agent_id, view=self.view, pool=self.pool, progress=report)
        sys.stdout.write(f"{self.out}\n")
