"""Driver of an episode, whose failures end the episode and not the campaign."""

import copy
import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

from dsrc.closed_loop.types import Decision, Driver, EgoState, LaneMap, Percept, Tracks
from sim.errors import one_line, raised_text

_T = TypeVar("_T")
_STRONGEST_MPS2 = 1e6
_STRONGEST_RAD = 1.2
_MOST_LETTERS = 40


class CheckedDriver:
    """Driver whose decisions are checked; after a failure it is asked nothing more.

    Attributes:
        failure: why the driver failed, "" as long as it works.

    Args:
        limit_s: longest time of one call, s of wall time.
    """

    def __init__(self, driver: Driver, limit_s: float) -> None:
        self.failure = ""
        self._driver, self._limit_s = driver, limit_s

    def reset(self, lanes: LaneMap | None) -> None:
        """Begin an episode."""
        self.failure = ""
        self._done(lambda: self._driver.reset(lanes))

    def shown(self, percept: Percept | None) -> Percept | None:
        """Return a percept without its seen space, which a driver that looks at it has seen then, see `SeeingDriver`.

        Sweeps of a whole episode would not fit into memory.
        """
        if percept is None or (seen := percept.seen) is None:
            return percept
        if (see := getattr(self._driver, "see", None)) is not None:
            self._done(lambda: see(seen))
        return replace(percept, seen=None)

    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        """Return the decision for the next step; no acceleration after a failure."""
        # Copies, since a driver may compute in place in what it gets.
        return self._done(lambda: checked_decision(self._driver.decide(*copy.deepcopy((ego, tracks))))) or Decision(0.0)

    def _done(self, call: Callable[[], _T]) -> _T | None:
        """Return what a call returns; None where the driver fails in it, or has failed before."""
        if self.failure:
            return None
        began = time.perf_counter()
        try:
            found = call()
        except (Exception, SystemExit) as error:  # a driver of one's own may raise anything, and the campaign goes on
            self.failure = raised_text(error)
            return None
        if (took_s := time.perf_counter() - began) > self._limit_s:
            self.failure = f"took {took_s:.3g} s, limit {self._limit_s:g} s"
            return None
        return found


def checked_decision(found: Any) -> Decision:
    """Return a decision whose values are valid.

    Args:
        found: as returned by a driver.

    Raises:
        TypeError: it is something else, or its reason or track is.
        ValueError: the acceleration is not finite or a slip of units, or the steering beyond what wheels turn.
    """
    if not isinstance(found, Decision):
        raise TypeError(f"decide: expected a Decision, found {type(found).__name__}")
    if not math.isfinite(found.acceleration_mps2):
        raise ValueError(f"decide: expected a finite acceleration, found {found.acceleration_mps2}")
    if abs(found.acceleration_mps2) > _STRONGEST_MPS2:
        expected = f"an acceleration of at most {_STRONGEST_MPS2:g} m/s2 either way"
        raise ValueError(f"decide: expected {expected}, found {found.acceleration_mps2:g}")
    if found.steering_rad is not None and not abs(found.steering_rad) <= _STRONGEST_RAD:
        expected = f"steering up to {_STRONGEST_RAD} rad"
        raise ValueError(f"decide: expected {expected}, found {found.steering_rad}")
    if not isinstance(found.reason, str) or len(found.reason) > _MOST_LETTERS:
        expected = f"a reason of at most {_MOST_LETTERS} letters"
        raise TypeError(f"decide: expected {expected}, found {one_line(found.reason, 80)}")
    if int(found.track) != found.track or not -1 <= found.track < 1 << 62:
        raise ValueError(f"decide: expected the number of a track or -1, found {one_line(found.track, 80)}")
    return found
