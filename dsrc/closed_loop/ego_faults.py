"""Faults of an ego's computing and actuation over an episode."""

import math
from collections.abc import Iterator

from dsrc.faults.fault import Fault, Faults
from sim.streams import Stream, random_generator


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
        self._asked: list[float] = []
        self._done = 0.0

    def latency_s(self, time_s: float, usual_s: float) -> float:
        """Return the time from a measurement at `time_s` to its percept, s."""
        return next((fault.value for fault in self._there("latency", time_s)), usual_s)

    def missed(self, time_s: float) -> bool:
        """Whether the detector's cycle at a time is missed: nothing comes of what was measured then."""
        return any(self._drawn(fault, time_s) for fault in self._there("missed_cycles", time_s))

    def acted(self, wanted_mps2: float, time_s: float) -> float:
        """Return the acceleration that a vehicle makes of the commands so far, m/s2; asked once a step, in order.

        Args:
            wanted_mps2: the newest command.
        """
        self._asked.append(wanted_mps2)
        target = wanted_mps2
        for fault in self._there("control_delay", time_s):
            before = len(self._asked) - 1 - round(fault.value / self._step_s)
            target = self._asked[before] if before >= 0 else 0.0
        if any(self._drawn(fault, time_s) for fault in self._there("control_drop", time_s)):
            target = self._done
        else:
            for fault in self._there("brake_gain", time_s):
                target *= fault.value if target < 0.0 else 1.0
        for fault in self._there("control_lag", time_s):
            if fault.value > 0.0:
                target = self._done + (target - self._done) * (1.0 - math.exp(-self._step_s / fault.value))
        self._done = target
        return target

    def _there(self, kind: str, time_s: float) -> Iterator[Fault]:
        return (fault for fault in self._faults if fault.kind == kind and fault.at(time_s))

    def _drawn(self, fault: Fault, time_s: float) -> bool:
        step = 1 + round(time_s / self._step_s)
        rng = random_generator(self._seed, Stream.FAULT, fault.kind, step, self._ego_id)
        return float(rng.random()) < fault.value
