"""Commands that write or read drives: `dsrc generate`, `dsrc corrupt`, `dsrc dataset` and `dsrc realism`."""

import sys
from pathlib import Path
from typing import Annotated

import msgspec
from tyro.conf import Positional, arg

from dsrc.cli.progress import log_lines, made, progress
from dsrc.cli.toml_files import require_kind
from dsrc.options.drives import BuildOptions, Changes, ConvertOptions, CorruptOptions, GenerateOptions
from dsrc.options.fields import CORRUPTIONS, Data, Folder, Output, Splits, choice
from dsrc.runs.executors import Pool

Roots = Annotated[tuple[Path, ...], arg(metavar="DATA [...]")]


class Generate(GenerateOptions, frozen=True):
    """Simulate one drive of a scenario and write it as an OPV2V tree.

    The same seed writes the same bytes; an interrupted drive resumes. `dsrc dataset build` makes many drives.

    Examples:
        dsrc generate braunschweig --out data/train --seed 1
        dsrc generate ima_building --out data/encounters --seed 3 --view
        dsrc generate four_way --out data/fog --at 120,120 --vehicles 2 --lidar vlp-16 --corruption fog

    Attributes:
        view: show the frames in the browser as they come, and go on showing them until interrupted.
        corruption: kind of a corruption that dsrc corrupt then writes in place of the drive: the same bytes, but
            a finished drive is simulated again when it is asked for again; default: none.
        severity: severity of the corruption, 1 to 5; default: 3.
    """

    view: bool = False
    corruption: Annotated[str | None, choice(CORRUPTIONS)] = None
    severity: int | None = None
    output: Output = Output()

    def run(self) -> None:
        """Write the drive and print its folder."""
        from dsrc.data.write import generate
        from sim.errors import SettingsError

        require_kind("generate", str(self.scenario), "scenario")
        log_lines("sensors.compiled", on_terminals=True)
        if self.corruption is not None:
            if self.view:
                raise SettingsError("generate: --view shows the drive before its --corruption; leave out --view")
            self._write_corrupted(self.corruption)
            return
        if self.severity is not None:
            raise SettingsError("generate: --severity is of a corruption; add --corruption")
        if not self.view:
            with progress(f"generate {self.scenario}") as report:
                drive = generate(self, progress=report)
            made(drive, f"a drive of {self.frames} frames", "view", drive)
            return
        from dsrc.review.page.app import LivePage
        from dsrc.review.sources.live import LiveSource

        source = LiveSource(str(self.scenario))
        with LivePage(source) as page:
            sys.stderr.write(f"{page.url}\n")
            with progress(f"generate {self.scenario}") as report:
                drive = generate(self, progress=report, watch=source.put)
            made(drive, f"a drive of {self.frames} frames", "view", drive)
            page.wait()

    def _write_corrupted(self, kind: str) -> None:
        """Simulate the drive in a hidden folder, which is removed once the corrupted one is whole."""
        import shutil

        from dsrc.data.datasets.corrupt import corrupt_dataset
        from dsrc.data.write import generate
        from sensors.corruptions import DEFAULT_SEVERITY, require_corruption

        require_corruption(kind, DEFAULT_SEVERITY if self.severity is None else self.severity, "physical")
        hidden = Path(self.out) / ".clean"
        with progress(f"generate {self.scenario}") as report:
            clean = generate(msgspec.structs.replace(self, out=hidden), progress=report)
        drive = Path(self.out) / clean.name
        with progress(f"corrupt {kind}") as report:
            corrupt_dataset(CorruptOptions(clean, drive, kind, self.severity), progress=report)
        shutil.rmtree(clean)
        if not any(hidden.iterdir()):
            hidden.rmdir()
        made(drive, f"a drive of {self.frames} frames, {kind}", "view", drive)


class Corrupt(CorruptOptions, frozen=True):
    """Write drives, or scans of other data sets, again under weather or with failing sensors.

    The bytes are the same for any number of workers; an interrupted run resumes.

    Examples:
        dsrc corrupt data/test --corruption fog --severity 4 --out data/test_fog
        dsrc corrupt velodyne --corruption snow --sensor hdl-64e-s2 --out velodyne_snow
    """

    pool: Pool = Pool()
    output: Output = Output()

    def run(self) -> None:
        """Write the drives or scans and print their place."""
        from dsrc.data.datasets.corrupt import corrupt_dataset
        from sensors.corruptions import DEFAULT_SEVERITY

        level = self.preset or f"severity {self.severity or DEFAULT_SEVERITY}"
        with progress(f"corrupt {self.corruption}, {level}") as report:
            written = corrupt_dataset(self, pool=self.pool, progress=report)
        kind = "drive" if written[0].is_dir() else "scan"
        what = f"{len(written)} {kind}{'s' if len(written) > 1 else ''}, {self.corruption}"
        made(self.out, what, *(("view", self.out) if self.out.is_dir() else ()))


