"""How many steps the closed loop drives in a second, and which stage takes the time.

Truth: a junction of four arms with about a hundred vehicles on it, against highway-env's `highway-v0` with 50 vehicles
in the same run. Detector: the shipped one in `lta_truck`, where the ego, two vehicles and a roadside unit sense, or in
another scenario. Real time is ten steps a second. CPU seconds of one thread count; wall time is beside them. Error
model: whole episodes of that scenario by a model of the detector, starts included, beside the same episodes with the
detector's time per step.

    python -m benchmarks.closed_loop            # 150 steps of each, the rivals take turns
    python -m benchmarks.closed_loop --quick    # under 50 s of a core
    python -m benchmarks.closed_loop --quick --scenario eebl_chain    # three vehicles sense
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

from dsrc.tables.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dsrc.closed_loop.loop import ClosedLoop, LoopSettings
from dsrc.closed_loop.perception.error_model.fit import fit_errors
from dsrc.closed_loop.perception.error_model.model import ErrorModel
from dsrc.closed_loop.perception.error_model.perception import ModelPerception
from dsrc.closed_loop.perception.error_model.percepts import observed_episode
from dsrc.closed_loop.perception.open import open_perception
from dsrc.closed_loop.types import Perception
from sim.boxes import VEHICLES
from sim.catalog.load import load_scenario
from sim.errors import UserError
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
        begin: called before each step and not timed.
        steps: steps taken.
        cpu_s: CPU time of all threads, s.
        wall_s: s.
    """

    name: str
    step: Callable[[], object]
    begin: Callable[[], object] = lambda: None
    steps: int = 0
    cpu_s: float = 0.0
    wall_s: float = 0.0

    def take(self, steps: int, until: float) -> None:
        """Take steps, one at least and none after a CPU time of the process, s."""
        for _ in range(steps):
            self.begin()
            wall, cpu = time.perf_counter(), time.process_time()
            self.step()
            self.wall_s += time.perf_counter() - wall
            self.cpu_s += time.process_time() - cpu
            self.steps += 1
            if time.process_time() > until:
                break

    @property
    def per_cpu_s(self) -> float:
        """Steps in a second of CPU time."""
        return self.steps / max(self.cpu_s, 1e-9)

    @property
    def per_wall_s(self) -> float:
        """Steps in a second."""
        return self.steps / max(self.wall_s, 1e-9)


class Endless:
    """Closed loop whose episode begins anew where it ends."""

    def __init__(self, scenario: str | Scenario, perception: Perception) -> None:
        self.loop = ClosedLoop(scenario, perception, settings=LoopSettings(duration_s=60.0))
        self.seed = 1
        self.seconds = dict.fromkeys(STAGES, 0.0)
        self.actors: list[int] = []
        self.loop.start(self.seed)

    def begin(self) -> None:
        """Start the next episode where one has ended."""
        if self.loop.outcome is not None:
            self.seed += 1
            self.loop.start(self.seed)

    def step(self) -> None:
        """Drive one step."""
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
    return msgspec.structs.replace(scenario, demand=demand, warmup_s=90.0)


def modelled_episodes(
    scenario: str, detector_s: float, episodes: int, record_s: float, engine: str
) -> dict[str, float]:
    """Return episodes a minute of one thread, by an error model and by the detector that it is of.

    Args:
        scenario: of the episodes.
        detector_s: CPU time of a percept of the detector, s.
        episodes: to drive with the model.
        record_s: time of the episode with the detector that the model is fitted to, s.
        engine: execution of the detector.
    """
    recorded = ClosedLoop(scenario, open_perception("team", engine=engine), settings=LoopSettings(duration_s=record_s))
    recorded.run(1)
    errors = fit_errors([list(observed_episode(recorded.log(perception="team"), cooperative=True))], 0.1)
    model = ErrorModel(perception="team", cooperative=True, interval_s=0.1, classes=VEHICLES, conditions=(errors,))
    loop = ClosedLoop(scenario, ModelPerception(model, errors))
    loop.run(100)  # compiles
    percepts, perceive_s, began = 0, 0.0, time.process_time()
    for seed in range(episodes):
        loop.run(seed)
        percepts += len(loop.ticks)
        perceive_s += loop.seconds["perceive"]
    model_s = time.process_time() - began
    real_s = model_s - perceive_s + percepts * detector_s
    return {
        "episodes_min_model": round(60.0 * episodes / model_s, 1),
        "episodes_min_detector": round(60.0 * episodes / real_s, 2),
        "share_model_perceive": round(perceive_s / model_s, 3),
    }


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


