"""Faults of sensors, and of their agents' localisation, on the sweeps of frames.

Draws are those of the agent, the kind and the frame's number, whatever the numbers of the fault: a larger share takes
what a smaller one takes, and more.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dsrc.faults.fault import Fault, Faults
from dsrc.faults.kinds import Blocked, Dirt, Misalignment, Severity, Share
from dsrc.faults.localisation import believed_from_true, pose_error
from sensors.corruptions.apply import count_lost
from sensors.frame import AgentFrame, Frame
from sensors.sweep import MOVED, SCATTERED, Sweep
from sim.geometry import invert, pose_matrix, transform_points
from sim.streams import Stream, random_generator

_CELL_DEG = 5.0
"""Size of a spot of dirt, as seen from the sensor."""


class SensorFaults:
    """Faults of the sensors of an episode, each acting on what those before it left.

    Args:
        faults: those that act neither on sensors nor on localisation do not matter.
        seed: of the episode.
    """

    def __init__(self, faults: Faults, seed: int) -> None:
        self._faults = tuple(one for one in faults if one.what.place == "sensor")
        self._lost = tuple(one for one in faults if one.what.place == "localisation")
        self._seed = seed
        self._last: dict[tuple[int, int], Sweep] = {}

    def apply(self, frame: Frame, ego_id: int, time_s: float = math.inf) -> Frame:
        """Return the frame with the faults that are there; frames of an episode come in their order.

        Args:
            time_s: of the episode; infinity where time has no meaning: what grows is grown.
        """
        for number, fault in enumerate(self._faults):
            there = fault.at(time_s)
            if isinstance(fault.settings, Severity):
                present = [agent.agent_id for agent in frame.agents]
                frame = fault.condition.among(present).apply(frame, self._seed, ego_id) if there else frame
                continue
            sweeps = [agent.sweep for agent in frame.agents]
            for row, agent in enumerate(frame.agents):
                if fault.on(agent.agent_id, ego_id):
                    sweeps[row] = self._sweep((number, agent.agent_id), fault, agent, frame.index, time_s, there)
            frame = frame.with_sweeps(sweeps)
        if not self._lost:
            return frame
        own_s = frame.time_s if time_s == math.inf else time_s
        return frame.with_sweeps([self._mislocated(agent, ego_id, own_s) for agent in frame.agents])

    def _mislocated(self, agent: AgentFrame, ego_id: int, time_s: float) -> Sweep:
        """Return the sweep of an agent at the place where it believes to be."""
        error = pose_error(self._lost, self._seed, agent.agent_id, ego_id, time_s)
        if not error.any():
            return agent.sweep
        believed = believed_from_true(agent.world_from_body, error)
        return replace(agent.sweep, world_from_lidar=believed @ agent.sweep.world_from_lidar)

    def _sweep(
        self, key: tuple[int, int], fault: Fault, agent: AgentFrame, index: int, time_s: float, there: bool
    ) -> Sweep:
        """Return the sweep of an agent that the fault acts on."""
        sweep, settings = agent.sweep, fault.settings
        if fault.kind == "freeze":
            if not there or key not in self._last:
                self._last[key] = sweep
            last = self._last[key]
            frozen = replace(last, world_from_lidar=sweep.world_from_lidar, time_s=sweep.time_s, path=sweep.path)
            return frozen if there else sweep
        if not there:
            return sweep
        if isinstance(settings, Misalignment):
            return _misaligned(sweep, settings)
        if isinstance(settings, Blocked):
            aside = np.abs(_azimuth(sweep, settings.middle_deg))
            kept = (aside > math.radians(0.5 * settings.width_deg)) | (settings.width_deg == 0.0)
        elif isinstance(settings, Dirt):
            grown = 1.0 if settings.growth_s == 0.0 else min(1.0, (time_s - fault.from_s) / settings.growth_s)
            kept = self._clarity(fault.kind, sweep, agent.agent_id) >= settings.share * grown
        elif isinstance(settings, Share):
            draw = random_generator(self._seed, Stream.FAULT, fault.kind, 1 + index, agent.agent_id).random()
            kept = np.full(len(sweep), draw >= settings.share)
        else:
            raise TypeError(fault.kind)
        return count_lost(sweep, sweep[kept])

    def _clarity(self, kind: str, sweep: Sweep, agent_id: int) -> NDArray[np.float64]:
        """Return (P,) the covered share of the field from which on the spot of each point is dirty."""
        rng = random_generator(self._seed, Stream.FAULT, kind, 0, agent_id)
        spots = rng.random((round(360.0 / _CELL_DEG), round(180.0 / _CELL_DEG)))
        flat = np.hypot(sweep.points[:, 0], sweep.points[:, 1])
        elevation = np.arctan2(sweep.points[:, 2], flat)
        turn = np.degrees(_azimuth(sweep, 0.0)) + 180.0
        column = np.minimum((turn / _CELL_DEG).astype(int), spots.shape[0] - 1)
        row = np.minimum(((np.degrees(elevation) + 90.0) / _CELL_DEG).astype(int), spots.shape[1] - 1)
        return spots[column, row]


def _azimuth(sweep: Sweep, middle_deg: float) -> NDArray[np.float64]:
    """Return (P,) angles of points from a direction, counter-clockwise, rad, -pi to pi."""
    angle = np.arctan2(sweep.points[:, 1], sweep.points[:, 0]).astype(np.float64) - math.radians(middle_deg)
    return np.mod(angle + math.pi, 2.0 * math.pi) - math.pi


def _misaligned(sweep: Sweep, settings: Misalignment) -> Sweep:
    """Return what a sensor measures that sits otherwise than its calibration says; it hits the same surfaces."""
    place = [1e-2 * settings.ahead_cm, 1e-2 * settings.aside_cm, 1e-2 * settings.up_cm]
    turn = [math.radians(angle) for angle in (settings.yaw_deg, settings.pitch_deg, settings.roll_deg)]
    said_from_true = pose_matrix(place, *turn)
    points = transform_points(invert(said_from_true), sweep.points.astype(np.float64)).astype(np.float32)
    fate = np.where(sweep.fate != SCATTERED, MOVED, sweep.fate).astype(np.uint8)
    return replace(sweep, points=points, fate=fate)