class Build(BuildOptions, frozen=True):
    """Generate a dataset from a TOML of splits, with checksums and data cards.

    The bytes are the same for any number of workers; an interrupted build resumes.

    Examples:
        dsrc dataset build dsrc-sim --out data/dsrc-sim
        dsrc dataset build dsrc-sim --splits test --out data/dsrc-sim
    """

    pool: Pool = Pool()
    output: Output = Output()

    def run(self) -> None:
        """Write the dataset and print its folder."""
        from dsrc.data.datasets.build import generate_dataset

        require_kind("dataset build", self.dataset, "data set")
        with progress(f"build {self.dataset}") as report:
            folder = generate_dataset(self, pool=self.pool, progress=report)
        made(folder, "a data set with checksums", "dataset", "check", folder)


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """Simulate a dataset's traffic anew and keep logs and worlds in the folder `recorded` of its TOML.

    Examples:
        dsrc dataset record my_splits/splits.toml

    Attributes:
        dataset: shipped dataset, or path of a TOML of splits.
    """

    dataset: Splits
    pool: Pool = Pool()

    def run(self) -> None:
        """Record the traffic and print the folder."""
        from dsrc.data.datasets.build import record_dataset

        require_kind("dataset record", self.dataset, "data set")
        with progress(f"record {self.dataset}") as report:
            folder = record_dataset(self.dataset, self.pool, report)
        made(folder, "traffic logs and worlds", "dataset", "build", self.dataset, "--out", "data")


class Render(msgspec.Struct, frozen=True, kw_only=True):
    """Render drives anew from their traffic logs, or tracks that others recorded: any sensors, agents or mountings.

    An interrupted run resumes.

    Examples:
        dsrc dataset render data/test --lidar vlp-16 --out data/test_vlp
        dsrc dataset render tracks.csv --vehicles 2 --out data/tracks

    Attributes:
        data: a drive, a folder of drives, or a traffic log; or tracks: .csv, .npz, .xosc, SUMO or CommonRoad .xml.
        out: folder of the new drives, which keep their names.
    """

    data: Data
    out: Folder
    changes: Changes = Changes()
    pool: Pool = Pool()
    output: Output = Output()

    def run(self) -> None:
        """Write the drives and print their folders."""
        from dsrc.data.datasets.render import render

        with progress(f"render {self.data}") as report:
            drives = render(self.data, self.out, self.changes, self.pool, report)
        made(drives, f"{len(drives)} drive{'s' if len(drives) > 1 else ''}", "view", self.out)


class Check(msgspec.Struct, frozen=True, kw_only=True):
    """List the faults of a dataset folder, file by file; exit code 2 if there is one.

    Examples:
        dsrc dataset check data/test

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

    Examples:
        dsrc dataset card data/test --out data/test.card

    Attributes:
        data: a drive, or a folder of drives, in any supported format.
        out: folder of the card; default: DATA.card.
    """

    data: Data
    out: Folder | None = None
    pool: Pool = Pool()
    output: Output = Output()

    def run(self) -> None:
        """Write the card and print its folder."""
        from dsrc.data.datasets.card import write_card

        made(write_card(self.data, self.out, self.pool), "a data card", "view", self.data)


class Convert(ConvertOptions, frozen=True):
    """Convert drives to OPV2V, DAIR-V2X-C, KITTI, MCAP or OSI; an interrupted run resumes.

    Examples:
        dsrc dataset convert data/test --to dair --out data/test_dair
        dsrc dataset convert data/test --to kitti --agent-id all --out data/test_kitti
    """

    pool: Pool = Pool()
    output: Output = Output()

    def run(self) -> None:
        """Write the tree and print its folder."""
        from dsrc.data.datasets.convert import convert

        with progress(f"convert to {self.to}") as report:
            convert(self, pool=self.pool, progress=report)
        readable = self.to in ("opv2v", "dair")
        made(self.out, f"the drives as {self.to}", *(("dataset", "check", self.out) if readable else ()))


class Realism(msgspec.Struct, frozen=True, kw_only=True):
    """Tell how far simulated sweeps are from real ones of the same sensor, figure by figure.

    Ground, roadside, vehicles, intensities, ranges, beams and noise; with boxes or without.

    Examples:
        dsrc realism kitti/training --simulated data/hdl64 --out realism

    Attributes:
        real: drives with real sweeps, or folders of them, in any supported format, at least one; default: none.
        simulated: drives with simulated sweeps of the same sensor, or folders of them.
        out: folder of realism.json, realism.csv, realism.md and realism.png.
        frames: frames of each drive, evenly spread; default: all.
        seed: seed of resamples, and of the points whose neighbourhoods are looked at.
    """

    simulated: Roots
    out: Folder
    real: Positional[Roots] = ()
    frames: int | None = None
    seed: int = 0
    pool: Pool = Pool()
    output: Output = Output()

    def run(self) -> None:
        """Measure both, write what was found and print the tables."""
        from rich.console import Console

        from dsrc.realism.gauge import compare, measure, provenance_of, sensors_text
        from dsrc.realism.report import family_table, realism_table, write_realism
        from sim.errors import SettingsError, complaint
        from sim.files import check_apart, check_folder

        for side, roots in (("REAL", self.real), ("--simulated", self.simulated)):
            if not roots:
                raise SettingsError(complaint("realism", side, "at least one folder of drives", "none"))
        for root in (*self.real, *self.simulated):
            check_apart(self.out, root)
        check_folder(self.out)
        with progress("realism, real sweeps") as report:
            real = measure(self.real, self.frames, self.seed, self.pool, report)
        with progress("realism, simulated sweeps") as report:
            simulated = measure(self.simulated, self.frames, self.seed, self.pool, report)
        rows = compare(real, simulated, self.seed)
        made_by = provenance_of(self.real, self.simulated, self.frames, self.seed)
        write_realism(self.out, rows, real, simulated, made_by)
        console = Console(highlight=False)
        console.print(realism_table(rows))
        console.print(family_table(rows))
        if told := sensors_text(real, simulated):
            sys.stderr.write(f"realism: {told}\n")
        made(self.out, "figures and plots of real and simulated sweeps")
