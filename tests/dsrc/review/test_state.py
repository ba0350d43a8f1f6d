"""Changes of a state leave nothing in it that they make meaningless."""

from functools import partial
from typing import Any

import pytest

from dsrc.review.state import METHOD, ReviewState, other_run, with_changes

SETS = ("good", "weak", "blind")
changed = partial(with_changes, ReviewState(), lambda _: SETS)


def then(state: ReviewState, **changes: Any) -> ReviewState:
    return with_changes(state, lambda _: SETS, **changes)


def test_errors_are_of_methods_that_are_shown() -> None:
    both = changed(methods=("good", "weak"), error_method="weak")
    assert both.error_method == "weak"
    assert then(both, methods=("good",)).error_method == ""
    assert then(both, methods=("weak",)).error_method == "weak"
    assert changed(error_method="good").error_method == "good", "the first is shown where none is named"
    assert changed(error_method="weak").error_method == changed(error_method="nonsense").error_method == ""


@pytest.mark.parametrize(
    ("versus", "own"),
    [
        (f"{METHOD}weak", {"methods": ("weak", "good")}),
        (f"{METHOD}good", {"methods": ()}),
        ("alone", {"cooperative": False}),
        ("clean", {"corruption": "clean"}),
    ],
)
def test_no_run_is_compared_with_itself(versus: str, own: dict[str, Any]) -> None:
    other = changed(methods=("blind",), corruption="fog", versus=versus)
    assert other.versus == versus and other_run(other) is not None
    assert then(other, **own).versus == ""


def test_nothing_is_broken_without_another_run() -> None:
    broken = changed(corruption="fog", listed="broken")
    assert broken.listed == "broken"
    assert then(broken, corruption="clean").listed == "all"
    assert then(broken, corruption="clean", versus="alone").listed == "broken"
    alone = then(broken, versus="alone", corruption="clean")
    assert then(alone, cooperative=False).listed == "all"
    assert then(changed(listed="missed"), threshold=0.5).listed == "missed"
