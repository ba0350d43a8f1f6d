"""Several egos in one traffic: alone as ever, together without crashes, and eyes of each other."""

from pathlib import Path
from typing import Any

import pytest

from dsrc.closed_loop.loop import ClosedLoop, LoopSettings
from dsrc.closed_loop.perception.open import open_perception
from dsrc.closed_loop.perception.truth import SightPerception
from dsrc.closed_loop.team import TeamLoop
from dsrc.closed_loop.types import Decision, EgoState, LaneMap, Outcome, Tracks
from sim.errors import SettingsError, TrafficError


def team_of(count: int, scenario: str = "four_way", duration_s: float = 8.0, **more: Any) -> TeamLoop:
    eyes = [open_perception("truth") for _ in range(count)]
    return TeamLoop(scenario, eyes, settings=LoopSettings(duration_s=duration_s), **more)


class Racer:
    """Drives at the limit, whatever comes."""

    def reset(self, lanes: LaneMap | None) -> None:
        pass

    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        return Decision(10.0 * (ego.limits.speed_mps - ego.speed_mps))


def test_egos_drive_with_the_default_driver_and_the_truth_without_a_crash() -> None:
    team = team_of(3)
    outcomes = team.run(0)
    assert len(outcomes) == 3 and Outcome.CRASHED not in outcomes and Outcome.DRIVER_FAILED not in outcomes
    egos = [loop.ego_id for loop in team.loops]
    assert len(set(egos)) == 3
    for loop in team.loops:
        assert set(egos) <= set(loop.ticks[0].actors.boxes.object_id.tolist())
        assert all(tick.decision.reason != "outside" for tick in loop.ticks)
    assert max(loop.tick.ego.progress_m for loop in team.loops) > 30.0


def test_a_team_of_one_is_a_single_ego_byte_for_byte(tmp_path: Path) -> None:
    single = ClosedLoop("four_way", open_perception("truth"), settings=LoopSettings(duration_s=2.0))
    single.run(0)
    team = team_of(1, duration_s=2.0)
    team.run(0)
    paths = [loop.log().save(tmp_path / f"{name}.npz") for name, loop in (("a", single), ("b", team.loops[0]))]
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_an_ego_obeys_its_own_command_alone_and_a_crashed_one_stands_in_the_way() -> None:
    """In `ima_building` the agents are the ego and its helper, which stands; the ego races into the conflict."""
    team = team_of(2, "ima_building", 15.0, drivers=[Racer(), Racer()])
    team.start(1)
    while team.loops[0].outcome is None:
        team.advance({1: -9.0})
    raced, other = team.loops
    assert raced.outcome is Outcome.CRASHED and raced.tick.ego.progress_m > 50.0 and other.tick.ego.progress_m == 0.0
    assert team.running == (1,)
    for _ in range(20):
        team.advance({1: -9.0})
    assert len(other.ticks) == len(raced.ticks) + 20
    assert other.traffic.speed(raced.ego_id) == pytest.approx(0.0, abs=0.1)
    assert raced.ego_id in other.tick.actors.boxes.object_id
    while team.running:
        team.advance({1: -9.0})
    with pytest.raises(TrafficError, match="found one that ended"):
        team.advance()
    team.close()


def test_egos_with_helpers_are_each_others() -> None:
    eyes = [SightPerception(cooperative=True) for _ in range(2)]
    team = TeamLoop("four_way", eyes)
    team.start(0)
    egos = {loop.ego_id for loop in team.loops}
    for loop, one in zip(team.loops, eyes, strict=True):
        assert one._senses.agents[0] == loop.ego_id
        assert {agent for agent in one._senses.agents if agent > 0} == egos
    team.close()


def test_wrong_teams_are_refused() -> None:
    eyes = open_perception("truth")
    with pytest.raises(SettingsError, match="an object for each ego"):
        TeamLoop("four_way", [eyes, eyes])
    with pytest.raises(SettingsError, match="as many drivers as perceptions"):
        TeamLoop("four_way", [eyes], [Racer(), Racer()])
    with pytest.raises(TrafficError, match="expected 99 cars or vans to drive"):
        team_of(99).start(0)


def test_a_start_that_fails_leaves_no_traffic_open(monkeypatch: pytest.MonkeyPatch) -> None:
    team = team_of(1, duration_s=0.3)

    def fails() -> None:
        raise MemoryError("no memory left")

    with monkeypatch.context() as broken:
        broken.setattr(team.loops[0], "look", fails)
        with pytest.raises(MemoryError):
            team.start(0)
    assert team.run(0) == (Outcome.TIMEOUT,), "one simulation runs in a process"
