"""Commands `dsrc model`: train, verify, import, join and export detectors, and fit models of their errors."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from tyro.conf import Positional, arg

from dsrc.cli.progress import log_lines, made, progress
from dsrc.options.detection import TrainOptions
from dsrc.options.fields import File, Folder, Output

if TYPE_CHECKING:
    from dsrc.ops.grid import GridSpec

_TRY = ("drive", "lta_truck", "--perception", "truth", "ego", "team", "--checkpoint")
"""Command that drives with a detector, without its file."""


class Train(TrainOptions, frozen=True):
    """Train a detector; an interrupted training resumes.

    Examples:
        dsrc model train small --data data/train --out runs/small
        dsrc model train small --method v2x-vit --data data/train --out runs/v2x-vit
        dsrc model train small --stage plain --set fusion=max --data data/train --out runs/plain
    """

    output: Output = Output()

    def run(self) -> None:
        """Train and print the detector file."""
        from dsrc.training.train import leads, train_stages
        from sim.files import check_apart

        for data in (self.data, self.validate):
            if data is not None:
                check_apart(self.out, data)

        log_lines("dsrc.training")  # a line per epoch
        detector = train_stages(self)
        if leads():
            made(detector, "a detector and its run folder", "view", detector.parent)


class Verify(msgspec.Struct, frozen=True, kw_only=True):
    """Evaluate a trained detector again and compare it with its run folder; exit code 1 if they differ.

    Compared are hashes, settings, versions and average precision, that of a student by every engine of the machine.

    Examples:
        dsrc model verify runs/small

    Attributes:
        training: run folder of a finished training, or of one with several stages.
        data: folder of the training drives; default: as recorded.
        validate: folder of the validation drives; default: as recorded.
    """

    training: Positional[Folder]
    data: Folder | None = None
    validate: Folder | None = None

    def run(self) -> None:
        """Verify every stage and print what agrees and what differs."""
        from dsrc.training.verify import agree, runs_in, verify

        whole = True
        for folder in runs_in(self.training):
            with progress(f"verify {folder}") as report:
                checks = verify(folder, self.data, self.validate, report)
            whole &= agree(checks)
            sys.stdout.write("\n".join([str(folder), *(f"  {check}" for check in checks)]) + "\n")
        if not whole:
            raise SystemExit(1)


class Import(msgspec.Struct, frozen=True, kw_only=True):
    """Import a published state dict (net_epoch....pth) as a detector file, and print what it is.

    Examples:
        dsrc model import net_epoch40.pth --out detector.pt
        dsrc model import net_epoch40.pth --family opencood --method v2x-vit --out detector.pt

    Attributes:
        file: checkpoint; only tensors are read, no code is run.
        out: detector file, in full precision.
        family: published code that wrote it: DSRC's own, or PointPillar models of OpenCOOD, CoAlign and ERMVP.
        method: fusion method, where the tensors fit several; default: the one that fits.
        teacher: import the teacher's half of a file of DSRC's.
        range_m: detection range of its training: x, y, z of the low and of the high corner, m; default: the published
            recipe's.
        cell_m: side of its pillars, m.
        shrink_stride: stride of its first shrink convolution, 1 or 2; default: the published recipe's.
        right_handed: it was trained on clouds with y to the left, as V2V4Real's and DAIR-V2X-C's.
        intensity_steps: steps between 0 and 1 of the intensities of its training; 0 for any number.
        own_frame: every agent encodes its cloud in its own frame (`proj_first: false`).
        agents: number of agents that are fused, where the tensors do not tell it.
        anchor_m: length, width and height of its anchors, m; default: a car's.
    """

    file: Positional[File]
    out: File
    family: Literal["dsrc", "opencood"] = "dsrc"
    method: str | None = None
    teacher: bool = False
    range_m: tuple[float, float, float, float, float, float] | None = None
    cell_m: float = 0.4
    shrink_stride: Literal[1, 2] | None = None
    right_handed: bool = False
    intensity_steps: int = 255
    own_frame: bool = False
    agents: int = 5
    anchor_m: tuple[float, float, float] | None = None
    output: Output = Output()

    def run(self) -> None:
        """Write the detector file, print its properties and its path."""
        from dsrc.models.storage.checkpoint import save_detector
        from dsrc.models.storage.import_dsrc import import_detector
        from dsrc.models.storage.import_opencood import PublishedTraining, import_opencood
        from dsrc.models.storage.published import described
        from sim.files import check_output

        check_output(self.out, "archive")
        if self.family == "dsrc":
            self._check_unused("method", "shrink_stride", "intensity_steps", "own_frame", "agents", "anchor_m")
            detector = import_detector(Path(self.file), self._grid(), self.teacher, left_handed=not self.right_handed)
        else:
            self._check_unused("teacher")
            origin = PublishedTraining(
                method=self.method,
                range_m=self.range_m,
                cell_m=self.cell_m,
                shrink_stride=self.shrink_stride,
                left_handed=not self.right_handed,
                intensity_steps=self.intensity_steps or None,
                own_frame=self.own_frame,
                max_agents=self.agents,
                anchor_lwh=self.anchor_m,
            )
            detector = import_opencood(Path(self.file), origin)
        save_detector(self.out, detector, {"imported from": self.file.name, "family": self.family}, half=False)
        sys.stdout.writelines(f"{line}\n" for line in described(detector))
        made(self.out, "a detector", *_TRY, self.out)

    def _grid(self) -> "GridSpec":
        """Return the grid of a network of DSRC's, whose range is the default of grids."""
        from dsrc.ops.grid import GridSpec
        from sim.errors import SettingsError

        try:
            return GridSpec(cell_m=self.cell_m) if self.range_m is None else GridSpec(self.range_m, self.cell_m)
        except ValueError as error:
            raise SettingsError(f"model import: {error}") from None

    def _check_unused(self, *names: str) -> None:
        """Refuse options that this family's files need none of."""
        from sim.errors import SettingsError, option

        defaults = {field.name: field.default for field in msgspec.structs.fields(self)}
        for name in names:
            if getattr(self, name) != defaults[name]:
                raise SettingsError(
                    f"model import: files of --family {self.family} do not need it; leave out {option(name)}"
                )


