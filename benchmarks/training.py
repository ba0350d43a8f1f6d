"""Training step: milliseconds of a plain and of a DSRC student, and the share of each part.

Two samples of five agents with 60,000 points each, frames made of formulas (`benchmarks.reading`); recipe `small`, one
thread, random weights. A step is collation, forward passes, losses, backward pass, clipping and AdamW. The plain
student with the same fusion is the rival: DSRC adds the teacher's clouds and forward pass, the distillation and the
reconstruction to each of its steps, and nothing to its use. Students of single clouds (`alone`) are steps of the
campaign's longest phase.

On a GPU batches are made there of points in its memory, as a training makes them (`--resident False`: by the host). The
same steps end with the share of the time in which it computes; recipes and random numbers are those of a CPU. `--trace`
writes a trace of one step of DSRC for chrome://tracing, on a CPU too (`--resident True`: by a GPU's way). `loader_ms`
is the CPU time of a loader's process for a batch: it reads, draws and collates whole samples, or draws alone.

    python -m benchmarks.training            # a few minutes
    python -m benchmarks.training --quick    # fewer samples, under 50 s
    python -m benchmarks.training --rivals v2x-vit cobevt ermvp
    python -m benchmarks.training --device cuda --recipe opv2v --sync-debug --trace runs/step.json
"""

import json
import os
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import tyro
from msgspec.structs import replace
from rich.console import Console
from torch import nn
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile
from torch.utils._python_dispatch import TorchDispatchMode

from dsrc.tables.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.quiet import Timing, measure
from benchmarks.reading import SAMPLES, make_frame
from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.models.detector import Detector
from dsrc.models.inputs.batch import Batch
from dsrc.models.layers.half_products import half_products
from dsrc.training.datamodule import Collate, DetectionData
from dsrc.training.losses import total
from dsrc.training.module import DetectionModule
from dsrc.training.recipes import RECIPES, Augmentation, Recipe, of_method
from dsrc.training.resident.batch import ResidentBatches
from dsrc.training.resident.plan import PlanCollate, ResidentSet
from dsrc.training.resident.store import ResidentPoints
from sim.errors import SettingsError, UserError, complaint
from sim.machine import keep_memory

_AS_IT_IS = Augmentation(flip=False, rotation_deg=0.0, scale=0.0, random_ego=False, dropout=0.0)
METHODS = {"plain": "attfuse", "dsrc": "dsrc", "plain_alone": "no-collaboration", "dsrc_alone": "dsrc-alone"}
"""Steps that are timed, and their methods."""
PARTS = (
    "collate",
    "encoder",
    "backbone",
    "fusion and heads",
    "teacher",
    "reconstruction",
    "losses",
    "backward",
    "optimizer",
)


class Operations(TorchDispatchMode):
    """Counter of what PyTorch dispatches."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += 1
        return func(*args, **(kwargs or {}))


@dataclass
class Clock:
    """Seconds by part, summed over the steps that ran."""

    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))

    def watch(self, part: str, module: nn.Module | None) -> None:
        """Add the forward passes of a module to a part."""
        if module is None:
            return
        started: list[float] = []
        module.register_forward_pre_hook(lambda *_: started.append(time.perf_counter()))
        module.register_forward_hook(lambda *_: self._stop(part, started))

    def _stop(self, part: str, started: list[float]) -> None:
        self.seconds[part] += time.perf_counter() - started.pop()


class Feed:
    """Batches of a drive for one method: made by the host, or of points in a device's memory."""

    def __init__(self, recipe: Recipe, drive: Path, device: str, resident: bool) -> None:
        settings, self.device = recipe.settings("student"), device
        training = DetectionData(replace(recipe, validation_share=0.0), settings, [drive], None, 0).training
        draws = [(0, number) for number in range(SAMPLES)]
        self.load: Callable[[], Any]
        self.make: Callable[[], Batch]
        if resident:
            points = ResidentPoints(training.store, training.frames, device)
            dataset = ResidentSet(training, points.frames, points.points)
            planned, on_device = PlanCollate(settings, recipe, dataset), ResidentBatches(points, settings, recipe)
            self.load = lambda: planned([dataset[one] for one in draws])
            plan = self._pinned(self.load())
            self.make = lambda: on_device(plan.to(device, non_blocking=True))
        else:
            collate, samples = Collate(settings, recipe, training=True), [training[one] for one in draws]
            self.load = lambda: collate([training[one] for one in draws])
            self.make = lambda: self._pinned(collate(samples)).to(device, non_blocking=True)

    def _pinned(self, batch: Any) -> Any:
        return batch if self.device == "cpu" else batch.pin_memory()

    def loader_ms(self) -> float:
        """Return the CPU time of a loader's process for a batch."""
        start = time.process_time()
        self.load()
        return 1e3 * (time.process_time() - start)


