"""Critical values: every flip between the values tried is found, not the first one alone."""

import pytest

from dsrc.closed_loop.campaign.critical import Flip, critical_value


def test_a_threshold_is_found_to_the_tolerance() -> None:
    found = critical_value(lambda value: value < 3.3, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0], 0.01)
    assert found.monotone
    assert found.critical == pytest.approx(3.3, abs=0.01)
    (flip,) = found.flips
    assert flip.below < 3.3 <= flip.above and flip.above - flip.below <= 0.01


def test_a_disturbance_that_helps_again_is_not_monotone() -> None:
    found = critical_value(lambda value: not 1.5 < value < 3.2, [0.0, 1.0, 2.0, 3.0, 4.0], 0.01)
    assert not found.monotone
    assert [flip.fails for flip in found.flips] == [True, False]
    assert found.critical == pytest.approx(1.5, abs=0.01)


def test_an_episode_that_always_ends_well_has_no_critical_value() -> None:
    found = critical_value(lambda value: True, [0.0, 1.0], 0.1)
    assert found.critical is None and found.flips == () and found.monotone


def test_no_more_episodes_are_driven_than_allowed() -> None:
    driven = []

    def fine(value: float) -> bool:
        driven.append(value)
        return value < 0.5

    critical_value(fine, [0.0, 1.0], 1e-9, most=8)
    assert len(driven) == 8


def test_an_integer_scale_needs_no_bisection() -> None:
    found = critical_value(lambda value: value < 3, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0], 1.0)
    assert found.flips == (Flip(2.0, 3.0, True),)


@pytest.mark.parametrize("values", [[0.0], [1.0, 1.0], [2.0, 1.0]])
def test_values_that_do_not_ascend_are_refused(values: list[float]) -> None:
    with pytest.raises(ValueError, match="ascending"):
        critical_value(lambda value: True, values, 0.1)
