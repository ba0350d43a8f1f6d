"""Defences: pure functions of messages and seen space, on messages made by hand."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from dsrc.messages.defences import (
    Defences,
    Witness,
    disagrees,
    in_free_space,
    objects_jump,
    parse_defence,
    sender_moves,
)
from dsrc.messages.message import Message, Objects
from dsrc.messages.seen_space import View
from sim.boxes import Boxes
from sim.errors import SettingsError
from sim.geometry import pose_matrix

EGO, HELPER, OTHER = 1, 2, 3
CAR = (4.5, 1.8, 1.5)


def objects(*places: tuple[float, float], speed: float = 0.0, size: tuple[float, ...] = CAR) -> Objects:
    """Cars that head along x."""
    boxes = Boxes.from_array([[x, y, 0.5 * size[2], *size, 0.0] for x, y in places])
    n = len(places)
    return Objects(boxes, np.ones(n), np.tile([speed, 0.0], (n, 1)))


def seen(agent: int, xy: tuple[float, float], free: bool, time_s: float = 0.0) -> View:
    """A view of 480 sectors to 60 m: all free, or nothing."""
    return View(agent, time_s, np.array(xy), 0.0, np.full((480, 60), free))


def message(sender: int, told: Objects, xy: tuple[float, float], time_s: float = 0.0, free: bool = False) -> Message:
    pose = pose_matrix([*xy, 0.0], 0.0)
    return Message.honest(sender, time_s, pose, told, lambda: seen(sender, xy, free, time_s))


def witness(agent: int = EGO, told: Objects | None = None, free: bool = True) -> Witness:
    return Witness(seen(agent, (0.0, 0.0), free), (told or objects()).boxes)


def test_what_stands_in_space_that_another_sees_as_free_is_refused() -> None:
    told = message(HELPER, objects((20.0, 0.0), (30.0, 5.0)), (50.0, 10.0))
    assert in_free_space(told, [witness()]).tolist() == [True, True]
    assert in_free_space(told, [witness(free=False)]).tolist() == [False, False]
    assert in_free_space(told, []).tolist() == [False, False]
    assert in_free_space(message(HELPER, objects(), (50.0, 10.0)), [witness()]).tolist() == []


def test_a_witness_that_tells_of_the_object_does_not_contradict_it() -> None:
    told = message(HELPER, objects((20.0, 0.0), (30.0, 5.0)), (50.0, 10.0))
    assert in_free_space(told, [witness(told=objects((20.5, 0.5)))]).tolist() == [False, True]


@pytest.mark.parametrize(
    ("place", "size"),
    [
        ((0.5, 0.0), CAR),  # where the witness is itself
        ((55.0, 0.0), CAR),  # too far for its sectors
        ((20.0, 0.0), (0.5, 0.5, 1.7)),  # too narrow
        ((20.0, 0.0), (4.5, 1.8, 0.8)),  # lower than its rays prove
        ((59.5, 0.0), (16.0, 2.5, 3.5)),  # partly beyond its view
    ],
)
def test_what_a_witness_cannot_judge_is_not_refused(place: tuple[float, float], size: tuple[float, ...]) -> None:
    assert not in_free_space(message(HELPER, objects(place, size=size), (50.0, 10.0)), [witness()]).any()


def test_a_part_that_is_not_seen_is_enough_for_a_car_to_stand_there() -> None:
    view = seen(EGO, (0.0, 0.0), True)
    view.seen[:, 20:] = False
    told = message(HELPER, objects((20.0, 0.0), (15.0, 0.0)), (50.0, 10.0))
    assert in_free_space(told, [Witness(view, objects().boxes)]).tolist() == [False, True]


def test_two_that_agree_are_believed_against_the_ego_and_one_is_not() -> None:
    told = message(HELPER, objects((20.0, 0.0)), (50.0, 10.0))
    agrees, differs = (message(OTHER, objects(place), (40.0, 0.0)) for place in ((21.0, 0.5), (28.0, 0.0)))
    assert disagrees(told, [differs], [witness()]).tolist() == [True]
    assert disagrees(told, [agrees], [witness()]).tolist() == [False]
    assert disagrees(told, [], [witness(free=False)]).tolist() == [False]


def test_a_helper_that_jumps_or_turns_on_the_spot_did_not_move_so() -> None:
    def at(x: float, time_s: float, yaw: float = 0.0, sender: int = HELPER) -> Message:
        return replace(message(sender, objects(), (x, 0.0), time_s), pose=pose_matrix([x, 0.0, 0.0], yaw))

    velocity = np.array([10.0, 0.0])
    assert sender_moves(at(0.0, 0.0), at(1.0, 0.1), velocity)
    assert not sender_moves(at(0.0, 0.0), at(3.0, 0.1), velocity)
    assert not sender_moves(at(0.0, 0.0), at(-9.0, 0.1), velocity)
    assert not sender_moves(at(0.0, 0.0), at(1.0, 0.1, yaw=1.0), velocity)
    assert sender_moves(at(0.0, 0.0), at(5.0, 0.1), None) and not sender_moves(at(0.0, 0.0), at(9.0, 0.1), None)
    # A roadside unit stands, whatever its last messages said.
    assert not sender_moves(at(0.0, 0.0, sender=-1), at(1.0, 0.1, sender=-1), velocity)


def test_objects_that_leap_back_in_time_jump_and_those_that_go_on_or_come_anew_do_not() -> None:
    def told(places: list[tuple[float, float]], time_s: float) -> Message:
        return message(HELPER, objects(*places, speed=10.0), (50.0, 10.0), time_s)

    before = told([(0.0, 0.0), (20.0, 5.0)], 1.0)
    assert not objects_jump(before, told([(2.0, 0.0), (22.0, 5.0)], 1.2))
    assert objects_jump(before, told([(-8.0, 0.0), (12.0, 5.0)], 1.2))
    assert not objects_jump(before, told([(2.0, 0.0), (22.0, 5.0), (-8.0, 9.0)], 1.2))
    assert not objects_jump(before, told([], 1.2)) and not objects_jump(told([], 1.0), before)


def told_over(names: tuple[str, ...], steps: list[list[tuple[float, float]]]) -> list[NDArray[np.bool_]]:
    """Refusals of a standing helper's cars, step by step, by an ego that sees all as free and tells of nothing."""
    defences, found = Defences(names), []
    for step, places in enumerate(steps):
        own = message(EGO, objects(), (0.0, 0.0), 0.1 * step, free=True)
        found += defences.refused(own, [message(HELPER, objects(*places), (50.0, 10.0), 0.1 * step)])
    return found