def main(quick: bool = False, engine: str = "auto", scenario: str = "lta_truck") -> None:
    """Measure the closed loop.

    Args:
        quick: under 50 s of a core.
        engine: execution of the detector, `auto` or a key of `dsrc.models.storage.deploy.ENGINES`.
        scenario: of the detector's loop.
    """
    try:
        load_scenario(scenario)
    except UserError as error:
        sys.stderr.write(f"closed_loop: {error}\n")
        sys.exit(2)
    began = time.process_time()
    torch.set_num_threads(1)
    truth = Endless(busy_junction(), open_perception("truth"))
    steps = 24 if quick else 150
    runs = [Run("truth", truth.step, truth.begin), Run("highway-v0", rival())]
    until = time.process_time() + (14.0 if quick else 600.0)
    for _ in range(_TURNS):
        for run in runs:
            run.take(steps // _TURNS, until)
    truth.loop.close()  # one simulation of SUMO per process
    perception = open_perception("team", engine=engine)
    engine = perception.engine  # type: ignore[attr-defined]
    detector = Endless(scenario, perception)
    seeing = Run("detector", detector.step, detector.begin)
    detector.step()  # compiles
    detector.seconds = dict.fromkeys(STAGES, 0.0)
    seeing.take(steps, began + (30.0 if quick else 1e6))
    detector.loop.close()
    percept_s = detector.shares()["perceive"] * seeing.cpu_s / max(seeing.steps, 1)
    episodes = modelled_episodes(scenario, percept_s, 3 if quick else 20, 1.0 if quick else 10.0, engine)
    rows = []
    for run, own in ((runs[0], truth), (runs[1], None), (seeing, detector)):
        shares = [f"{100 * share:.0f} %" for share in own.shares().values()] if own else [""] * len(STAGES)
        rows.append((run.name, run.steps, f"{run.per_cpu_s:.1f}", f"{run.per_wall_s:.1f}", *shares))
    console = Console(highlight=False)
    head = ("variant", "steps", "steps per CPU s", "steps per s", *STAGES)
    console.print(Table.of(head, rows, title="closed loop, one thread"))
    agents = len(detector.loop.perception.senses.agents)  # type: ignore[attr-defined]
    console.print(
        f"real time is {REAL_TIME:g} steps a second; truth with {np.median(truth.actors):.0f} vehicles, detector in "
        f"{scenario} with {agents} sensing agents, engine {engine}"
    )
    console.print(
        f"episodes a minute and thread: {episodes['episodes_min_model']:g} by the error model, "
        f"{episodes['episodes_min_detector']:g} by the detector"
    )
    figures = {
        "steps_s_truth": round(runs[0].per_cpu_s, 2),
        "steps_s_truth_wall": round(runs[0].per_wall_s, 2),
        "steps_s_highway_env": round(runs[1].per_cpu_s, 2),
        "truth_over_highway_env": round(runs[0].per_cpu_s / runs[1].per_cpu_s, 2),
        "steps_s_detector": round(seeing.per_cpu_s, 2),
        "steps_s_detector_wall": round(seeing.per_wall_s, 2),
        **episodes,
        "vehicles": int(np.median(truth.actors)),
        "scenario": scenario,
        "sensing_agents": agents,
        "engine": engine,
        **{f"share_truth_{stage}": round(share, 3) for stage, share in truth.shares().items()},
        **{f"share_detector_{stage}": round(share, 3) for stage, share in detector.shares().items()},
    }
    sys.stdout.write(json.dumps(figures) + "\n")


if __name__ == "__main__":
    tyro.cli(main)
