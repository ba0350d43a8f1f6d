"""Truth: all road users within reach, or those in the sight of the ego's LiDAR."""

import numpy as np
import pytest

from dsrc.closed_loop.perception.truth import SightPerception, TruthPerception
from dsrc.closed_loop.types import Percept
from tests.dsrc.closed_loop.perception.toy import EGO, HELPER, HIDDEN, NEAR, SCENARIO, build, claim, instant, show


@pytest.fixture(autouse=True)
def _world(monkeypatch: pytest.MonkeyPatch) -> None:
    build(monkeypatch)


def percept(perception: TruthPerception, speed: float = 7.0) -> Percept:
    perception.reset(SCENARIO, EGO, 0)
    return perception.perceive(instant(0, speed), instant(1, speed), claim())


def test_truth_has_everybody_within_reach_and_nobody_else() -> None:
    assert percept(TruthPerception()).boxes.object_id.tolist() == [HELPER, NEAR, HIDDEN]
    assert percept(TruthPerception(reach_m=20.0)).boxes.object_id.tolist() == [NEAR]


def test_truth_is_sure_and_knows_velocities() -> None:
    seen = percept(TruthPerception())
    assert seen.time_s == pytest.approx(0.1)
    assert seen.score.tolist() == [1.0] * 3
    np.testing.assert_allclose(seen.velocity, [[0, 0], [0, 0], [7, 0]], atol=1e-9)
    assert seen.boxes.center[2, 0] == pytest.approx(30.7)


def test_a_wall_hides_from_sight_what_truth_knows() -> None:
    assert percept(SightPerception()).boxes.object_id.tolist() == [NEAR]


def test_what_a_helper_sees_is_in_the_sight_of_the_team_and_no_lie_is() -> None:
    seen = percept(SightPerception(cooperative=True))
    assert seen.boxes.object_id.tolist() == [HELPER, NEAR, HIDDEN]
    assert seen.seen is not None and [view.agent_id for view in seen.seen.views] == [EGO, HELPER]


def test_sight_without_a_wall_is_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    from tests.sensors.fakes import ground

    show(monkeypatch, lambda scenario, seed: ground())
    assert percept(SightPerception(least_points=1)).boxes.object_id.tolist() == [HELPER, NEAR, HIDDEN]


def test_who_has_no_helpers_hears_no_lie() -> None:
    for perception in (TruthPerception(), SightPerception()):
        assert not perception.cooperative
        assert len(percept(perception).boxes) <= 3
