"""Contract check: every corruption of both families passes, broken ones get one line per rule."""

from dataclasses import replace

import numpy as np
import pytest

from sensors.corruptions import CORRUPTIONS, FAMILIES, Corruption, Family, check_corruption, kinds_of
from sensors.corruptions.check import example_frame, remaining_signal
from sensors.sweep import ADDED, STATIC, Sweep
from sim.errors import SettingsError
from tests.sensors.corruptions.street import few_discs


@pytest.mark.parametrize(("kind", "family"), [(kind, family) for family in FAMILIES for kind in kinds_of(family)])
def test_every_corruption_keeps_the_contract(kind: str, family: Family) -> None:
    with few_discs():
        check_corruption(kind, family=family)


def test_the_example_has_what_corruptions_need() -> None:
    frame = example_frame()
    assert all(set(agent.sweep.object_id) > {STATIC, 1002, 1003} for agent in frame.agents)
    assert (frame.points_on[:, 2:] > 30).all()
    assert remaining_signal(frame, frame) == sum(len(agent.sweep) for agent in frame.agents)


def keep(sweep: Sweep, severity: int, rng: np.random.Generator) -> Sweep:
    return sweep[rng.random(len(sweep)) > 0.1 * severity]


def in_place(sweep: Sweep, severity: int, rng: np.random.Generator) -> Sweep:
    sweep.intensity[:] *= 1.0 - 0.01 * severity
    return sweep


def not_a_number(sweep: Sweep, severity: int, rng: np.random.Generator) -> Sweep:
    return replace(sweep, points=np.where(rng.random((len(sweep), 1)) < 0.5, np.float32(np.nan), sweep.points))


def unseeded(sweep: Sweep, severity: int, rng: np.random.Generator) -> Sweep:
    return keep(sweep, severity, np.random.default_rng())


def backwards(sweep: Sweep, severity: int, rng: np.random.Generator) -> Sweep:
    return keep(sweep, 6 - severity, rng)


def unmarked(sweep: Sweep, severity: int, rng: np.random.Generator) -> Sweep:
    return replace(sweep, object_id=np.full(len(sweep), ADDED, np.int32))


def needs_points(sweep: Sweep, severity: int, rng: np.random.Generator) -> Sweep:
    return sweep[sweep.range < sweep.range.max() - severity]


def of_another_type(sweep: Sweep, severity: int, rng: np.random.Generator) -> np.ndarray:
    return sweep.points


def bright(sweep: Sweep, severity: int, rng: np.random.Generator) -> Sweep:
    return replace(sweep, intensity=sweep.intensity * np.float32(255.0))


def idle(sweep: Sweep, severity: int, rng: np.random.Generator) -> Sweep:
    return sweep


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (in_place, "severity 1: expected the input untouched, found it changed in place"),
        (not_a_number, "severity 1: points: expected finite coordinates, found nan or inf in "),
        (unseeded, "expected the same bytes for the same seed, found others"),
        (backwards, "severity 2: expected less signal than at severity 1, found "),
        (unmarked, "severity 1: fate: expected SCATTERED for points of object ADDED and for no others"),
        (needs_points, "severity 1: raised ValueError: "),
        (of_another_type, "severity 1: raised TypeError: expected a Sweep, found ndarray"),
        (bright, "severity 1: intensity: expected 0 to 1, found "),
        (idle, "severity 3: expected a change, found the clean frame"),
    ],
)
def test_a_broken_rule_is_one_clear_line(broken: object, message: str) -> None:
    with pytest.raises(SettingsError) as caught:
        check_corruption(broken)  # type: ignore[arg-type]
    lines = str(caught.value).splitlines()
    assert any(line.startswith(f"corruption '{broken.__name__}': {message}") for line in lines), lines  # type: ignore[attr-defined]
    assert all(line.startswith("corruption '") for line in lines)


def test_a_function_that_keeps_the_rules_passes() -> None:
    check_corruption(keep)


def test_weather_never_sees_farther(monkeypatch: pytest.MonkeyPatch) -> None:
    def farther(sweep: Sweep, settings: object, rng: np.random.Generator) -> Sweep:
        return replace(sweep, points=sweep.points * np.float32(1.1))

    fog = CORRUPTIONS["fog"]
    monkeypatch.setitem(CORRUPTIONS._values, "fog", Corruption(fog.settings, farther, weather=True))
    with pytest.raises(SettingsError, match="severity 1: expected no range beyond the clean one, found "):
        check_corruption("fog")