class Step:
    """Training step of one method on one batch of samples."""

    def __init__(self, recipe: Recipe, drive: Path, device: str = "cpu", resident: bool = False) -> None:
        torch.manual_seed(0)
        self.device = device
        settings = recipe.settings("student")
        teacher = Detector(recipe.settings("teacher")) if settings.distils else None
        self.recipe, self.feed = recipe, Feed(recipe, drive, device, resident)
        self.module = DetectionModule(recipe, Detector(settings), teacher).train().to(device)
        self.optimizer = torch.optim.AdamW(self.module.parameters(), lr=1e-5, fused=True)
        self.clock, self.loader_ms = Clock(), 0.0
        detector = self.module.detector
        watched = {
            "encoder": detector.encoder,
            "backbone": detector.backbone,
            "student": detector,
            "teacher": teacher,
            "reconstruction": self.module.reconstruction,
        }
        for part, module in watched.items():
            self.clock.watch(part, module)

    def __call__(self) -> None:
        """Run one step."""
        times = [time.perf_counter()]
        batch = self.feed.make()
        times.append(time.perf_counter())
        loss = total(self.module.losses(batch).values())
        times.append(time.perf_counter())
        self.optimizer.zero_grad()
        self.module.backward(loss)
        times.append(time.perf_counter())
        nn.utils.clip_grad_norm_(self.module.parameters(), self.recipe.clip)
        self.optimizer.step()
        if self.device != "cpu":
            torch.cuda.synchronize()
        times.append(time.perf_counter())
        for part, seconds in zip(("collate", "forward", "backward", "optimizer"), np.diff(times), strict=True):
            self.clock.seconds[part] += float(seconds)

    def operations(self) -> int:
        """Return the operations that the forward passes, the losses and the backward pass dispatch."""
        batch, clock = self.feed.make(), dict(self.clock.seconds)
        with Operations() as operations:
            self.module.backward(total(self.module.losses(batch).values()))
        self.clock.seconds.update(clock)
        return operations.count

    def operations_of_batch(self) -> int:
        """Return the operations that making a batch dispatches."""
        with Operations() as operations:
            self.feed.make()
        return operations.count

    def check_waits(self) -> None:
        """Run a step in which PyTorch raises where the host waits for the GPU."""
        torch.cuda.set_sync_debug_mode("error")
        try:
            self.module.backward(total(self.module.losses(self.feed.make()).values()))
        finally:
            torch.cuda.set_sync_debug_mode("default")

    def busy(self, trace: Path | None) -> float:
        """Return the share of a step's time in which a GPU computes, and write the trace of that step."""
        on_gpu = self.device != "cpu"
        with profile(activities=[ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if on_gpu else [])]) as profiler:
            start = time.perf_counter()
            self.module.backward(total(self.module.losses(self.feed.make()).values()))
            if on_gpu:
                torch.cuda.synchronize()
            whole = time.perf_counter() - start
        if trace is not None:
            profiler.export_chrome_trace(str(trace))
        kernels = (event for event in profiler.events() if event.device_type == DeviceType.CUDA)
        return 1e-6 * sum(event.time_range.elapsed_us() for event in kernels) / whole

    def shares(self) -> dict[str, float]:
        """Return the share of each part in a step."""
        found = self.clock.seconds
        whole = sum(found[part] for part in ("collate", "forward", "backward", "optimizer"))
        found = found | {
            "fusion and heads": found["student"] - found["encoder"] - found["backbone"],
            "losses": found["forward"] - found["student"] - found["teacher"] - found["reconstruction"],
        }
        return {part: found[part] / whole for part in PARTS}


