"""How long every method takes to detect at the paper's grid, which stage takes it, and the floor below.

Random weights, 704 x 200 cells, 1, 2 and 5 agents with 60,000 points each; the sizes of the paper (Res2Net blocks 3, 5,
8); detectors as they are loaded for use (`dsrc.models.storage.deploy`). The floor is the network's floating point
operations over the rate of the same machine at multiplying matrices in the same precision, all cores. Beside it the
shipped detector by every engine (`benchmarks.engines`).

    python -m benchmarks.inference            # every stage several times, the least disturbed samples count
    python -m benchmarks.inference --quick    # every stage twice, the second counts; what does not fit is left out
"""

import json
import math
import os
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from msgspec.structs import replace
from numpy.typing import NDArray
from rich.console import Console
from torch.utils.flop_counter import FlopCounterMode

from dsrc.tables.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.engines import EngineTime, engine_times
from benchmarks.quiet import measure
from dsrc.closed_loop.perception.open import SHIPPED_DETECTOR
from dsrc.models.detector import Detector
from dsrc.models.fusion import FUSIONS, AgentLayout
from dsrc.models.inputs.batch import pillars_of
from dsrc.models.settings import ModelSettings
from dsrc.models.storage.checkpoint import load_detector
from dsrc.models.storage.deploy import ENGINES

AGENTS = (1, 2, 5)
POINTS = 60_000
"""Of a cloud."""
STAGES = ("pillars", "encoder", "backbone", "maps", "join", "read", "boxes")
QUICK_S = 32.0
Key = tuple[str, ...]


@dataclass
class Work:
    """One thing that is timed.

    Attributes:
        run: does it.
        gflop: floating point operations of it, a multiplication and an addition being two.
        seconds: of the second call; later of the measurement.
        cpu_s: the same of all threads' time on a CPU, the figure to trust where other processes are busy.
    """

    run: Callable[[], Any]
    gflop: float
    seconds: float
    cpu_s: float


def cloud(settings: ModelSettings, seed: int) -> NDArray[np.float32]:
    """Return (P, 4) points, denser near the sensor as a LiDAR's are, in a LiDAR's place of its own."""
    rng = np.random.default_rng(seed)
    low, high = np.array(settings.grid.range_m[:3]), np.array(settings.grid.range_m[3:])
    place = rng.uniform(low[:2] / 2, high[:2] / 2)
    radius, angle = np.exp(rng.uniform(np.log(2.0), np.log(100.0), 4 * POINTS)), rng.uniform(-np.pi, np.pi, 4 * POINTS)
    xy = place + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    xy = xy[((xy > low[:2]) & (xy < high[:2])).all(axis=1)][:POINTS]
    rest = np.stack([rng.uniform(low[2], high[2], len(xy)), rng.random(len(xy))], axis=1)
    return np.concatenate([xy, rest], axis=1).astype(np.float32)


def _fused_flop(x: list[int], weight: list[int], *rest: Any, out_shape: list[int], **named: Any) -> int:
    """Return the operations of a fused convolution of x into `out_shape`."""
    return 2 * math.prod(out_shape) * math.prod(weight[1:])


_FLOPS = {
    torch.ops.mkldnn._convolution_pointwise: _fused_flop,
    torch.ops.mkldnn._convolution_pointwise_: lambda out, *rest, **named: _fused_flop(*rest, **named),
}
"""What PyTorch's counter of operations does not know: the convolutions of a detector that is made for use."""


