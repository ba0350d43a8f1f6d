"""Echo of fog: waveform of the published theory, patches of sampled fog."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.stats import ks_2samp

from sensors.corruptions.physics import fog_echo as module
from sensors.corruptions.physics.fog_echo import FogEcho, fog_echo, waveforms
from sensors.optics.reflectance import LIGHT_SPEED
from tests.sensors.corruptions.street import shared

PULSE_S = 2e-8

# Look-up table of the published code: alpha -> distance of the peak (m), integral (1e-9 s/m^2).
TABLE = {
    0.0: (4.7024, 4.6446),
    0.005: (4.7024, 4.5680),
    0.01: (4.7024, 4.4928),
    0.02: (4.7024, 4.3466),
    0.03: (4.7024, 4.2058),
    0.06: (4.6023, 3.8156),
    0.1: (4.6023, 3.3621),
    0.12: (4.6023, 3.1584),
    0.15: (4.6023, 2.8786),
    0.2: (4.5023, 2.4760),
}


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def homogeneous(extinction: float, pulse_s: float = PULSE_S) -> FogEcho:
    return fog_echo(extinction, pulse_s, 1e-3)


def strongest(echo: FogEcho, near_m: float, far_m: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Places and strengths of the strongest echoes between two ranges."""
    near, far = np.full(count, near_m), np.full(count, max(near_m, far_m))
    power = echo.strongest(echo.cells(far) - echo.cells(near), rng(1).standard_exponential(count))
    return echo.place(rng(2).random(count), near, far), power


@pytest.mark.parametrize("alpha", TABLE)
def test_the_echo_is_that_of_the_published_table_but_for_half_a_pulse(alpha: float) -> None:
    distance, integral = TABLE[alpha]
    echo = homogeneous(alpha)
    shift_m = 0.5 * LIGHT_SPEED * PULSE_S
    assert abs(echo.range_m[echo.waveform.argmax()] + shift_m - distance) < 0.06  # the table's grid is 0.1 m
    assert math.isclose(echo.waveform.max(), integral * 1e-9, rel_tol=1e-3)  # nor is its peak on that grid
    place, power = strongest(echo, 0.9, 100.0, 50)
    assert np.allclose(power, integral * 1e-9, rtol=0.01) and np.allclose(place + shift_m, distance, atol=0.15)


def test_the_waveform_is_that_of_the_published_theory() -> None:
    golden = np.load(shared("fog/theory_grid.npz"))
    for t, tau in enumerate(golden["tau_h"]):
        ours = waveforms(golden["alpha"], float(tau), golden["R"])
        for k, target in enumerate(golden["R0"]):
            before = golden["R"] <= target
            theirs = golden["soft_integral"][t, :, k][:, before]
            assert np.abs(ours[:, before] - theirs).max() < 1e-4 * ours.max()


@settings(max_examples=30, deadline=None)
@given(st.floats(0.0, 1.0), st.sampled_from([2e-9, 5e-9, 1e-8, 5e-8]))
def test_the_table_reads_what_the_integral_gives(extinction: float, pulse_s: float) -> None:
    echo = homogeneous(extinction, pulse_s)
    exact = waveforms(np.array([extinction]), pulse_s, echo.range_m + 0.5 * LIGHT_SPEED * pulse_s)[0]
    heard = exact > 1e-3 * exact.max()
    assert np.allclose(echo.waveform[heard], exact[heard], rtol=5e-4)


def test_denser_fog_echoes_less_for_each_unit_of_backscatter() -> None:
    echoes = np.stack([homogeneous(alpha).waveform for alpha in sorted(TABLE)])
    assert (np.diff(echoes, axis=0) < 0.0).all()


@settings(max_examples=50, deadline=None)
@given(st.floats(0.0, 1.0), st.floats(0.01, 0.45), st.floats(0.0, 20.0), st.floats(0.0, 300.0))
@example(0.625, 0.01, 2.40625, 3.0)  # all that counts in a sum of floats lies before the target
def test_echoes_come_from_between_the_nearest_range_and_the_target(
    extinction: float, patchiness: float, near_m: float, far_m: float
) -> None:
    echo = fog_echo(extinction, PULSE_S, patchiness)
    place, power = strongest(echo, near_m, far_m, 40)
    assert (power >= 0.0).all() and np.isfinite(power).all()
    if far_m <= max(near_m, 0.9):
        assert not power.any()
    else:
        heard = power > 1e-6 * echo.waveform.max()
        assert (place[heard] <= far_m + 1e-6).all() and (place[heard] >= near_m - 1e-6).all()


def test_echoes_grow_with_the_target_s_range() -> None:
    echo = fog_echo(0.03, PULSE_S, 0.4)
    power = np.stack([strongest(echo, 0.9, far, 60)[1] for far in np.linspace(0.9, 30.0, 40)])
    assert (np.diff(power, axis=0) >= 0.0).all() and power[0].max() == 0.0


@pytest.mark.parametrize("patchiness", [0.2, 0.4])
def test_patches_are_as_strong_and_as_far_as_those_of_sampled_fog(patchiness: float) -> None:
    echo = fog_echo(0.03, 5e-9, patchiness)
    cell_m = 0.5 * LIGHT_SPEED * 5e-9
    # Cells much shorter than the waveform, each of a fraction of the strength of one: the same law in small.
    cells, beams = 400, 3000
    width = (40.0 - 0.9) / cells
    middle = 0.9 + width * (np.arange(cells) + 0.5)
    patch = (rng(5).standard_exponential((beams, cells)) * cell_m / width) ** -patchiness
    heard = patch / math.gamma(1.0 - patchiness) * np.interp(middle, echo.range_m, echo.waveform)
    place, power = strongest(echo, 0.9, 40.0, beams)
    assert ks_2samp(power, heard.max(axis=1)).pvalue > 0.001
    nearest = np.quantile(place, [0.1, 0.3, 0.5, 0.7, 0.9, 0.97])
    assert np.allclose(nearest, np.quantile(middle[heard.argmax(axis=1)], [0.1, 0.3, 0.5, 0.7, 0.9, 0.97]), rtol=0.06)


def test_patches_have_the_mean_s_density() -> None:
    for patchiness in (0.1, 0.3):
        patch = rng().standard_exponential(200_000) ** -patchiness / math.gamma(1.0 - patchiness)
        assert math.isclose(patch.mean(), 1.0, rel_tol=0.01)
        assert math.isclose(patch.std(), {0.1: 0.14, 0.3: 0.56}[patchiness], rel_tol=0.1)


def test_a_pulse_s_table_is_made_once_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DSRC_CACHE", str(tmp_path))
    made = []

    def make(*args: Any) -> Any:
        made.append(1)
        return waveforms(*args)

    monkeypatch.setattr(module, "waveforms", make)
    for _ in range(2):
        module._waveforms.cache_clear()
        module.fog_echo.cache_clear()
        for extinction in (0.01, 0.02):
            fog_echo(extinction, 3e-9, 0.3)
    assert len(made) == 1
    module._waveforms.cache_clear()
    module.fog_echo.cache_clear()
