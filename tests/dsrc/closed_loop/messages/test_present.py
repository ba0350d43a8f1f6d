"""Messages moved to the present: where objects stand that were told of some time ago."""

import numpy as np
import pytest

from dsrc.closed_loop.messages.present import Present
from dsrc.messages.message import Message, Objects
from dsrc.messages.seen_space import View
from sim.boxes import Boxes

SPEED_MPS, RATE, EVERY_S = 12.0, 0.3, 0.1


def place(time_s: float, turning: bool) -> np.ndarray:
    """Return x, y and heading of a car at a time."""
    if not turning:
        return np.array([SPEED_MPS * time_s, 0.0, 0.0])
    radius, angle = SPEED_MPS / RATE, RATE * time_s
    return np.array([radius * np.sin(angle), radius * (1.0 - np.cos(angle)), angle])


def told(time_s: float, turning: bool = False, velocity: tuple[float, float] = (np.nan, np.nan)) -> Message:
    """Return a message of that car and of one that is parked."""
    rows = [[*place(time_s, turning)[:2], 0.8, 4.5, 1.9, 1.6, place(time_s, turning)[2]], [5, -8, 0.8, 4, 1.9, 1.6, 0]]
    objects = Objects(Boxes.from_array(np.array(rows)), np.array([0.9, 0.9]), np.array([velocity, (np.nan, np.nan)]))
    return Message.honest(2, time_s, np.eye(4), objects, lambda: View.everything(2, time_s, np.zeros(2), 50.0))


@pytest.mark.parametrize("turning", [False, True])
@pytest.mark.parametrize("age_s", [0.1, 0.3, 0.5])
def test_a_car_stands_where_it_has_driven_by_now_and_a_parked_one_where_it_was(turning: bool, age_s: float) -> None:
    present = Present()
    for number in range(20):
        time_s = EVERY_S * number
        objects = present.moved(told(time_s, turning), time_s + age_s)
    x, y, yaw = place(time_s + age_s, turning)
    off_m = np.linalg.norm(objects.boxes.center[0, :2] - [x, y])
    stale_m = SPEED_MPS * age_s
    assert off_m < 0.12 * stale_m and objects.boxes.yaw[0] == pytest.approx(yaw, abs=0.03)
    np.testing.assert_allclose(objects.boxes.center[1], [5, -8, 0.8], atol=0.05)


def test_a_message_of_now_and_the_first_of_a_sender_stay_as_they_are() -> None:
    present = Present()
    first = told(0.0)
    assert present.moved(first, 0.0) is first.objects
    np.testing.assert_allclose(present.moved(first, 0.4).boxes.center, first.objects.boxes.center, atol=1e-9)


def test_a_stated_velocity_counts_and_a_message_that_is_used_again_goes_on() -> None:
    present = Present()
    message = told(1.0, velocity=(SPEED_MPS, 0.0))
    ways = [present.moved(message, 1.0 + age).boxes.center[0, 0] - 12.0 for age in (0.1, 0.2, 0.3)]
    assert ways == pytest.approx([1.2, 2.4, 3.6])
