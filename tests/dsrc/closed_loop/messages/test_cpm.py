"""Collective Perception Messages: which objects are told when, how finely, and what a receiver makes of them."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from dsrc.closed_loop.messages.cpm import FORGOTTEN_S, CpmPicture, CpmSender
from dsrc.messages.message import Objects
from sim.boxes import CLASSES, Boxes

CAR, WALKER = CLASSES.index("car"), CLASSES.index("pedestrian")
HERE = np.zeros(2)
SIZE = {CAR: (4.5, 1.9, 1.6), WALKER: (0.6, 0.6, 1.75)}


def seen(*rows: tuple[float, float, int], yaw: float = 0.0) -> Objects:
    """Return detections of road users at x, y of a class."""
    boxes = [[x, y, 0.8, *SIZE[label], yaw] for x, y, label in rows]
    label = np.array([label for *_, label in rows], np.int64)
    return Objects(
        Boxes.from_array(np.array(boxes, np.float64).reshape(-1, 7), label=label),
        np.full(len(rows), 0.9),
        np.full((len(rows), 2), np.nan),
    )


def told_at(way: Callable[[float], tuple[float, float]], times: np.ndarray, label: int = CAR) -> list[float]:
    """Return the times at which a road user is told whose place at a time `way` gives."""
    sender, found = CpmSender(), []
    for time_s in times:
        message = sender.message(seen((*way(time_s), label)), time_s, HERE)
        if message is not None and len(message.objects):
            found.append(time_s)
    return found


def test_a_parked_car_is_told_once_a_second_and_a_pedestrian_twice() -> None:
    times = np.arange(0.0, 5.05, 0.1)
    for label, every_s in ((CAR, 1.0), (WALKER, 0.5)):
        told = told_at(lambda _: (10.0, 3.0), times, label)
        np.testing.assert_allclose(np.diff(told)[1:], every_s, atol=1e-9)


def test_what_the_channel_holds_back_is_told_with_the_next_message() -> None:
    sender, held = CpmSender(), 0
    for step in range(30):
        message = sender.message(seen((10.0, 3.0, CAR)), 0.1 * step, HERE)
        if step % 10 == 7:  # its turn
            assert message is not None and len(message.objects) == 1
        elif message is not None:
            sender.withdraw()
            held += 1
    assert held == 7


def test_a_message_that_was_overtaken_tells_nothing_older_than_what_is_known() -> None:
    sender, picture = CpmSender(), CpmPicture()
    messages = [sender.message(seen((15.0 * t, 0.0, CAR)), t, HERE) for t in np.arange(0.0, 2.05, 0.1)]
    early, late = [message for message in messages if message is not None and len(message.objects)][-2:]
    for message in (late, early):
        picture.hear(message)
    np.testing.assert_allclose(picture.objects(late.time_s).boxes.center[0], late.objects.boxes.center[0])


def test_messages_are_a_tenth_of_a_second_apart_however_often_an_agent_senses() -> None:
    told = told_at(lambda t: (60.0 * t, 0.0), np.arange(0.0, 3.01, 0.05))
    assert np.diff(told).min() > 0.1 - 1e-9


def test_a_steady_car_is_told_whenever_it_has_moved_more_than_4_m() -> None:
    told = told_at(lambda t: (15.0 * t, 0.0), np.arange(0.0, 6.05, 0.1))
    settled = np.diff([time_s for time_s in told if time_s > 3.0])
    np.testing.assert_allclose(settled, 0.3, atol=1e-9)  # 4.5 m: 3 m are too few


def test_a_car_that_brakes_is_told_for_its_speed_before_it_has_moved_4_m() -> None:
    def way(t: float) -> tuple[float, float]:
        braked = max(0.0, min(t - 3.0, 1.0))
        return 8.0 * t - 0.5 * 6.0 * braked**2 - 6.0 * max(0.0, t - 4.0), 0.0

    told = np.array(told_at(way, np.arange(0.0, 5.05, 0.1)))
    steady, braking = np.diff(told[(told > 1.5) & (told < 3.05)]), np.diff(told[(told > 3.25) & (told < 4.05)])
    assert steady.min() > 0.45 and braking.max() < 0.25


def test_a_new_pedestrian_is_told_alone_and_with_all_others_once_one_is_due() -> None:
    sender, told = CpmSender(), dict[int, int]()
    for step in range(13):
        both = seen((10.0, 3.0, WALKER), *([(20.0, -3.0, WALKER)] if step >= 4 else []))
        message = sender.message(both, 0.1 * step, HERE)
        if message is not None:
            told[step] = len(message.objects)
    assert told == {0: 1, 4: 1, 5: 2, 10: 2}, "the second is new at 0.4 s, the first due at 0.5 s, and with it both"


def test_a_pedestrian_that_others_tell_makes_no_other_due() -> None:
    sender, other, told = CpmSender("distance"), CpmSender(), []
    heard = other.message(seen((10.0, 3.0, WALKER)), 0.0, HERE)
    for step in range(13):
        both = seen((10.0, 3.0, WALKER), (20.0, -3.0, WALKER))
        message = sender.message(both, 0.1 * step, HERE, [heard] if heard and step else [])
        heard = other.message(seen((10.0, 3.0, WALKER)), 0.1 * step + 0.05, HERE) or heard
        told.append(0 if message is None else len(message.objects))
    assert told == [2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0]


def test_a_receiver_moves_what_it_knows_and_forgets_what_is_told_no_more() -> None:
    sender, picture, sizes = CpmSender(), CpmPicture(), []
    for step in range(41):
        message = sender.message(seen((12.0 * 0.1 * step, 0.0, CAR), (30.0, 9.0, CAR)), 0.1 * step, HERE)
        if message is not None:
            picture.hear(message)
            sizes.append(message.bytes)
    known = picture.objects(4.2)
    np.testing.assert_allclose(np.sort(known.boxes.center[:, 0]), [30.0, 50.4], atol=0.4)
    assert len(sizes) < 25 and {b - a for a, b in pairwise(sizes)} <= {-35, 0, 35}
    assert len(picture.objects(4.0 + FORGOTTEN_S + 1.0)) == 0


@pytest.mark.parametrize("count", [0, 1])
def test_an_agent_that_sees_nothing_still_sends_once_a_second(count: int) -> None:
    sender = CpmSender()
    sent = [sender.message(seen(*[(5.0, 5.0, CAR)] * count), 0.1 * step, HERE) is not None for step in range(30)]
    assert sum(sent) == 3


@pytest.mark.parametrize("label", [CAR, WALKER])
def test_a_new_object_is_in_the_next_message_before_its_track_is_confirmed(label: int) -> None:
    """ETSI TS 103 324, 6.1.2.3: told when first detected; its quality by 7.1.8.6 is above the threshold of 3."""
    sender, told = CpmSender(), []
    for step in range(4):
        found = seen((10.0 + 1.0 * step, 3.0, label))
        message = sender.message(Objects(found.boxes, np.array([0.45]), found.velocity), 0.1 * step, HERE)
        told.append(message.objects if message is not None else found[:0])
    assert len(told[0]) == 1 and np.isnan(told[0].velocity).all(), "no motion is known of a first box"
    again = next(one for one in told[1:] if len(one))
    assert again.velocity[0, 0] > 1.0 and again.boxes.object_id == told[0].boxes.object_id


def test_a_ghost_of_one_detection_is_told_once_and_believed_for_one_instant() -> None:
    sender, picture, counts = CpmSender(), CpmPicture(), []
    for step in range(5):
        found = seen(*([(10.0, 3.0, CAR)] if step == 1 else []))
        message = sender.message(Objects(found.boxes, np.full(len(found), 0.3), found.velocity), 0.1 * step, HERE)
        if message is not None:
            picture.hear(message)
        counts.append(len(picture.objects(0.1 * step)))
    assert counts == [0, 1, 0, 0, 0]
