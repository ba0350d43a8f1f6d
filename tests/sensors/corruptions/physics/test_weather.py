"""Drift of the weather: shared, smooth, independent of the order of frames."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sensors.corruptions.physics.weather import DRIFT, strength, weather_rng

SEEDS = st.integers(0, 2**63)
TIMES = st.floats(0.0, 1e5)


@given(SEEDS, TIMES)
def test_strength_stays_near_the_severity(seed: int, time_s: float) -> None:
    assert 1.0 - DRIFT <= strength(seed, "fog", time_s) <= 1.0 + DRIFT


@given(SEEDS, TIMES)
def test_strength_hardly_changes_from_frame_to_frame(seed: int, time_s: float) -> None:
    assert abs(strength(seed, "fog", time_s + 0.1) - strength(seed, "fog", time_s)) < 0.005


@given(SEEDS, TIMES)
def test_strength_is_a_function_of_seed_kind_and_time(seed: int, time_s: float) -> None:
    assert strength(seed, "snow", time_s) == strength(seed, "snow", time_s)


@pytest.mark.parametrize(("seed", "kind"), [(2, "fog"), (1, "snow")])
def test_other_drives_and_kinds_have_other_weather(seed: int, kind: str) -> None:
    times = np.arange(0.0, 60.0, 5.0)
    one, other = ([strength(s, k, t) for t in times] for s, k in ((1, "fog"), (seed, kind)))
    assert np.abs(np.subtract(one, other)).max() > 0.01


def test_weather_changes_within_a_drive() -> None:
    values = [strength(seed, "fog", t) for seed in range(20) for t in (0.0, 30.0, 60.0)]
    assert np.std(values) > 0.04
    assert abs(np.mean(values) - 1.0) < 0.03


def test_the_stream_of_a_drive_is_its_own() -> None:
    assert weather_rng(1, "snow").random() == weather_rng(1, "snow").random() != weather_rng(2, "snow").random()
