"""Commands `dsrc model`: train, verify, import and export detectors."""

import sys
from pathlib import Path

import msgspec
from tyro.conf import Positional

from dsrc.cli.progress import log_lines, progress
from dsrc.options.detection import TrainOptions
from dsrc.options.fields import File, Folder, Output


class Train(TrainOptions, frozen=True):
    """Train a detector; an interrupted training resumes."""

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
            sys.stdout.write(f"{detector}\n")


class Verify(msgspec.Struct, frozen=True, kw_only=True):
    """Evaluate a trained detector again and compare it with its run folder; exit code 1 if they differ.

    Compared are hashes, settings, versions and average precision.

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
    """Import a state dict of DSRC's published code (net_epoch....pth) as a detector file.

    Attributes:
        file: checkpoint of the base model, of a student or of a teacher; only tensors are read, no code is run.
        out: detector file, in full precision.
        teacher: import the teacher's half of the file.
        range_m: detection range of its training: x, y, z of the low and of the high corner, m.
        cell_m: side of its pillars, m.
    """

    file: Positional[File]
    out: File
    teacher: bool = False
    range_m: tuple[float, float, float, float, float, float] = (-140.8, -40.0, -3.0, 140.8, 40.0, 1.0)
    cell_m: float = 0.4
    output: Output = Output()

    def run(self) -> None:
        """Write the detector file and print its path."""
        from dsrc.models.storage.checkpoint import save_detector
        from dsrc.models.storage.import_opencood import import_detector
        from dsrc.ops.grid import GridSpec
        from sim.errors import SettingsError
        from sim.files import check_output

        check_output(self.out, "archive")
        try:
            grid = GridSpec(range_m=self.range_m, cell_m=self.cell_m)
        except ValueError as error:
            raise SettingsError(f"model import: {error}") from None
        detector = import_detector(Path(self.file), grid, self.teacher)
        save_detector(self.out, detector, {"imported from": self.file.name}, half=False)
        sys.stdout.write(f"{self.out}\n")


class Export(msgspec.Struct, frozen=True, kw_only=True):
    """Export a detector to ONNX; its inputs are the points of one sample, sorted into pillars.

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
        sys.stdout.write("\n".join([*lines, f"agents: {agents}", str(self.out)]) + "\n")
