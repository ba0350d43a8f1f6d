"""Faults of an ego's localisation, computing and actuation over an episode."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.types import EgoState, Percept
from dsrc.faults.fault import Fault, Faults
from dsrc.faults.localisation import believed_from_true, pose_error
from sim.boxes import Boxes
from sim.geometry import pose_matrix
from sim.streams import Stream, random_generator

Command = tuple[float, float | None]
"""Acceleration, m/s2, and angle of the front wheels, rad; None of one that does not steer."""


class EgoFaults:
    """Faults of one ego, of which `acted` alone has a memory: commands.

    Args:
        faults: those of sensors and radio do not matter.
        seed: of the episode.
        ego_id: the ego.
        step_s: traffic step, s.
    """

    def __init__(self, faults: Faults, seed: int, ego_id: int, step_s: float) -> None:
        self._faults, self._seed, self._ego_id, self._step_s = faults, seed, ego_id, step_s
        self._asked: list[Command] = []
        self._done: Command = 0.0, None

    def latency_s(self, time_s: float, usual_s: float) -> float:
        """Return the time from a measurement at `time_s` to its percept, s."""
        return next((fault.value for fault in self._there("latency", time_s)), usual_s)

    def missed(self, time_s: float) -> bool:
        """Whether the detector's cycle at a time is missed: nothing comes of what was measured then."""
        return any(self._drawn(fault, time_s) for fault in self._there("missed_cycles", time_s))

    def believed(self, ego: EgoState, time_s: float) -> EgoState:
        """Return the ego's state as it believes it to be at a time of the episode; its route is that of the map."""
        for fault in self._there("speed_reading", time_s):
            speed, gained = ego.speed_mps * fault.value, ego.acceleration_mps2 * fault.value
            ego = replace(ego, speed_mps=speed, acceleration_mps2=gained)
        error = pose_error(self._faults, self._seed, self._ego_id, self._ego_id, time_s)
        if not error.any():
            return ego
        return replace(
            ego,
            box=ego.box.transform(believed_from_true(_body(ego.box), error)),
            route=_begun(ego.route, float(error[0])),
            lights=tuple(replace(light, distance_m=light.distance_m - float(error[0])) for light in ego.lights),
        )

    def believed_percept(self, percept: Percept, ego: Boxes, time_s: float) -> Percept:
        """Return what is perceived by the ego at a box in the world as the ego believes it."""
        error = pose_error(self._faults, self._seed, self._ego_id, self._ego_id, time_s)
        if not error.any():
            return percept
        believed = believed_from_true(_body(ego), error)
        return replace(percept, boxes=percept.boxes.transform(believed), velocity=percept.velocity @ believed[:2, :2].T)

    def acted(self, wanted: Command, time_s: float) -> Command:
        """Return what a vehicle makes of the commands so far; asked once a step, in order.

        Without steering it keeps its route, or returns to it, at once: wheels that begin to steer stand straight.

        Args:
            wanted: the newest command.
        """
        self._asked.append(wanted)
        target, steering = wanted
        for fault in self._there("control_delay", time_s):
            before = len(self._asked) - 1 - round(fault.value / self._step_s)
            target, steering = self._asked[before] if before >= 0 else (0.0, None)
        last, turned = self._done
        if any(self._drawn(fault, time_s) for fault in self._there("control_drop", time_s)):
            target, steering = self._done
        else:
            for fault in self._there("brake_gain", time_s):
                target *= fault.value if target < 0.0 else 1.0
            for fault in self._there("steering_gain", time_s):
                steering = None if steering is None else steering * fault.value
        for fault in self._there("control_lag", time_s):
            if fault.value > 0.0:
                share = 1.0 - math.exp(-self._step_s / fault.value)
                target = last + (target - last) * share
                steering = None if steering is None else (turned or 0.0) + (steering - (turned or 0.0)) * share
        self._done = target, steering
        return self._done

    def _there(self, kind: str, time_s: float) -> Iterator[Fault]:
        return (fault for fault in self._faults if fault.kind == kind and fault.at(time_s))

    def _drawn(self, fault: Fault, time_s: float) -> bool:
        step = 1 + round(time_s / self._step_s)
        rng = random_generator(self._seed, Stream.FAULT, fault.kind, step, self._ego_id)
        return float(rng.random()) < fault.value


def _body(box: Boxes) -> NDArray[np.float64]:
    return np.asarray(pose_matrix(box.center[0], box.yaw[0]))


def _begun(route: NDArray[np.float64], ahead_m: float) -> NDArray[np.float64]:
    """Return a route that begins so much further along it; where that is behind, it is continued straight back."""
    steps = np.linalg.norm(np.diff(route, axis=0), axis=1)
    if len(route) < 2 or not steps[0] > 0.0:
        return route
    if ahead_m < 0.0:
        return np.concatenate([[route[0] + (route[1] - route[0]) / steps[0] * ahead_m], route])
    along = np.concatenate([[0.0], np.cumsum(steps)])
    begin_m = min(ahead_m, float(along[-1]) - 1e-3)
    first = [float(np.interp(begin_m, along, axis)) for axis in route.T]
    return np.concatenate([[first], route[along > begin_m]])
