"""How many steps the closed loop drives in a second, and which stage takes the time.

Truth: a junction of four arms with about a hundred vehicles on it, against highway-env's `highway-v0` with 50 vehicles
in the same run. Detector: the shipped one in `lta_truck`, where the ego, two vehicles and a roadside unit sense. Real
time is ten steps a second. CPU seconds of one thread count; wall time is beside them.

    python -m benchmarks.closed_loop            # 150 steps of each, the rivals take turns
    python -m benchmarks.closed_loop --quick    # under 50 s
"""

import json
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import highway_env  # noqa: F401  it registers its environments
import msgspec
import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dsrc.closed_loop.loop import ClosedLoop, LoopSettings
from dsrc.closed_loop.perception.open import open_perception
from dsrc.closed_loop.types import Perception
from sim.catalog.load import load_scenario
from sim.scenario import Scenario

STAGES = ("move", "perceive", "track", "decide", "judge")
REAL_TIME = 10.0
"""Steps a second of real time."""
_TURNS = 3


@dataclass
class Run:
    """Steps of one variant, taken in turns with the others.

    Attributes:
        name: of the variant.
        step: one step.
        steps: steps taken.
        cpu_s: CPU time of all threads, s.
        wall_s: s.
    """

    name: str
    step: Callable[[], object]
    steps: int = 0
    cpu_s: float = 0.0
    wall_s: float = 0.0

    def take(self, steps: int, until: float) -> None:
        """Take steps, none after a point in time."""
        wall, cpu = time.perf_counter(), time.process_time()
        for _ in range(steps):
            if time.perf_counter() > until:
                break
            self.step()
            self.steps += 1
        self.wall_s += time.perf_counter() - wall
        self.cpu_s += time.process_time() - cpu

    @property
    def per_cpu_s(self) -> float:
        """Steps in a second of CPU time."""
        return self.steps / max(self.cpu_s, 1e-9)

    @property
    def per_wall_s(self) -> float:
        """Steps in a second."""
        return self.steps / max(self.wall_s, 1e-9)


class Endless:
    """Closed loop whose episode begins anew where it ends; what the start takes is not counted."""

    def __init__(self, scenario: str | Scenario, perception: Perception) -> None:
        self.loop = ClosedLoop(scenario, perception, settings=LoopSettings(duration_s=60.0))
        self.seed = 1
        self.seconds = dict.fromkeys(STAGES, 0.0)
        self.actors: list[int] = []
        self.loop.start(self.seed)

    def step(self) -> None:
        """Drive one step."""
        if self.loop.outcome is not None:
            self.seed += 1
            self.loop.start(self.seed)
        before = dict(self.loop.seconds)
        self.loop.advance()
        for stage in STAGES:
            self.seconds[stage] += self.loop.seconds.get(stage, 0.0) - before.get(stage, 0.0)
        self.actors.append(len(self.loop.tick.actors))

    def shares(self) -> dict[str, float]:
        """Return the share of each stage in the time of the steps."""
        total = sum(self.seconds.values()) or 1.0
        return {stage: seconds / total for stage, seconds in self.seconds.items()}


def busy_junction() -> Scenario:
    """Return the junction of four arms with demand for about a hundred vehicles."""
    scenario = load_scenario("four_way")
    demand = msgspec.structs.replace(scenario.demand, vehicles_per_hour=4000, max_vehicles=110)
    return msgspec.structs.replace(scenario, demand=demand, warmup_s=60.0)


def rival() -> Callable[[], object]:
    """Return a step of highway-env's own motorway with 50 vehicles, at 10 Hz."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        config = {"vehicles_count": 50, "simulation_frequency": 10, "policy_frequency": 10, "duration": 1000}
        env = gymnasium.make("highway-v0", config=config, disable_env_checker=True).unwrapped
    env.reset(seed=0)

    def step() -> None:
        if any(env.step(1)[2:4]):
            env.reset(seed=0)

    return step


def main(quick: bool = False, engine: str = "fused") -> None:
    """Measure the closed loop.

    Args:
        quick: under 50 s.
        engine: execution of the detector, see `dsrc.models.storage.deploy.ENGINES`.
    """
    began = time.perf_counter()
    torch.set_num_threads(1)
    truth = Endless(busy_junction(), open_perception("truth"))
    steps = 24 if quick else 150
    runs = [Run("truth", truth.step), Run("highway-v0", rival())]
    until = time.perf_counter() + (14.0 if quick else 600.0)
    for _ in range(_TURNS):
        for run in runs:
            run.take(steps // _TURNS, until)
    truth.loop.close()  # one simulation of SUMO per process
    detector = Endless("lta_truck", open_perception("team", engine=engine))
    seeing = Run("detector", detector.step)
    detector.step()  # compiles
    seeing.take(steps, began + (44.0 if quick else 1e6))
    detector.loop.close()
    console, table = Console(highlight=False), Table(title="closed loop, one thread")
    for heading in ("variant", "steps", "steps per CPU s", "steps per s", *STAGES):
        table.add_column(heading, justify="left" if heading == "variant" else "right")
    for run, own in ((runs[0], truth), (runs[1], None), (seeing, detector)):
        shares = [f"{100 * share:.0f} %" for share in own.shares().values()] if own else [""] * len(STAGES)
        table.add_row(run.name, str(run.steps), f"{run.per_cpu_s:.1f}", f"{run.per_wall_s:.1f}", *shares)
    console.print(table)
    console.print(
        f"real time is {REAL_TIME:g} steps a second; truth with {np.median(truth.actors):.0f} vehicles, detector with "
        f"{len(detector.loop.perception.senses.agents)} sensing agents"  # type: ignore[attr-defined]
    )
    figures = {
        "steps_s_truth": round(runs[0].per_cpu_s, 2),
        "steps_s_truth_wall": round(runs[0].per_wall_s, 2),
        "steps_s_highway_env": round(runs[1].per_cpu_s, 2),
        "truth_over_highway_env": round(runs[0].per_cpu_s / runs[1].per_cpu_s, 2),
        "steps_s_detector": round(seeing.per_cpu_s, 2),
        "steps_s_detector_wall": round(seeing.per_wall_s, 2),
        "vehicles": int(np.median(truth.actors)),
        "engine": engine,
        **{f"share_truth_{stage}": round(share, 3) for stage, share in truth.shares().items()},
        **{f"share_detector_{stage}": round(share, 3) for stage, share in detector.shares().items()},
    }
    sys.stdout.write(json.dumps(figures) + "\n")


if __name__ == "__main__":
    tyro.cli(main)
