"""Drivers of others in the loop: what they raise is told, and goes no further."""

from typing import Any

import pytest

from dsrc.closed_loop.driving.own.checked import CheckedDriver


class Leaving:
    """Driver that ends the process or raises, by its error."""

    def __init__(self, error: BaseException) -> None:
        self.error = error

    def reset(self, lanes: Any) -> None:
        raise self.error


@pytest.mark.parametrize("error", [SystemExit(3), ValueError("no\nroad")])
def test_what_a_driver_raises_is_its_failure_in_one_line(error: BaseException) -> None:
    wheel = CheckedDriver(Leaving(error), 60.0)  # type: ignore[arg-type]
    wheel.reset(None)
    assert wheel.failure.startswith(type(error).__name__) and "\n" not in wheel.failure


def test_an_interruption_is_no_failure_of_the_driver() -> None:
    with pytest.raises(KeyboardInterrupt):
        CheckedDriver(Leaving(KeyboardInterrupt()), 60.0).reset(None)  # type: ignore[arg-type]
