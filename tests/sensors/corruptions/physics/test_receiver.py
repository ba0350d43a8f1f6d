"""Receiver of weather: the same as of the scan."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sensors.corruptions.physics.receiver import (
    DEFAULT_RANGE_10_M,
    DEFAULT_REFLECTIVITY,
    FULL_OVERLAP_M,
    OVERLAP_START_M,
    detection_threshold,
    overlap,
    reported_intensity,
    target_power,
)
from sensors.optics.reflectance import CLEAR_AIR_EXTINCTION, optics_of
from sensors.presets import LIDARS
from sensors.sweep import UNKNOWN_MATERIAL
from sim.mesh.materials import MATERIALS
from tests.sensors.corruptions.street import on_a_ray, spinning

REACH = np.array([3.0, 20.0, 60.0])


def test_the_detection_threshold_is_that_of_the_scan() -> None:
    spec = spinning(range_10_m=70.0)
    assert math.isclose(detection_threshold(spec), 0.1 * math.exp(-2.0 * CLEAR_AIR_EXTINCTION * 70.0) / 70.0**2)
    tables = optics_of(spec)
    distance = np.linspace(0.0, tables.reach_m, len(tables.need))[1:]
    # The scan asks for the power relative to a white surface at the same range.
    weakest = tables.need[1:] * np.exp(-2.0 * CLEAR_AIR_EXTINCTION * distance) / distance**2
    assert np.allclose(weakest, detection_threshold(spec), rtol=1e-5)
    assert detection_threshold(spec, 20.0) > detection_threshold(spec) and detection_threshold(spec, math.inf) == 0.0


def test_sensors_without_a_threshold_have_the_hdl_64e_s_in_weather() -> None:
    simulated = {name for name, spec in LIDARS.items() if spec.range_10_m > spec.range_max_m}
    assert simulated == {"opv2v-64", "carla-64", "debug-16"}
    assert LIDARS["hdl-64e-s2"].range_10_m == DEFAULT_RANGE_10_M
    for name, spec in LIDARS.items():
        assert detection_threshold(spec) == detection_threshold(
            None, DEFAULT_RANGE_10_M if name in simulated else spec.range_10_m
        )
    assert detection_threshold(None) == detection_threshold(LIDARS["hdl-64e-s2"])


@pytest.mark.parametrize("law", ["reflectivity", "power", "distance"])
def test_target_power_is_the_scan_s_for_every_intensity_law(law: str) -> None:
    spec = spinning(intensity_law=law)
    tables, material, cosine = optics_of(spec), 2, 0.8
    white = tables.power[material, round(cosine * 1024)]
    intensity = np.interp(REACH, np.linspace(0.0, tables.reach_m, len(tables.scale)), tables.scale)
    intensity *= white if tables.of_material else 1.0
    sweep = on_a_ray(REACH, np.minimum(intensity, 1.0), spec)
    sweep = replace(sweep, material=np.full(3, material, np.uint8), cosine=np.full(3, cosine, np.float32))
    expected = white * np.exp(-2.0 * CLEAR_AIR_EXTINCTION * REACH) / REACH**2
    capped = intensity > 1.0  # received power saturates up close
    assert np.allclose(target_power(sweep, REACH)[~capped], expected[~capped], rtol=2e-3)
    assert capped.sum() == (law == "power" and MATERIALS[material].reflectivity > 0.09)


def test_distance_intensity_without_a_material_is_uninformative() -> None:
    sweep = on_a_ray(REACH, np.exp(-0.004 * REACH), spinning(intensity_law="distance"))
    assert (sweep.material == UNKNOWN_MATERIAL).all()
    assert np.allclose(target_power(sweep, REACH), DEFAULT_REFLECTIVITY / REACH**2)


@pytest.mark.parametrize("law", ["reflectivity", "power"])
def test_intensity_and_power_undo_each_other(law: str) -> None:
    spec = spinning(intensity_law=law)
    sweep = on_a_ray(REACH, np.array([0.1, 0.4, 0.9]), spec)
    assert np.allclose(reported_intensity(spec, target_power(sweep, REACH), REACH), sweep.intensity)
    assert reported_intensity(spec, np.array([50.0]), np.array([1.0])) == 1.0


def test_the_receiver_is_blind_at_close_range() -> None:
    assert overlap(
        np.array([0.0, OVERLAP_START_M, 0.5 * (OVERLAP_START_M + FULL_OVERLAP_M), FULL_OVERLAP_M, 80.0])
    ).round(6).tolist() == [
        0.0,
        0.0,
        0.5,
        1.0,
        1.0,
    ]
