"""The smallest fault that still crashes, by rules that are known."""

import pytest

from dsrc.closed_loop.falsification.smallest import neighbours, smallest
from dsrc.faults.fault import Faults, faults_text, parse_faults

END_S = 10.0


def crashes(faults: Faults) -> bool:
    """Brakes of less than half their gain, or messages later than 0.4 s, all the time from 3 s to 4 s."""
    there = [one for one in faults if one.from_s <= 3.0 and one.to_s >= 4.0]
    late = any(one.kind == "delay" and one.value > 0.4 for one in there)
    return late or any(one.kind == "brake_gain" and one.value < 0.5 for one in there)


@pytest.mark.parametrize(
    "text", ["brake_gain:0.1 + fog:3", "brake_gain:0", "fog:3 + brake_gain:0.1 from 1 s to 8 s + loss:0.2"]
)
def test_what_does_not_matter_is_left_out_shortened_and_weakened(text: str) -> None:
    (left,) = smallest(parse_faults(text), crashes, END_S)
    assert left.kind == "brake_gain" and crashes((left,))
    assert 0.44 <= left.value < 0.5  # within a twentieth of the distance from full brakes
    assert 2.7 <= left.from_s <= 3.0 and 4.0 <= left.to_s <= 4.3


def test_one_of_two_faults_that_crash_alone_is_left() -> None:
    assert len(smallest(parse_faults("delay:1 + brake_gain:0.1"), crashes, END_S)) == 1


def test_an_episode_that_crashes_anyway_needs_no_fault() -> None:
    assert smallest(parse_faults("fog:3"), lambda faults: True, END_S) == ()


def test_whole_numbers_and_numbers_that_do_nothing_at_infinity_are_weakened_too() -> None:
    fog = smallest(parse_faults("fog:5"), lambda faults: bool(faults) and faults[0].value >= 2.0, 0.0)
    assert faults_text(fog) == "fog:2"
    rate = smallest(parse_faults("rate:1"), lambda faults: bool(faults) and faults[0].value <= 4.0, 0.0)
    assert 3.0 <= rate[0].value <= 4.0


def test_a_neighbour_has_one_number_changed_by_a_tenth() -> None:
    near = {faults_text(one) for one in neighbours(parse_faults("brake_gain:0.4 from 2 s to 5 s"))}
    assert near == {
        "brake_gain:0.36 from 2 s to 5 s",
        "brake_gain:0.44 from 2 s to 5 s",
        "brake_gain:0.4 from 1.8 s to 5 s",
        "brake_gain:0.4 from 2.2 s to 5 s",
        "brake_gain:0.4 from 2 s to 4.5 s",
        "brake_gain:0.4 from 2 s to 5.5 s",
    }
    assert {faults_text(one) for one in neighbours(parse_faults("fog:5"))} == {"fog:4"}
