"""Deprecated names say what takes their place, and when they go."""

import pytest

import dsrc
from sim.errors import GOES, warn_deprecated


def test_a_deprecated_name_tells_the_new_one_and_the_date() -> None:
    with pytest.warns(FutureWarning, match=rf"^--who is deprecated and goes on {GOES}; use --corrupted-agents$"):
        warn_deprecated("--who", "--corrupted-agents")


@pytest.mark.parametrize(("old", "new"), [("look_again", "replay"), ("drive", "drive_episodes")])
def test_the_old_names_of_the_interface_are_the_new_ones_with_a_warning(old: str, new: str) -> None:
    with pytest.warns(FutureWarning, match=rf"dsrc\.{old} .* use dsrc\.{new}"):
        assert getattr(dsrc, old) is getattr(dsrc, new)
    assert new in dsrc.__all__ and old not in dsrc.__all__
