"""Command `dsrc realism`: how far simulated sweeps are from real ones."""

from pathlib import Path
from typing import Annotated

import msgspec
from tyro.conf import Positional, arg

from dsrc.cli.progress import made, progress
from dsrc.options.fields import Folder, Output
from dsrc.runs.executors import Pool

Roots = Annotated[tuple[Path, ...], arg(metavar="DATA [...]")]


class Realism(msgspec.Struct, frozen=True, kw_only=True):
    """Tell how far simulated sweeps are from real ones of the same sensor, figure by figure.

    Ground, roadside, vehicles, intensities, ranges, beams and noise; with boxes or without.

    Examples:
        dsrc realism kitti/training --simulated data/hdl64 --out realism

    Attributes:
        real: drives with real sweeps, or folders of them, in any supported format.
        simulated: drives with simulated sweeps of the same sensor, or folders of them.
        out: folder of realism.json, realism.csv, realism.md and realism.png.
        frames: frames of each drive, evenly spread; default: all.
        seed: seed of resamples, and of the points whose neighbourhoods are looked at.
    """

    real: Positional[Roots]
    simulated: Roots
    out: Folder
    frames: int | None = None
    seed: int = 0
    pool: Pool = Pool()
    output: Output = Output()

    def run(self) -> None:
        """Measure both, write what was found and print the tables."""
        from rich.console import Console

        from dsrc.realism.gauge import compare, measure, provenance_of
        from dsrc.realism.report import family_table, realism_table, write_realism
        from sim.files import check_apart

        for root in (*self.real, *self.simulated):
            check_apart(self.out, root)
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
        made(self.out, "figures and plots of real and simulated sweeps")
