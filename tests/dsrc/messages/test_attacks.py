"""Attacks: what liars write, on messages made by hand, and what an ego makes of it in encounters."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.loop import ClosedLoop, LoopSettings
from dsrc.closed_loop.metrics.lies import LieMetrics, lie_metrics
from dsrc.closed_loop.perception.open import open_perception
from dsrc.closed_loop.replay import replay
from dsrc.closed_loop.types import EgoState, Outcome, Percept
from dsrc.faults.fault import parse_faults
from dsrc.messages.attacks import Attacks
from dsrc.messages.message import Message, near_any
from sim.boxes import Boxes
from sim.errors import SettingsError
from sim.traffic.base import Limits
from tests.dsrc.messages.test_defences import EGO, HELPER, message, objects

ROUTE = np.array([[0.0, 0.0], [30.0, 0.0], [30.0, 40.0]])


def ego(x: float = 0.0) -> EgoState:
    box = Boxes.from_array([x, 0.0, 0.75, 4.5, 1.8, 1.5, 0.0])
    route = np.concatenate([[[x, 0.0]], ROUTE[1:]])
    return EgoState(0.0, box, 10.0, 0.0, route, Limits(14.0, 2.0, 7.5), (), 0.0)


def sent(text: str, honest: list[Message], seed: int = 0) -> list[Message]:
    attacks = Attacks(parse_faults(text), seed, EGO)
    found = []
    for one in honest:
        attacks.aim(ego().box, ego().route, one.time_s)
        found.append(attacks.written(one, one.time_s))
    return found


def drives(steps: int = 10) -> list[Message]:
    """A helper that sees a car drive by at 10 m/s."""
    return [message(HELPER, objects((2.0 * k, 8.0), speed=10.0), (50.0, 10.0), 0.2 * k) for k in range(steps)]


def test_a_ghost_stands_on_the_route_around_the_corner_and_is_told_by_all_liars_alike() -> None:
    (lie,) = sent("ghost:1,ahead_m=50", drives(1))
    assert lie.attacked and lie.false.tolist() == [False, True]
    np.testing.assert_allclose(lie.objects.boxes.array[1], [30.0, 20.0, 0.75, 4.5, 1.9, 1.5, np.pi / 2], atol=1e-9)
    (other,) = sent("ghost:1,ahead_m=50", [replace(drives(1)[0], sender=-1)])
    assert other.objects.boxes.array[1].tolist() == lie.objects.boxes.array[1].tolist()
    assert not sent("ghost:1,ahead_m=100", drives(1))[0].attacked  # the route ends before


@pytest.mark.parametrize(
    "text", ["ghost:1,ahead_m=50", "remove", "ghost + remove", "replay:0.4", "false_pose:3", "ghost:0.5", "ghost on -1"]
)
def test_a_lie_has_the_bytes_of_the_objects_that_it_tells(text: str) -> None:
    honest = [message(HELPER, objects(*[(4.0 * n, 8.0) for n in range(k)]), (50.0, 10.0), 0.2 * k) for k in range(6)]
    attacks, lies = Attacks(parse_faults(text), 0, EGO), sent(text, honest)
    for one, lie in zip(honest, lies, strict=True):
        attacks.aim(ego().box, ego().route, one.time_s)
        more = attacks.more_bytes(one.sender, one.objects.boxes, one.time_s)
        assert more == 35 * (len(lie.objects) - len(one.objects))


def test_a_ghost_stays_where_it_is_until_the_ego_has_passed_it() -> None:
    attacks = Attacks(parse_faults("ghost"), 0, EGO)
    places = []
    for x in (0.0, 10.0, 24.0, 26.0):
        attacks.aim(ego(x).box, ego(x).route, 0.0)
        places.append(attacks.written(drives(1)[0], 0.0).objects.boxes.center[1, :2].tolist())
    assert places[:3] == [[25.0, 0.0]] * 3 and places[3] == [30.0, 21.0]


def test_it_comes_and_goes_with_its_times_and_its_share() -> None:
    there = [one.attacked for one in sent("ghost from 0.4 s to 1 s", drives())]
    assert there == [False, False, True, True, True, *[False] * 5]
    some = [one.attacked for one in sent("ghost:0.5", drives(200))]
    assert 70 < sum(some) < 130
    assert not any(one.attacked for one in sent("ghost on 77", drives()))


@pytest.mark.parametrize("text", ["ghost:0", "remove:0", "remove:1,aside_m=0", "false_pose:0", "replay:0"])
def test_an_attack_at_rate_or_size_0_is_none(text: str) -> None:
    honest = drives()
    assert all(ours is theirs for ours, theirs in zip(sent(text, honest), honest, strict=True))


def test_removal_takes_what_is_near_the_route_and_nothing_else() -> None:
    honest = message(HELPER, objects((10.0, 3.0), (10.0, -8.0), (33.0, 30.0), (60.0, 0.0)), (50.0, 10.0))
    (lie,) = sent("remove:1,aside_m=5", [honest])
    assert lie.attacked and lie.objects.boxes.center[:, 0].tolist() == [10.0, 60.0] and not lie.false.any()


def test_a_false_pose_moves_all_that_is_told_and_the_teller() -> None:
    (honest,) = drives(1)
    (lie,) = sent("false_pose:ahead_m=3,turn_deg=90", [honest])
    assert lie.false.all() and lie.pose[:2, 3].tolist() == [53.0, 10.0]
    np.testing.assert_allclose(lie.objects.boxes.center[0, :2], [55.0, -40.0], atol=1e-9)
    np.testing.assert_allclose(lie.objects.velocity, [[0.0, 10.0]], atol=1e-9)
    view = lie.view()
    np.testing.assert_allclose([*view.xy, view.yaw], [53.0, 10.0, np.pi / 2], atol=1e-9)


def test_a_replay_has_old_objects_with_a_new_stamp() -> None:
    honest = drives()
    lies = sent("replay:0.4 from 0.6 s", honest)
    assert [one.time_s for one in lies] == [one.time_s for one in honest]
    assert [one.view().time_s for one in lies] == [one.time_s for one in honest]
    places = [one.objects.boxes.center[0, 0] for one in lies]
    assert places == [0.0, 2.0, 4.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0]
    assert [bool(one.false.any()) for one in lies] == [False] * 3 + [True] * 7


def test_attacks_of_one_text_act_on_what_those_before_left() -> None:
    (lie,) = sent("remove + ghost:1,ahead_m=20 + false_pose:aside_m=2", drives(1))
    np.testing.assert_allclose(lie.objects.boxes.center[:, :2], [[20.0, 2.0]], atol=1e-9)


# In encounters ------------------------------------------------------------------------------------------------------

SETTINGS = LoopSettings(detect_every_s=0.2)
ALL = "agreement,free-space,motion,trust"


def driven(scenario: str, fault: str = "", defence: str = "none", seed: int = 1) -> EpisodeLog:
    eyes = open_perception("team-sight", fault=parse_faults(fault) if fault else (), defence=defence, interval_s=0.2)
    loop = ClosedLoop(scenario, eyes, settings=SETTINGS)
    loop.run(seed)
    return loop.log(perception="team-sight")


def percepts(log: EpisodeLog) -> list[bytes]:
    return [tick.percept.boxes.array.tobytes() for tick in log.ticks if tick.percept is not None]


@pytest.fixture(scope="module")
def undisturbed() -> EpisodeLog:
    return driven("ima_building")


@pytest.fixture(scope="module")
def haunted() -> EpisodeLog:
    return driven("ima_building", "ghost")


@pytest.mark.parametrize("scenario", ["ima_building", pytest.param("ped_dartout", marks=pytest.mark.slow)])
def test_a_defence_without_an_attack_refuses_no_one(scenario: str) -> None:
    log = driven(scenario, defence=ALL)
    found = lie_metrics(log)
    assert log.settings.defence == ALL and log.outcome is Outcome.ARRIVED
    assert found.helpers_honest >= 2 and found.helpers_wronged == found.true_refused == found.needless_stops == 0


@pytest.mark.slow
def test_a_defence_without_an_attack_changes_nothing(undisturbed: EpisodeLog) -> None:
    assert percepts(driven("ima_building", defence=ALL)) == percepts(undisturbed)


def test_an_attack_at_rate_0_changes_nothing(undisturbed: EpisodeLog) -> None:
    log = driven("ima_building", "ghost:0 + remove:0 + false_pose:0 + replay:0")
    assert percepts(log) == percepts(undisturbed)
    assert [tick.decision for tick in log.ticks] == [tick.decision for tick in undisturbed.ticks]


def test_a_ghost_stops_an_ego_without_defence_needlessly(undisturbed: EpisodeLog, haunted: EpisodeLog) -> None:
    assert lie_metrics(undisturbed).needless_stops == 0.0
    found = lie_metrics(haunted)
    assert found.needless_stops == 1.0 and found.false_told > 20 and found.false_refused == 0.0


@pytest.mark.slow
def test_free_space_lets_it_drive_through_the_ghost() -> None:
    log = driven("ima_building", "ghost", "free-space")
    found = lie_metrics(log)
    assert log.outcome is Outcome.ARRIVED and found.needless_stops == 0.0
    assert found.false_refused > 0.9 * found.false_told and found.true_refused == 0.0


@pytest.mark.slow
def test_two_runs_and_a_replay_are_the_same(tmp_path: Path, haunted: EpisodeLog) -> None:
    first, second = haunted.save(tmp_path / "a.npz"), driven("ima_building", "ghost").save(tmp_path / "b.npz")
    assert first.read_bytes() == second.read_bytes()
    read = EpisodeLog.load(first)
    assert lie_metrics(read) == lie_metrics(haunted)
    again = replay(read, open_perception("team-sight", fault="ghost", interval_s=0.2), "team-sight")
    assert percepts(again) == percepts(haunted) and lie_metrics(again) == lie_metrics(haunted)


def test_late_fusion_joins_lies_with_detections_and_without_any_is_as_before() -> None:
    loop = ClosedLoop("lta_truck", open_perception("truth"), settings=LoopSettings(duration_s=1.5))
    loop.run(1)

    def late(fault: str = "", defence: str = "none") -> Percept:
        eyes: Any = open_perception("late", fault=fault or (), defence=defence)
        eyes.reset(loop.scenario, loop.ego_id, 1)
        if fault or defence != "none":
            eyes.aim(loop.ticks[-1].ego)
        return eyes.perceive(loop.ticks[-2].actors, loop.ticks[-1].actors, {})

    plain, none, lie, refused = late(), late("ghost:0"), late("ghost"), late("ghost", "free-space")
    assert none.boxes.array.tobytes() == plain.boxes.array.tobytes() and none.score.tobytes() == plain.score.tobytes()
    assert plain.told == () and [one.false for one in none.told] == [0] * len(none.told) and none.told
    place = ghost_of(loop.ticks[-1].ego)
    assert not near_any(place, plain.boxes).any() and near_any(place, lie.boxes).all()
    assert all(one.attacked and one.false == 1 for one in lie.told)
    assert not near_any(place, refused.boxes).any() and all(one.false_refused == 1 for one in refused.told)


def ghost_of(ego: EgoState) -> Boxes:
    attacks = Attacks(parse_faults("ghost"), 0, EGO)
    attacks.aim(ego.box, ego.route, 0.0)
    return attacks.written(message(HELPER, objects(), (0.0, 0.0)), 0.0).objects.boxes


def test_without_messages_nothing_is_known_of_lies() -> None:
    loop = ClosedLoop("ima_building", open_perception("truth"), settings=LoopSettings(duration_s=0.5))
    loop.run(0)
    found = lie_metrics(loop.log())
    assert found.needless_stops == 0.0
    assert all(np.isnan(getattr(found, name)) for name in LieMetrics.__struct_fields__[1:])


@pytest.mark.parametrize(
    ("perception", "fault", "defence", "said"),
    [
        ("ego", "ghost", "none", "fault 'ghost:1': expected a perception with helpers, such as team"),
        ("team", "replay:1", "none", "fault 'replay:1': expected a perception whose helpers tell boxes, team-sight or"),
        ("team", "", "motion", "defence: expected a perception whose helpers tell boxes, team-sight or late"),
        ("truth", "", "motion", "defence: expected a perception whose helpers tell boxes, team-sight or late"),
        ("team-sight", "fog:3", "none", "without a sensor"),
    ],
)
def test_a_perception_without_messages_has_neither(perception: str, fault: str, defence: str, said: str) -> None:
    with pytest.raises(SettingsError, match=said):
        open_perception(perception, fault=parse_faults(fault) if fault else (), defence=defence)


@pytest.mark.parametrize(("agents", "said"), [("1000", "found 1000, the ego"), ("77", "found 77")])
def test_who_is_no_helper_cannot_lie(agents: str, said: str) -> None:
    log = driven("ima_building", f"ghost on {agents}")
    assert log.outcome is Outcome.PERCEPTION_FAILED and "\n" not in log.message
    assert f"fault 'ghost:1 on {agents}': expected ids among the helpers" in log.message and said in log.message