def test_a_helper_that_is_refused_too_often_is_ignored_until_it_is_honest_again() -> None:
    lie, true = (20.0, 0.0), (58.0, 0.0)
    bad = told_over(("free-space", "trust"), [[true, lie]] * 10 + [[true]] * 60)
    assert bad[0].tolist() == [False, True]
    assert bad[9].tolist() == [True, True]
    assert bad[10].tolist() == [True] and bad[-1].tolist() == [False]
    alone = told_over(("free-space",), [[true, lie]] * 10 + [[true]] * 60)
    assert not any(one[0] for one in alone)


def test_what_was_refused_stays_so_close_to_the_witness_for_a_while() -> None:
    # The ego's own body hides what stands within its reach: as if the ghost had come there.
    steps = [[(4.0, 0.0)]] + [[(2.5, 0.0)]] * 40
    bad = [bool(one[0]) for one in told_over(("free-space",), steps)]
    assert all(bad[:30]) and not any(bad[35:])


def test_without_a_name_nothing_is_refused() -> None:
    assert not any(one.any() for one in told_over((), [[(20.0, 0.0)]] * 5))


def test_a_message_that_comes_late_is_judged_by_what_was_seen_at_its_instant() -> None:
    defences = Defences(("free-space",))
    own = [message(EGO, objects(), (0.0, 0.0), 0.1 * step, free=step == 0) for step in range(3)]
    late = message(HELPER, objects((20.0, 0.0)), (50.0, 10.0), 0.0)
    assert [defences.refused(one, told) for one, told in ((own[0], []), (own[1], []))] == [[], []]
    (bad,) = defences.refused(own[2], [late])
    assert bad.all()


def test_names_are_read_in_any_order_and_wrong_ones_told_in_one_line() -> None:
    assert parse_defence("none") == () and parse_defence("motion") == ("motion",)
    assert parse_defence("trust, free-space") == ("free-space", "trust")
    for text, said in (
        ("fre-space", "did you mean 'free-space'"),
        ("", "found nothing"),
        ("none,trust", "found none"),
        ("motion,motion", "found motion twice"),
        ("trust", "another one beside trust"),
    ):
        with pytest.raises(SettingsError, match=said) as error:
            parse_defence(text)
        assert "\n" not in str(error.value)
