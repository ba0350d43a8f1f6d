"""Command `dsrc model fit`: error model of a perception from what it has found in recordings."""

import sys
from pathlib import Path
from typing import Annotated

import msgspec
from tyro.conf import Positional, arg

from dsrc.cli.progress import progress
from dsrc.options.fields import File, Output


class Fit(msgspec.Struct, frozen=True, kw_only=True):
    """Fit the errors of a perception to its recordings; dsrc drive --perception MODEL.json drives with them.

    Misses, ghosts and box errors by range, sight, corruption and channel, with persistence in time.

    Attributes:
        data: log of an episode, folder of logs or of a campaign; or results of dsrc evaluate or dsrc benchmark.
        out: JSON of the model.
        perception: perception of the episodes, or method of the results; default: the only one.
        seed: seeds of the episodes that are used; default: all.
    """

    data: Positional[Annotated[Path, arg(metavar="RECORDINGS")]]
    out: File
    perception: str | None = None
    seed: tuple[int, ...] = ()
    output: Output = Output()

    def run(self) -> None:
        """Fit, write the model and print its path."""
        from dsrc.closed_loop.perception.error_model.model import write_model
        from dsrc.closed_loop.perception.error_model.recordings import fit_model
        from sim.errors import SettingsError, complaint
        from sim.files import check_output

        if self.out.suffix != ".json":
            raise SettingsError(complaint("model fit", "out", "a file that ends with .json", str(self.out)))
        check_output(self.out)
        with progress(f"fit {self.data}") as report:
            model = fit_model(self.data, self.perception, seeds=self.seed, progress=report)
        write_model(self.out, model)
        sys.stdout.write(f"{self.out}\n")