def make_steps(recipe: Recipe, device: str, resident: bool = False, rivals: tuple[str, ...] = ()) -> dict[str, Step]:
    """Return the steps that are timed, by name: those of `METHODS` and of further methods."""
    recipe = replace(recipe, augmentation=_AS_IT_IS)
    with TemporaryDirectory() as folder:
        for index in range(SAMPLES):
            write_frame(Path(folder), make_frame(index))
        steps = {
            name: Step(of_method(recipe, method), Path(folder), device, resident)
            for name, method in (METHODS | {name: name for name in rivals}).items()
        }
        for step in steps.values():
            step.loader_ms = step.feed.loader_ms()
    return steps


def figures_of(steps: dict[str, Step], timings: dict[str, Timing]) -> dict[str, Any]:
    """Return the JSON's figures; CPU time, which other processes disturb least."""
    ms = {name: 1e3 * timing.cpu_s for name, timing in timings.items()}
    return {
        **{f"step_ms_{name}": round(value, 1) for name, value in ms.items()},
        "dsrc_over_plain": round(ms["dsrc"] / ms["plain"], 2),
        "dsrc_over_plain_alone": round(ms["dsrc_alone"] / ms["plain_alone"], 2),
        **{f"{name}_over_plain": round(ms[name] / ms["plain"], 2) for name in steps if name not in METHODS},
        "operations": {name: step.operations() for name, step in steps.items()},
        "operations_of_batch": {name: step.operations_of_batch() for name, step in steps.items()},
        "loader_ms": {name: round(step.loader_ms, 1) for name, step in steps.items()},
        "share": {name: {part: round(v, 3) for part, v in step.shares().items()} for name, step in steps.items()},
    }


def show(console: Console, steps: dict[str, Step], timings: dict[str, Timing]) -> None:
    """Print the table."""
    rows = []
    for name, step in steps.items():
        shares = (f"{share:.0%}" if share else "" for share in step.shares().values())
        timing = timings[name]
        rows.append((name.replace("_", " "), f"{1e3 * timing.wall_s:.0f}", f"{1e3 * timing.cpu_s:.0f}", *shares))
    title = f"Training step of {SAMPLES} samples, one thread; share of each part"
    console.print(Table.of(("student", "ms", "CPU ms", *PARTS), rows, title=title))


def main(
    quick: bool = False,
    bfloat16: bool = True,
    recipe: str = "small",
    device: str = "cpu",
    resident: bool | None = None,
    sync_debug: bool = False,
    trace: Path | None = None,
    rivals: tuple[str, ...] = (),
) -> None:
    """Time training steps: a table, then one line of JSON.

    Args:
        quick: fewer samples.
        bfloat16: convolutions and matrix products in half the bits, as the campaign's.
        recipe: recipe of the networks.
        device: where they run, `cpu` or `cuda`.
        resident: make batches of points in the device's memory; by default on a GPU.
        sync_debug: before all else, run each step once on a GPU so that it raises where the host waits.
        trace: file for the trace of a step of DSRC.
        rivals: further methods that are timed, such as v2x-vit.
    """
    if device == "cpu" and sync_debug:
        raise SettingsError(complaint("benchmark", "--sync-debug", "--device cuda", device))
    torch.set_num_threads(1)
    keep_memory()
    resident = device != "cpu" if resident is None else resident
    steps = make_steps(replace(RECIPES[recipe](), bfloat16=bfloat16), device, resident, rivals)
    for step in steps.values():
        if sync_debug:
            step()  # the first step prepares the teacher
            step.check_waits()
            step.clock.seconds.clear()
    rounds, keep = (3, 2) if quick else (15, 7)
    with half_products(bfloat16):
        timings = measure(steps, rounds=rounds, keep=keep, sample_s=0.0)
        busy = steps["dsrc"].busy(trace) if device != "cpu" or trace is not None else None
    show(Console(width=160, highlight=False), steps, timings)
    others = float(np.median([timing.load for timing in timings.values()]))
    facts: dict[str, Any] = {"samples": SAMPLES, "bfloat16": bfloat16, "recipe": recipe, "device": device}
    facts["resident"] = resident
    facts |= {"threads": 1, "cores": os.cpu_count()}
    if device != "cpu":
        facts["busy"] = round(busy or 0.0, 3)
        facts |= {f"wall_ms_{name}": round(1e3 * timing.wall_s, 1) for name, timing in timings.items()}
    print(json.dumps(figures_of(steps, timings) | facts | {"others_load_cores": round(others, 2)}))


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except UserError as error:
        sys.stderr.write(f"training: {error}\n")
        raise SystemExit(2) from None
