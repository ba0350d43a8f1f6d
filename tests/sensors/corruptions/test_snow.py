"""Snow: flakes, attenuation, echoes; facts shared with fog and rain are in test_medium."""

import itertools
import math

import msgspec
import numpy as np
import pytest

from sensors.corruptions import snow
from sensors.corruptions.physics.snow_flakes import flake_rate, gunn_marshall_rate, occupancy, snow_particles
from sensors.corruptions.snow import Snow
from sensors.presets import LIDARS
from sensors.sweep import ATTENUATED, SCATTERED, Sweep
from sim.errors import SettingsError
from tests.sensors.corruptions.street import on_a_ray, rows_of, same, spinning, street


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def around(reach_m: float, intensity: float, range_10_m: float, count: int = 3000) -> Sweep:
    """Targets all around at one range."""
    sweep = on_a_ray(np.full(count, reach_m), intensity, spinning(1, count, range_10_m=range_10_m))
    azimuth = np.linspace(-np.pi, np.pi, count, endpoint=False)
    sweep.points[:] = reach_m * np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], 1)
    sweep.column[:] = np.arange(count)
    return sweep


def test_snow_fills_the_published_share_of_the_air() -> None:
    assert math.isclose(occupancy(0.5, 2.0, 0.1), 6.9444e-7, rel_tol=1e-4)
    assert math.isclose(occupancy(2.5, 1.6, 0.1), 4.3403e-6, rel_tol=1e-4)


def test_flakes_sizes_follow_gunn_and_marshall() -> None:
    assert math.isclose(gunn_marshall_rate(2.2383844962893775), 1732.094288617883, rel_tol=1e-9)
    # The published light snow, which is the paper's setting, has a rate of 17.32 per cm.
    assert math.isclose(flake_rate(0.5, 0.1), 1732.1, rel_tol=0.06)


@pytest.mark.parametrize("snowfall", [0.1, 0.5, 5.0])
def test_a_medium_of_flakes_holds_the_snow_that_falls(snowfall: float) -> None:
    flakes = snow_particles(snowfall, 1.0, 0.1, 0.2)
    diameter = rng().exponential(1.0 / flakes.rate_per_m, 400_000)
    water_mm_h = flakes.per_m3 * (math.pi / 6.0 * diameter**3).mean() * 0.1 * 1.0 * 3.6e6
    assert math.isclose(water_mm_h, snowfall, rel_tol=0.03)
    assert math.isclose(flakes.extinction, 2.0 * flakes.per_m3 * (math.pi / 4.0 * diameter**2).mean(), rel_tol=0.02)


def test_the_table_of_severities_holds() -> None:
    extinction = [1e3 * snow_particles(s, 1.0, 0.1, 0.2).extinction for s in snow.Snow.LEVELS["snowfall_mm_h"]]
    assert np.allclose(extinction, [0.99, 1.60, 2.29, 4.06, 7.59], rtol=0.01)
    assert Snow() == Snow.severity(3)


def test_heavier_snow_touches_more_beams_and_dims_more() -> None:
    sweep = street(spinning(64, columns=720))
    out = [snow.corrupt(sweep, Snow.severity(level), rng()) for level in range(1, 6)]
    flakes = [(o.fate == SCATTERED).sum() for o in out]
    through = [o.intensity[o.fate == ATTENUATED].mean() for o in out]
    assert all(a < b for a, b in itertools.pairwise(flakes))
    assert all(a > b for a, b in itertools.pairwise(through))


def test_snow_is_as_severe_through_a_simulator_s_sensor_as_through_the_one_that_it_imitates() -> None:
    shares = {}
    for name in ("opv2v-64", "hdl-64e-s2"):
        # The same beams, so that only the receivers differ.
        spec = msgspec.structs.replace(LIDARS["opv2v-64"], range_10_m=LIDARS[name].range_10_m, dropoff_rate=0.0)
        sweep = street(spec)
        out = [snow.corrupt(sweep, Snow.severity(level), rng()) for level in range(1, 6)]
        shares[name] = [(o.fate == SCATTERED).mean() for o in out]
    assert shares["opv2v-64"] == shares["hdl-64e-s2"]
    assert shares["opv2v-64"][4] > 2.0 * shares["opv2v-64"][0] > 0.0


def test_targets_behind_flakes_are_dimmed_by_extinction() -> None:
    sweep = street()
    out = snow.corrupt(sweep, Snow.severity(4), rng())
    seen = out[out.fate == ATTENUATED]
    clean = sweep[rows_of(seen, sweep)]
    extinction = snow_particles(snow.Snow.LEVELS["snowfall_mm_h"][3], 1.0, 0.1, 0.2).extinction
    assert np.allclose(seen.intensity, clean.intensity * np.exp(-2.0 * extinction * clean.range), rtol=1e-5)


def test_bright_targets_are_stronger_than_the_flakes() -> None:
    share = [(snow.corrupt(around(30.0, i, 120.0), Snow(), rng()).fate == SCATTERED).mean() for i in (0.05, 0.3, 1.0)]
    assert share[0] > share[1] > share[2] > 0.0


def test_near_targets_are_detected_more_often_than_far_ones() -> None:
    share = [
        (snow.corrupt(around(reach, 0.2, 120.0), Snow(), rng()).fate == SCATTERED).mean() for reach in (5.0, 15.0, 60.0)
    ]
    assert share[0] < share[1] < share[2]


def test_whiter_and_slower_flakes_return_more_echoes() -> None:
    sweep = around(30.0, 0.2, 120.0)

    def answers(**settings: float) -> int:
        return int((snow.corrupt(sweep, Snow(**settings), rng()).fate == SCATTERED).sum())

    assert answers(flake_reflectivity=0.05) < answers(flake_reflectivity=0.2) < answers(flake_reflectivity=0.9)
    assert answers(fall_speed_mps=2.0) < answers(fall_speed_mps=1.0) < answers(fall_speed_mps=0.5)
    assert answers(flake_reflectivity=0.0) == 0


def test_a_weak_receiver_loses_targets_behind_flakes() -> None:
    sweep = around(38.0, 0.1, 40.0)
    out = snow.corrupt(sweep, Snow(snowfall_mm_h=5.0), rng())
    assert len(out) < len(sweep)


def test_no_snow_is_the_identity() -> None:
    sweep = street()
    assert same(snow.corrupt(sweep, Snow(snowfall_mm_h=0.0), rng()), sweep)


def test_impossible_snow_is_refused_in_one_line() -> None:
    with pytest.raises(SettingsError, match="Snow: snowfall_mm_h: expected 0 to 50, found -1"):
        Snow(snowfall_mm_h=-1.0)