class Bench:
    """All stages of all methods; those that several methods share are run once."""

    def __init__(self, settings: ModelSettings, device: str, engine: str, quick: bool, deadline: float) -> None:
        self.settings, self.device, self.engine, self.quick, self.deadline = settings, device, engine, quick, deadline
        self.work: dict[Key, Work] = {}
        self.made: dict[Key, Any] = {}
        self.plan: dict[tuple[str, int], dict[str, Key]] = {}
        self.clouds = [cloud(settings, seed) for seed in range(max(AGENTS))]
        with torch.inference_mode(), FlopCounterMode(display=False):
            # The first call compiles, the counter's first one imports, the first convolution makes its engine.
            pillars_of([self.clouds[0][:100]], settings)
            torch.nn.Conv2d(8, 8, 3)(torch.zeros(1, 8, 9, 9))

    def add(self, method: str, agents: int) -> None:
        """Take a method with so many agents into the plan, running each of its stages."""
        settings = replace(self.settings, fusion=method)
        torch.manual_seed(0)
        detector = ENGINES[self.engine](Detector(settings).to(self.device).eval())
        clouds = self.clouds[: 1 if method == "none" else agents]
        if method == "early":
            clouds = [np.concatenate(clouds)]
        layout = AgentLayout((1,) * len(clouds)) if method == "late" else AgentLayout((len(clouds),))
        rows = str(len(layout.agents))
        source = f"{len(clouds)} x {max(len(c) for c in clouds)} points"
        size = str(len(clouds))
        # Whether the encoder gives all cells or the pillars alone is up to the backbone.
        keys: dict[str, Key] = {
            "pillars": ("pillars", source),
            "encoder": ("encoder", settings.backbone_name, source),
        }
        pillars = self.once(keys["pillars"], lambda: pillars_of(clouds, settings).to(self.device))
        dense = self.once(keys["encoder"], lambda: detector.encoder(pillars))
        keys["backbone"] = ("backbone", settings.backbone_name, size)
        stages = self.per_cloud(keys["backbone"], lambda: detector.backbone(dense))
        place = detector.fusion.place
        keys["maps"] = ("maps", place, size)
        maps = self.per_cloud(keys["maps"], lambda: detector.maps(stages))
        keys["join"] = ("join", method, size)
        joined = self.once(keys["join"], lambda: detector.fuse(maps, layout))
        widths = str([part.shape[1] for part in joined])
        keys["read"] = ("read", place, widths, rows)
        output = self.per_cloud(keys["read"], lambda: detector.heads(stages, joined))
        keys["boxes"] = ("boxes", rows)
        self.once(keys["boxes"], lambda: detector.decode(output))
        self.plan[method, agents] = keys

    def per_cloud(self, key: Key, run: Callable[[], Any]) -> Any:
        """As `once`, for a stage whose rows, the last word of the key, have nothing to do with each other."""
        two, rows = (*key[:-1], "2"), int(key[-1])
        if self.quick and rows > 2 and two in self.made and key not in self.made:
            work, share = self.work[two], rows / 2
            self.work[key] = Work(work.run, work.gflop * share, work.seconds * share, work.cpu_s * share)
            self.made[key] = repeated(self.made[two], rows)
        return self.once(key, run)

    def once(self, key: Key, run: Callable[[], Any]) -> Any:
        """Return what a stage makes, from an earlier method where it is the same."""
        if key in self.made:
            return self.made[key]
        if time.perf_counter() > self.deadline:
            raise TimeoutError
        timed = partial(self._whole, run)
        # The first call makes engines and takes memory for the first time.
        with torch.inference_mode(), FlopCounterMode(display=False, custom_mapping=_FLOPS) as counter:
            timed()
        start, busy = time.perf_counter(), time.process_time()
        made = timed()
        seconds, cpu_s = time.perf_counter() - start, time.process_time() - busy
        self.work[key] = Work(timed, counter.get_total_flops() / 1e9, seconds, cpu_s)
        self.made[key] = made
        return made

    def _whole(self, run: Callable[[], Any]) -> Any:
        """Run to the end, on a GPU too."""
        with torch.inference_mode():
            made = run()
            if self.device != "cpu":
                torch.cuda.synchronize()
        return made

    def remeasure(self, rounds: int, keep: int) -> float:
        """Time all stages in turn; return how many cores others kept busy."""
        timings = measure({" ".join(k): w.run for k, w in self.work.items()}, rounds=rounds, keep=keep, sample_s=0.0)
        for work, timing in zip(self.work.values(), timings.values(), strict=True):
            work.seconds, work.cpu_s = timing.wall_s, timing.cpu_s
        return float(np.median([timing.load for timing in timings.values()]))

    def seconds(self, method: str, agents: int) -> dict[str, float]:
        """Return the seconds of each stage."""
        return {stage: self.work[key].seconds for stage, key in self.plan[method, agents].items()}

    def cpu_seconds(self, method: str, agents: int) -> float:
        """Return the seconds on a CPU of all stages and threads."""
        return sum(self.work[key].cpu_s for key in self.plan[method, agents].values())

    def floor(self, method: str, agents: int, rate: float) -> float:
        """Return the seconds that the operations take at a rate in GFLOP per second."""
        return sum(self.work[key].gflop for key in self.plan[method, agents].values()) / rate


def repeated(made: Any, rows: int) -> Any:
    """Return tensors of two rows with as many as asked for; an output stays, its boxes are found alike."""
    if isinstance(made, torch.Tensor):
        return torch.cat([made] * rows)[:rows]
    return type(made)(repeated(part, rows) for part in made) if isinstance(made, (list, tuple)) else made


def matrix_rate(device: str, size: int = 2048, calls: int = 4) -> float:
    """Return the best rate of multiplying two square matrices in float32, GFLOP per second.

    On a CPU by the threads' time where that is less than the time that passed: others had the cores meanwhile.
    """
    a, b = (torch.randn(size, size, device=device) for _ in range(2))
    best = float("inf")
    for _ in range(calls + 1):
        start, busy = time.perf_counter(), time.process_time()
        a @ b
        if device != "cpu":
            torch.cuda.synchronize()
        passed = time.perf_counter() - start
        worked = (time.process_time() - busy) / torch.get_num_threads() if device == "cpu" else passed
        best = min(best, passed, worked)
    return 2 * size**3 / best / 1e9


