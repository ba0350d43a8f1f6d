"""Deprecated names say what takes their place, and when they go."""

import pytest

import dsrc
from sim.errors import GOES, SettingsError, raised_text, warn_deprecated


def test_what_was_raised_has_its_class_unless_a_user_caused_it() -> None:
    assert (
        raised_text(SettingsError("drive: seed: expected one,\nfound none")) == "drive: seed: expected one, found none"
    )
    assert raised_text(RuntimeError("no weights")) == "RuntimeError: no weights"


def test_a_deprecated_name_tells_the_new_one_and_the_date() -> None:
    with pytest.warns(FutureWarning, match=rf"^--who is deprecated and goes on {GOES}; use --corrupted-agents$"):
        warn_deprecated("--who", "--corrupted-agents")


@pytest.mark.parametrize(("old", "new"), [("look_again", "replay"), ("drive", "drive_episodes")])
def test_the_old_names_of_the_interface_are_the_new_ones_with_a_warning(old: str, new: str) -> None:
    with pytest.warns(FutureWarning, match=rf"dsrc\.{old} .* use dsrc\.{new}"):
        assert getattr(dsrc, old) is getattr(dsrc, new)
    assert new in dsrc.__all__ and old not in dsrc.__all__
