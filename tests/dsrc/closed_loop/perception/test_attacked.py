"""Helpers that share clouds, or features of them, lie in their points as they would in their boxes."""

import numpy as np
import pytest

from dsrc.closed_loop.perception.detector import DetectorPerception
from dsrc.closed_loop.types import EgoState
from dsrc.faults.fault import parse_faults
from sim.errors import SettingsError
from sim.traffic.base import Limits
from tests.dsrc.closed_loop.perception.toy import EGO, HELPER, PLACES, SCENARIO, Knowing, build, instant

GHOST, HIDDEN, NEAR = [[25.0, 0.0, 0.0]], [PLACES[3]], [PLACES[2]]


@pytest.fixture(autouse=True)
def _world(monkeypatch: pytest.MonkeyPatch) -> None:
    build(monkeypatch)


def found(places: list[list[float]], attack: str, steps: int = 1) -> list[int]:
    """Cars that a detector of given places finds in each percept of an ego that drives ahead."""
    perception = DetectorPerception(Knowing(places), faults=parse_faults(attack, "test") if attack else ())
    perception.reset(SCENARIO, EGO, 0)
    counts = []
    for step in range(steps):
        before, now = instant(step), instant(step + 1)
        ahead = np.array([[0.0, 0.0], [100.0, 0.0]])
        limits = Limits(speed_mps=13.9, acceleration_mps2=2.6, deceleration_mps2=7.5)
        perception.aim(EgoState(now.time_s, now.boxes[:1], 0.0, 0.0, ahead, limits, (), 0.0))
        counts.append(len(perception.perceive(before, now, {}).boxes))
    return counts


def test_a_ghost_has_the_points_that_its_liar_would_measure() -> None:
    assert found(GHOST, "") == [0] and found(GHOST, "ghost:1,ahead_m=25") == [1]
    assert found(GHOST, f"ghost:1,ahead_m=25 on {HELPER}") == [1]


def test_an_attack_has_its_time() -> None:
    assert found(GHOST, "ghost:1,ahead_m=25 from 0.2 s to 0.4 s", steps=6) == [0, 0, 1, 1, 0, 0]


def test_who_removes_takes_the_hidden_car_and_not_the_one_that_the_ego_sees() -> None:
    assert found(HIDDEN, "") == [1] and found(HIDDEN, "remove") == [0]
    assert found(NEAR, "remove") == [1]


def test_a_false_pose_puts_the_hidden_car_elsewhere() -> None:
    assert found(HIDDEN, "false_pose:aside_m=4") == [0]
    assert found([[30.0, -4.0, 0.0]], "false_pose:aside_m=4") == [
        1
    ]  # the helper looks back, its left is the ego's right


def test_nobody_lies_before_the_ego_has_told_where_it_is() -> None:
    perception = DetectorPerception(Knowing(GHOST), faults=parse_faults("ghost + remove", "test"))
    perception.reset(SCENARIO, EGO, 0)
    perception.overhear(instant(0), instant(1), {})
    assert len(perception.perceive(instant(1), instant(2), {}).boxes) == 0


@pytest.mark.parametrize(
    ("attack", "cooperative", "said"),
    [
        ("replay:1", True, "expected agents that tell boxes.* with a defence or replay, found one that fuses clouds"),
        ("ghost", False, "helpers: expected some, with an attack or a defence, found none"),
    ],
)
def test_an_attack_that_cannot_be_is_told(attack: str, cooperative: bool, said: str) -> None:
    with pytest.raises(SettingsError, match=said):
        DetectorPerception(Knowing(HIDDEN), cooperative=cooperative, faults=parse_faults(attack, "test"))


def test_the_ego_is_no_liar() -> None:
    with pytest.raises(
        SettingsError, match=r"fault 'ghost:1 on 1000': expected ids among the helpers \[1001\], found 1000"
    ):
        found(GHOST, f"ghost on {EGO}")
