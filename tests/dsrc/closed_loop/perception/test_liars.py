"""Liars speak before the channel: what they claim is in their own sweep and takes the way of every message."""

import numpy as np
import pytest
from msgspec.structs import replace as changed

from dsrc.closed_loop.perception.detector import DetectorPerception
from dsrc.closed_loop.perception.liars import false_actors
from dsrc.closed_loop.types import Percept
from sensors.corruptions import Condition
from sensors.frame import Frame
from sim.radio import PRESETS, ChannelSpec
from tests.dsrc.closed_loop.perception.toy import EGO, HELPER, LIE, SCENARIO, Knowing, build, claim, instant


@pytest.fixture(autouse=True)
def _world(monkeypatch: pytest.MonkeyPatch) -> None:
    build(monkeypatch)


def percepts(
    channel: ChannelSpec = PRESETS["ideal"],
    lies: bool = True,
    cooperative: bool = True,
    condition: Condition | None = None,
    steps: int = 1,
) -> list[Percept]:
    """Percepts of a detector that reports a car at the place of the lie if it has points there."""
    perception = DetectorPerception(Knowing(LIE), cooperative=cooperative, condition=condition, channel=channel)
    perception.reset(SCENARIO, EGO, 0)
    claims = claim() if lies else {}
    return [perception.perceive(instant(k), instant(k + 1), claims) for k in range(steps)]


def test_a_ghost_is_found_where_a_helper_claims_it() -> None:
    (seen,) = percepts()
    assert len(seen.boxes) == 1
    np.testing.assert_allclose(seen.boxes.center[0, :2], LIE[0][:2], atol=1e-3)
    assert len(percepts(lies=False)[0].boxes) == 0


def test_the_ego_alone_hears_no_ghost() -> None:
    assert len(percepts(cooperative=False)[0].boxes) == 0


def test_no_ghost_through_a_channel_that_loses_all() -> None:
    lossy = changed(PRESETS["its-g5-6"], packet_loss=1.0)
    assert [len(percept.boxes) for percept in percepts(lossy, steps=3)] == [0, 0, 0]
    assert not any(link.received for percept in percepts(lossy) for link in percept.links)


def test_a_ghost_is_as_late_as_every_message() -> None:
    late = changed(PRESETS["ideal"], medium="fixed", delay_s=0.2)
    assert [len(percept.boxes) for percept in percepts(late, steps=4)] == [0, 0, 1, 1]


def test_a_corruption_of_the_liar_acts_on_its_lie(monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(
        frame: Frame,
        kind: str,
        severity: int,
        seed: int,
        family: str,
        *,
        ego_id: int,
        corrupted_agents: str,
        **_: object,
    ) -> Frame:
        assert corrupted_agents == "helpers"
        return frame.with_sweeps([a.sweep if a.agent_id == ego_id else a.sweep[:0] for a in frame.agents])

    monkeypatch.setattr("sensors.corruptions.condition.corrupt_frame", gone)
    assert len(percepts(condition=Condition("fog", 3, agents="helpers"))[0].boxes) == 0


def test_a_claim_of_somebody_who_sends_nothing_reaches_nobody() -> None:
    now = instant(0)
    assert list(false_actors(claim(), now, [HELPER])) == [HELPER]
    assert false_actors(claim(), now, [EGO]) == {}
    assert false_actors({"nobody": claim()["helper"]}, now, [HELPER]) == {}


def test_a_roadside_unit_lies_by_its_number() -> None:
    lie = claim()["helper"]
    assert list(false_actors({"roadside": lie}, instant(0), [HELPER, -1, -2])) == [-1]
    assert list(false_actors({"roadside 2": lie}, instant(0), [HELPER, -1, -2])) == [-2]