class Join(msgspec.Struct, frozen=True, kw_only=True):
    """Join detectors of different road users into one file, for `dsrc drive`.

    Examples:
        dsrc model join vehicles.pt vulnerable.pt --out both.pt

    Attributes:
        vehicles: detector file of vehicles, whose grid holds the other's.
        vulnerable: detector file of pedestrians and two-wheelers, trained with `--set users=vulnerable`.
        out: detector file.
    """

    vehicles: Positional[File]
    vulnerable: Positional[File]
    out: File
    output: Output = Output()

    def run(self) -> None:
        """Write the file and print its path."""
        from dsrc.models.storage.checkpoint import join_files
        from sim.files import check_output

        check_output(self.out, "archive")
        join_files([self.vehicles, self.vulnerable], self.out)
        made(self.out, "a detector of all road users", *_TRY, self.out)


class Export(msgspec.Struct, frozen=True, kw_only=True):
    """Export a detector to ONNX; its inputs are the points of one sample, sorted into pillars.

    Examples:
        dsrc model export detector.pt --agents 3 --out detector.onnx

    Attributes:
        checkpoint: detector file.
        out: ONNX file.
        agents: number of agents, the ego included, where the method needs a fixed one.
    """

    checkpoint: Positional[File]
    out: File
    agents: int = 2
    output: Output = Output()

    def run(self) -> None:
        """Write the file and print its inputs and outputs."""
        from dsrc.models.storage.checkpoint import load_detector
        from dsrc.models.storage.export import INPUTS, OUTPUTS, export_onnx
        from sim.files import check_output

        check_output(self.out, "network")
        agents = export_onnx(load_detector(self.checkpoint), self.out, self.agents)
        lines = [f"{name}: {meaning}" for name, meaning in (INPUTS | OUTPUTS).items()]
        sys.stdout.writelines(f"{line}\n" for line in [*lines, f"agents: {agents}"])
        made(self.out, "a network for any runtime of ONNX")


class Fit(msgspec.Struct, frozen=True, kw_only=True):
    """Fit the errors of a perception to its recordings; dsrc drive --perception MODEL.json drives with them.

    Misses, ghosts and box errors by range, sight, corruption and channel, with persistence in time.

    Examples:
        dsrc model fit runs/real --perception team --out team.json

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
        made(self.out, "an error model", "drive", "lta_truck", "--perception", self.out)