def show(console: Console, bench: Bench, rate: float) -> None:
    rows = []
    for method in FUSIONS:
        cells = [
            f"{1000 * sum(bench.seconds(method, n).values()):.0f}" if (method, n) in bench.plan else "" for n in AGENTS
        ]
        shares = [""] * (1 + len(STAGES))
        if (method, 2) in bench.plan:
            parts = bench.seconds(method, 2)
            total = sum(parts.values())
            shares = [f"{1000 * bench.floor(method, 2, rate):.0f}", *(f"{parts[s] / total:.0%}" for s in STAGES)]
        rows.append((method, *cells, *shares))
    head = ("method", *(f"{n} agents" for n in AGENTS), "floor of 2", *STAGES)
    title = (
        f"ms per frame on {bench.device}, engine {bench.engine}; floor at {rate:.0f} GFLOP/s; shares with two agents"
    )
    console.print(Table.of(head, rows, title=title))


def show_engines(console: Console, times: dict[str, EngineTime]) -> None:
    base = times["fused"].cpu_ms or float("nan")
    rows = [
        (name, f"{one.cpu_ms:.0f}", f"{base / one.cpu_ms:.2f}", f"{one.score_error:.4f}")
        for name, one in times.items()
        if one.cpu_ms is not None
    ]
    head = ("engine", "CPU ms", "times as fast as fused", "largest change of a score")
    console.print(Table.of(head, rows, title=f"shipped detector, {max(AGENTS)} agents, one pass of the network"))
    for name, one in times.items():
        if one.cpu_ms is None:
            console.print(f"{name}: {one.why}")


def figures(bench: Bench, rate: float) -> dict[str, object]:
    latency: dict[str, dict[str, float | None]] = {}
    cpu: dict[str, dict[str, float | None]] = {}
    floor: dict[str, dict[str, float | None]] = {}
    share: dict[str, dict[str, float]] = {}
    for method in FUSIONS:
        there = {n: (method, n) in bench.plan for n in AGENTS}
        latency[method] = {
            str(n): round(1000 * sum(bench.seconds(method, n).values()), 1) if there[n] else None for n in AGENTS
        }
        cpu[method] = {str(n): round(1000 * bench.cpu_seconds(method, n), 1) if there[n] else None for n in AGENTS}
        floor[method] = {str(n): round(1000 * bench.floor(method, n, rate), 1) if there[n] else None for n in AGENTS}
        if there[2]:
            parts = bench.seconds(method, 2)
            share[method] = {stage: round(parts[stage] / sum(parts.values()), 3) for stage in STAGES}
    return {
        "latency_ms": latency,
        "cpu_ms": cpu,
        "floor_ms": floor,
        "share_of_2_agents": share,
        "matrix_gflop_s": round(rate, 1),
    }


def main(quick: bool = False, engine: Literal["fused", "bf16", "compiled", "plain"] = "fused") -> None:
    """Time every method on the CPU, and on a GPU where there is one: tables for people, then one line of JSON.

    Args:
        quick: every stage twice, the second counts; what does not fit into 32 s is left out (null), and stages that
            take clouds one by one are run for two, and taken as 2.5 times as long for five.
        engine: execution of the methods' networks.
    """
    started = time.perf_counter()
    console = Console(width=160, highlight=False)
    shipped = load_detector(SHIPPED_DETECTOR).settings
    times = engine_times(pillars_of([cloud(shipped, seed) for seed in range(max(AGENTS))], shipped), quick)
    show_engines(console, times)
    result: dict[str, object] = {"engine": engine, "engines": {name: asdict(one) for name, one in times.items()}}
    for device in ("cpu", *(("cuda",) if torch.cuda.is_available() else ())):
        rate = matrix_rate(device)
        bench = Bench(ModelSettings(), device, engine, quick, started + QUICK_S if quick else float("inf"))
        try:
            for agents in AGENTS:
                for method in FUSIONS:
                    bench.add(method, agents)
        except TimeoutError:
            console.print("There was no time left for what is empty.")
        others = None if quick else bench.remeasure(rounds=5, keep=3)
        rate = max(rate, matrix_rate(device))
        show(console, bench, rate)
        found = figures(bench, rate) | {"others_load_cores": None if others is None else round(others, 2)}
        result |= found if device == "cpu" else {"gpu": found | {"name": torch.cuda.get_device_name()}}
    settings = ModelSettings()
    size = {"grid": [settings.grid.width, settings.grid.height], "points": POINTS, "threads": torch.get_num_threads()}
    print(json.dumps(result | size | {"cores": os.cpu_count()}))


if __name__ == "__main__":
    tyro.cli(main)
