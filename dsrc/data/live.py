"""The frames of a drive straight from the simulation: traffic from its log, sweeps cast when asked for."""

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sensors.frame import Frame
from sensors.record import Recording, record
from sim.scenario import Scenario
from sim.traffic.log import TrafficLog
from sim.traffic.replay import ReplayTraffic

PLAN_S = 3.0
"""How far ahead an agent's plan reaches."""
PLAN_STEP_S = 0.5

_log = logging.getLogger(__name__)


class Live:
    """Frames and plans of a recorded drive.

    Args:
        recording: the drive.
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
        """Return per vehicle (K, 3) x, y, m, and speed, m/s, every `PLAN_STEP_S` of the way it is going to take."""
        ahead = [round(t / self._log.step_s) for t in np.arange(PLAN_STEP_S, PLAN_S + 1e-9, PLAN_STEP_S)]
        plans: dict[int, list[tuple[float, float, float]]] = {agent: [] for agent in self.recording.vehicles}
        for step in ahead:
            if index * self._stride + step >= len(self._log):
                break
            actors = self._log[index * self._stride + step]
            for agent, way in plans.items():
                row = int(np.searchsorted(actors.boxes.object_id, agent))
                if row < len(actors) and actors.boxes.object_id[row] == agent:
                    x, y = actors.boxes.center[row, :2].tolist()
                    way.append((x, y, float(np.hypot(*actors.velocity[row]))))
        return {agent: np.array(way, np.float64).reshape(-1, 3) for agent, way in plans.items()}


@contextmanager
def open_live(
    scenario: Scenario, seed: int, frames: int, interval_s: float, log: Path, visibility: bool = True
) -> Iterator[Live]:
    """Open the frames of a drive; its traffic is simulated only when there is no log yet.

    Args:
        scenario: the scenario.
        seed: of everything random.
        frames: number of frames.
        interval_s: time between frames, s.
        log: path of the traffic log.
        visibility: measure visible fractions.
    """
    from sim.world.build import build_world

    if not log.exists():
        _simulate_traffic(scenario, seed, frames, interval_s, log)
    with ReplayTraffic(log) as traffic:
        world = build_world(scenario, seed)
        recording = record(traffic, world, scenario, seed, frames, interval_s, visibility=visibility)
    yield Live(recording, TrafficLog.load(log), interval_s)


def _simulate_traffic(scenario: Scenario, seed: int, frames: int, interval_s: float, path: Path) -> None:
    from sim.traffic.choose import open_traffic

    with open_traffic(scenario, seed) as traffic:
        log = TrafficLog(traffic.step_s)
        log.append(traffic.actors)
        steps = (frames - 1) * round(interval_s / traffic.step_s) + math.ceil(PLAN_S / traffic.step_s)
        _log.info("simulating %d steps of traffic", steps)
        for _ in range(steps):
            log.append(traffic.step())
    log.save(path)
