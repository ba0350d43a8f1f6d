"""Custom corruptions: registered by a program, or found by an entry point."""

from dataclasses import replace
from importlib.metadata import EntryPoint
from typing import Self

import msgspec
import numpy as np
import pytest

from sensors.corruptions import (
    CORRUPTIONS,
    Corruption,
    check_corruption,
    corrupt,
    corrupt_frame,
    kinds_of,
    register_corruption,
    require_corruption,
)
from sensors.corruptions.registry import SettingsList
from sensors.sweep import ATTENUATED, Sweep
from sim.errors import SettingsError
from tests.sensors.corruptions.frames import frame
from tests.sensors.corruptions.street import spinning, street


class Haze(msgspec.Struct, frozen=True):
    """A medium without echoes."""

    extinction: float

    def scaled(self, factor: float) -> Self:
        return type(self)(factor * self.extinction)


LEVELS = tuple(Haze(0.002 * level) for level in range(1, 6))


def dim(sweep: Sweep, haze: Haze, rng: np.random.Generator) -> Sweep:
    left = np.exp(-2.0 * haze.extinction * sweep.range)
    fate = np.maximum(sweep.fate, ATTENUATED).astype(np.uint8)
    return replace(sweep, intensity=(sweep.intensity * left).astype(np.float32), fate=fate)


def rng() -> np.random.Generator:
    return np.random.default_rng(1)


@pytest.fixture
def haze(monkeypatch: pytest.MonkeyPatch) -> Corruption:
    monkeypatch.setattr(CORRUPTIONS, "_values", dict(CORRUPTIONS._values))
    return register_corruption("haze", LEVELS, dim, weather=True)


def test_a_registered_corruption_is_one_like_all_others(haze: Corruption) -> None:
    sweep = street(spinning(16))
    assert corrupt(sweep, "haze", 2, rng()).intensity == pytest.approx(dim(sweep, LEVELS[1], rng()).intensity)
    assert kinds_of()[-1] == "haze" and "haze" not in kinds_of("paper")
    assert CORRUPTIONS["haze"] is haze and haze.level == "sweep"
    require_corruption("haze")
    assert register_corruption("haze", LEVELS, dim, weather=True) == haze  # a notebook cell that runs again
    check_corruption("haze")
    first, later = (corrupt_frame(frame(index), "haze", 3, 0).agents[0].sweep.intensity for index in (0, 400))
    assert not np.array_equal(first, later)  # weather drifts


def test_a_published_model_joins_a_kind_of_its_own(haze: Corruption) -> None:
    register_corruption("haze", LEVELS[::-1], dim, family="paper")
    assert "haze" in kinds_of("paper") and CORRUPTIONS["haze"].weather
    assert CORRUPTIONS["haze"].settings_of("paper").severity(1) == LEVELS[4]
    check_corruption("haze", family="paper")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"name": "Haze!"}, "name: expected lower case with underscores, not reserved, found Haze!"),
        ({"name": "clean"}, "not reserved, found clean"),
        ({"name": "fog"}, "expected a new one, found 'fog', which is registered"),
        ({"settings": LEVELS[:4]}, "settings: expected 5, of severities 1 to 5, found 4"),
        ({"settings": (1, 2, 3, 4, 5), "weather": True}, "settings: expected those of weather to have scaled"),
        ({"apply": None}, "apply: expected a function of a sweep or, by in_frame, of a frame, found None"),
        ({"family": "paper"}, "expected a physical kind without a published model, found mist"),
        ({"family": "papier"}, "did you mean 'paper'?"),
    ],
)
def test_a_wrong_registration_is_one_line(wrong: dict, message: str) -> None:
    arguments = {"name": "mist", "settings": LEVELS, "apply": dim} | wrong
    with pytest.raises(SettingsError) as caught:
        register_corruption(**arguments)
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert "mist" not in CORRUPTIONS


def test_an_entry_point_names_a_corruption(monkeypatch: pytest.MonkeyPatch) -> None:
    values = {"haze": Corruption(SettingsList(LEVELS), dim), "rime": LEVELS}
    points = {name: EntryPoint(name, f"{__name__}:{name}", CORRUPTIONS.group) for name in values}
    monkeypatch.setattr(CORRUPTIONS, "_values", dict(CORRUPTIONS._values))
    monkeypatch.setitem(CORRUPTIONS.__dict__, "_installed", points)
    monkeypatch.setattr(EntryPoint, "load", lambda point: values[point.name])
    assert len(corrupt(street(spinning(4)), "haze", 3, rng())) > 0
    with pytest.raises(SettingsError, match=r"rime: .* expected a Corruption, found tuple"):
        corrupt(street(spinning(4)), "rime", 3, rng())
