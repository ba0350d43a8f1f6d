"""Drivers of others in the loop: what they raise is told, and goes no further."""

from typing import Any

import numpy as np
import pytest

from dsrc.closed_loop.driving.own.checked import CheckedDriver
from dsrc.closed_loop.types import Decision, EgoState, Tracks
from tests.dsrc.closed_loop.driving.world import Other, ego_at, tracks_of


class Leaving:
    """Driver that ends the process or raises, by its error."""

    def __init__(self, error: BaseException) -> None:
        self.error = error

    def reset(self, lanes: Any) -> None:
        raise self.error


@pytest.mark.parametrize("error", [SystemExit(3), ValueError("no\nroad")])
def test_what_a_driver_raises_is_its_failure_in_one_line(error: BaseException) -> None:
    wheel = CheckedDriver(Leaving(error), 60.0)  # type: ignore[arg-type]
    wheel.reset(None)
    assert wheel.failure.startswith(type(error).__name__) and "\n" not in wheel.failure


def test_an_interruption_is_no_failure_of_the_driver() -> None:
    with pytest.raises(KeyboardInterrupt):
        CheckedDriver(Leaving(KeyboardInterrupt()), 60.0).reset(None)  # type: ignore[arg-type]


class Spoiling:
    """Driver that computes in place in what it gets."""

    def reset(self, lanes: Any) -> None: ...

    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        ego.box.center[:] = 0.0
        tracks.boxes.center[:] = 0.0
        return Decision(1.0)


def test_what_a_driver_gets_is_its_own() -> None:
    ego, tracks = ego_at(40.0, 8.0), tracks_of([Other(60.0, 0.0)], 0.0)
    before = ego.box.center.copy(), tracks.boxes.center.copy()
    wheel = CheckedDriver(Spoiling(), 60.0)
    assert wheel.decide(ego, tracks).acceleration_mps2 == 1.0 and wheel.failure == ""
    assert np.array_equal(ego.box.center, before[0]) and np.array_equal(tracks.boxes.center, before[1])
