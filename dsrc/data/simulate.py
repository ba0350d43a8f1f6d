"""Simulation of a drive: traffic from its log, sweeps cast frame by frame."""

import logging
import math
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.data.drive_folder import TRAFFIC_LOG, WORLD
from sensors.frame import Frame
from sensors.recording.record import Recording, record
from sim.errors import DataError, complaint
from sim.files import replacing
from sim.scenario import Area, Scenario
from sim.traffic.log import TrafficLog
from sim.traffic.replay import ReplayTraffic
from sim.world.world_file import load_world, save_world, shapes_of

PLAN_S = 3.0
"""Length of an agent's plan."""
PLAN_STEP_S = 0.5
REACH_M = 350.0
"""Margin of the logged area around the area of the agents: farther than any sensor sees."""

_log = logging.getLogger(__name__)


class SimulatedDrive:
    """Frames and plans of a simulated drive.

    Args:
        recording: the sensors along the drive.
        log: its traffic, at least `PLAN_S` longer than the drive.
        interval_s: time between frames, s.
    """

    def __init__(self, recording: Recording, log: TrafficLog, interval_s: float) -> None:
        self.recording = recording
        self._log = log
        self._stride = round(interval_s / log.step_s)

    def frame(self, index: int) -> Frame:
        """Return one frame."""
        return self.recording.frame(index)

    def plans(self, index: int) -> dict[int, NDArray[np.float64]]:
        """Return per vehicle (K, 3) x, y, m, and speed, m/s, every `PLAN_STEP_S` of its coming path."""
        ahead = [round(t / self._log.step_s) for t in np.arange(PLAN_STEP_S, PLAN_S + 1e-9, PLAN_STEP_S)]
        plans: dict[int, list[tuple[float, float, float]]] = {agent: [] for agent in self.recording.vehicles}
        for step in ahead:
            if index * self._stride + step >= len(self._log):
                break
            actors = self._log[index * self._stride + step]
            for agent, path in plans.items():
                row = int(np.searchsorted(actors.boxes.object_id, agent))
                if row < len(actors) and actors.boxes.object_id[row] == agent:
                    x, y = actors.boxes.center[row, :2].tolist()
                    path.append((x, y, float(np.hypot(*actors.velocity[row]))))
        return {agent: np.array(path, np.float64).reshape(-1, 3) for agent, path in plans.items()}


@contextmanager
def open_simulated(
    scenario: Scenario,
    seed: int,
    frames: int,
    interval_s: float,
    log: Path,
    visibility: bool = True,
    recorded: Path | None = None,
    threads: int | None = None,
    more: dict | None = None,
) -> Iterator[SimulatedDrive]:
    """Open the frames of a drive.

    Traffic is simulated and the static world built only where their files are missing; frames depend on the files
    alone, so that a resumed drive, a copied one and one of another sensor see the same.

    Args:
        interval_s: time between frames, s.
        log: path of the traffic log; the world is beside it.
        recorded: a folder whose traffic log, and world if there is one, are copied instead.
        threads: see `sensors.scan.lidar.scan_all`.
        more: further entries of a new log's settings.

    Raises:
        DataError: a recorded file is damaged or of another drive.
        ScenarioError: the world must be built and a file that it needs is missing.
    """
    if recorded is not None:
        _copy(recorded, log.parent, log.name)
    if not log.exists():
        _simulate_traffic(scenario, seed, frames, interval_s, log, more or {})
    steps, world = TrafficLog.load(log), log.with_name(WORLD)
    if not world.exists():
        _build_world(scenario, seed, steps, world)
    needed = (frames - 1) * round(interval_s / steps.step_s) + 1
    if len(steps) < needed:
        raise DataError(complaint(log, "traffic log", f"at least {needed} steps for {frames} frames", len(steps)))
    kept = load_world(world)
    with ReplayTraffic(log, steps) as traffic:
        recording = record(
            traffic,
            kept.static,
            scenario,
            seed,
            frames,
            interval_s,
            body_mesh=kept.body_mesh,
            visibility=visibility,
            threads=threads,
        )
    yield SimulatedDrive(recording, steps, interval_s)


def _copy(recorded: Path, folder: Path, log_name: str) -> None:
    if not (recorded / TRAFFIC_LOG).is_file():
        raise DataError(complaint(recorded, TRAFFIC_LOG, "an existing traffic log", "no such file"))
    for source, name in ((recorded / TRAFFIC_LOG, log_name), (recorded / WORLD, WORLD)):
        if source.is_file() and not (folder / name).exists():
            with replacing(folder / name) as temporary:
                shutil.copyfile(source, temporary)


def _build_world(scenario: Scenario, seed: int, log: TrafficLog, path: Path) -> None:
    from sim.world.build import build_world

    models = {model for step in range(len(log)) for model in log[step].model}
    save_world(build_world(scenario, seed), shapes_of(models), path)


def _simulate_traffic(scenario: Scenario, seed: int, frames: int, interval_s: float, path: Path, more: dict) -> None:
    from sim.world.standing import open_standing

    about = {
        "scenario": _non_defaults(scenario),
        "seed": int(seed),
        "frames": int(frames),
        "interval_s": float(interval_s),
        **more,
    }
    with open_standing(scenario, seed) as traffic:
        log = TrafficLog(traffic.step_s, about)
        log.append(traffic.actors)
        steps = (frames - 1) * round(interval_s / traffic.step_s) + math.ceil(PLAN_S / traffic.step_s)
        _log.info("simulating %d steps of traffic", steps)
        for _ in range(steps):
            log.append(traffic.step())
    area = _reach(scenario)
    (log if area is None else log.within(area)).save(path)


def _non_defaults(value: object) -> Any:
    """Return settings as plain values without defaults, so that later versions can add settings."""
    if isinstance(value, msgspec.Struct):
        fields = {field.name: field for field in msgspec.structs.fields(value)}
        usual = {
            name: field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()
            for name, field in fields.items()
        }
        held = {name: getattr(value, name) for name in fields}
        return {name: _non_defaults(item) for name, item in held.items() if item != usual[name]}
    if isinstance(value, tuple | list):
        return [_non_defaults(item) for item in value]
    return {key: _non_defaults(item) for key, item in value.items()} if isinstance(value, dict) else value


def _reach(scenario: Scenario) -> Area | None:
    """Return the area to log around all places of sensors; None for the whole world."""
    area = scenario.network.area_m
    if area is None:
        return None
    corners = [area[:2], area[2:], *(unit.xyz_m[:2] for unit in scenario.agents.roadside)]
    low, high = np.min(corners, axis=0) - REACH_M, np.max(corners, axis=0) + REACH_M
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
