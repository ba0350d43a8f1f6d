"""Training step: milliseconds of a plain and of a DSRC student, and the share of each part.

Two samples of five agents with 60,000 points each, frames made of formulas (`benchmarks.reading`); recipe `small`, one
thread, random weights. A step is collation, forward passes, losses, backward pass, clipping and AdamW. The plain
student with the same fusion is the rival: DSRC adds the teacher's clouds and forward pass, the distillation and the
reconstruction to each of its steps, and nothing to its use. Students of single clouds (`alone`) are steps of the
campaign's longest phase.

On a GPU the same steps end with the share of the time in which it computes and, with `--trace`, with a trace of one
step of DSRC for chrome://tracing; data, recipes and random numbers are those of a CPU.

    python -m benchmarks.training            # a few minutes
    python -m benchmarks.training --quick    # fewer samples, under 50 s
    python -m benchmarks.training --device cuda --recipe opv2v --trace runs/step.json
"""

import json
import os
import sys
import time
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
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
from dsrc.data.sample import Sample, make_sample
from dsrc.models.detector import Detector
from dsrc.training.datamodule import Collate
from dsrc.training.losses import total
from dsrc.training.module import DetectionModule
from dsrc.training.recipes import RECIPES, Recipe, of_method

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


class Step:
    """Training step of one method on one batch of samples."""

    def __init__(self, recipe: Recipe, samples: list[Sample], device: str = "cpu") -> None:
        torch.manual_seed(0)
        self.device = device
        settings = recipe.settings("student")
        teacher = Detector(recipe.settings("teacher")) if settings.distils else None
        self.recipe, self.samples = recipe, samples
        self.module = DetectionModule(recipe, Detector(settings), teacher).train().to(device)
        self.collate = Collate(settings, recipe, training=True)
        self.optimizer = torch.optim.AdamW(self.module.parameters(), lr=1e-5, fused=True)
        self.clock, self.steps = Clock(), 0
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
        batch = self.collate(self.samples).to(self.device, non_blocking=True)
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
        self.steps += 1

    def operations(self) -> int:
        """Return the operations that the forward passes, the losses and the backward pass dispatch."""
        batch, clock = self.collate(self.samples).to(self.device), dict(self.clock.seconds)
        with Operations() as operations:
            self.module.backward(total(self.module.losses(batch).values()))
        self.clock.seconds.update(clock)
        return operations.count

    def busy(self, trace: Path | None) -> float:
        """Return the share of a step's time in which the GPU computes, and write the trace of that step."""
        batch = self.collate(self.samples).to(self.device)
        with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as profiler:
            start = time.perf_counter()
            self.module.backward(total(self.module.losses(batch).values()))
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


def make_samples(recipe: Recipe) -> list[Sample]:
    """Return the samples of a batch."""
    return [make_sample(make_frame(index), None, recipe.model.grid) for index in range(SAMPLES)]


def make_steps(recipe: Recipe, device: str) -> dict[str, Step]:
    """Return the steps that are timed, by name."""
    samples = make_samples(recipe)
    return {name: Step(of_method(recipe, method), samples, device) for name, method in METHODS.items()}


def figures_of(steps: dict[str, Step], timings: dict[str, Timing]) -> dict[str, Any]:
    """Return the JSON's figures; CPU time, which other processes disturb least."""
    ms = {name: 1e3 * timing.cpu_s for name, timing in timings.items()}
    return {
        **{f"step_ms_{name}": round(value, 1) for name, value in ms.items()},
        "dsrc_over_plain": round(ms["dsrc"] / ms["plain"], 2),
        "dsrc_over_plain_alone": round(ms["dsrc_alone"] / ms["plain_alone"], 2),
        "operations": {name: step.operations() for name, step in steps.items()},
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
    trace: Path | None = None,
) -> None:
    """Time training steps: a table, then one line of JSON.

    Args:
        quick: fewer samples.
        bfloat16: convolutions and matrix products in half the bits, as the campaign's.
        recipe: recipe of the networks.
        device: where they run, `cpu` or `cuda`.
        trace: file for the trace of a step of DSRC on a GPU.
    """
    torch.set_num_threads(1)
    steps = make_steps(replace(RECIPES[recipe](), bfloat16=bfloat16), device)
    rounds, keep = (3, 2) if quick else (15, 7)
    timings = measure(steps, rounds=rounds, keep=keep, sample_s=0.0)
    show(Console(width=160, highlight=False), steps, timings)
    others = float(np.median([timing.load for timing in timings.values()]))
    facts: dict[str, Any] = {"samples": SAMPLES, "bfloat16": bfloat16, "recipe": recipe, "device": device}
    facts |= {"threads": 1, "cores": os.cpu_count()}
    if device != "cpu":
        facts |= {f"wall_ms_{name}": round(1e3 * timing.wall_s, 1) for name, timing in timings.items()}
        facts["busy"] = round(steps["dsrc"].busy(trace), 3)
    print(json.dumps(figures_of(steps, timings) | facts | {"others_load_cores": round(others, 2)}))


if __name__ == "__main__":
    tyro.cli(main)
