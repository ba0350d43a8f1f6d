"""Published settings by name: what other benchmarks do, on our clouds."""

import numpy as np
import pytest

import dsrc
from sensors.corruptions import CORRUPTIONS, PRESETS, settings_of
from sensors.corruptions.check import example_frame
from sensors.corruptions.published.beams import PaperCrossSensor, kept_points
from sensors.corruptions.published.points import apply_motion_blur
from sensors.corruptions.published.wet_ground import PaperWetGround, corrupt
from sim.errors import SettingsError

NAMED = [(kind, name) for kind, named in PRESETS.items() for name in named]


@pytest.mark.parametrize(("kind", "name"), NAMED)
def test_a_preset_is_of_the_model_whose_family_it_names(kind: str, name: str) -> None:
    family, settings = settings_of(kind, preset=name)
    assert type(settings) is type(CORRUPTIONS[kind].settings_of(family).severity(3))


def test_robo3d_and_multicorrupt_have_every_level_of_every_kind() -> None:
    for kind, named in PRESETS.items():
        robo3d, multi = ([name for name in named if name.startswith(who)] for who in ("robo3d", "multicorrupt"))
        assert all(any(level in name for name in robo3d) for level in ("light", "moderate", "heavy")) or not robo3d
        assert len(multi) in (0, 3), kind


@pytest.mark.parametrize(("level", "beams"), [(1, 16), (2, 8), (3, 4)])
def test_multicorrupt_keeps_evenly_spaced_beams_of_nuscenes(level: int, beams: int) -> None:
    from_bottom = np.arange(32)
    points = np.ones((32, 3))
    _, settings = settings_of("cross_sensor", preset=f"multicorrupt_{level}")
    kept = from_bottom[kept_points(points, 31 - from_bottom, 32, settings)]
    assert kept.tolist() == list(range(1, 32, 32 // beams))


@pytest.mark.parametrize(("level", "deviation"), [(1, 0.06), (2, 0.10), (3, 0.13)])
def test_multicorrupt_shifts_the_frame_and_shakes_each_axis(level: int, deviation: float) -> None:
    cloud = np.zeros((20_000, 4))
    _, settings = settings_of("motion_blur", preset=f"multicorrupt_{level}")
    moved = np.stack([apply_motion_blur(cloud, settings, np.random.default_rng(seed)) for seed in range(40)])
    assert moved[..., :3].std(axis=1).mean(axis=0) / deviation == pytest.approx([0.15, 0.2, 0.12], rel=0.02)
    assert moved[..., :3].mean(axis=1).std() == pytest.approx(deviation, rel=0.2)


def test_the_electromagnetic_interference_of_coopdiff_is_the_cross_sensor_of_dsrc() -> None:
    assert PRESETS["cross_sensor"]["coopdiff_emi"] == PRESETS["cross_sensor"]["dsrc"]
    assert PRESETS["cross_sensor"]["coopdiff_emi"] == PaperCrossSensor(rings="azimuth_wrap")


def test_the_water_of_coopdiff_is_a_filled_pavement() -> None:
    cloud = np.column_stack([(sweep := example_frame().agents[0].sweep).points, sweep.intensity])
    (wet, filled) = (
        corrupt(sweep, settings, np.random.default_rng(0))
        for settings in (
            PRESETS["wet_ground"]["coopdiff_water"],
            PaperWetGround(water_mm=1.2, noise_factor=0.25, scale=1),
        )
    )
    assert np.array_equal(wet.points, filled.points)
    assert np.array_equal(wet.intensity, filled.intensity)
    assert len(dsrc.corrupt(cloud, "wet_ground", preset="coopdiff_water")) == len(wet) < len(cloud)


def test_an_unknown_preset_is_one_line() -> None:
    with pytest.raises(SettingsError, match=r"preset: expected a published setting, found robo3d; did you mean"):
        settings_of("fog", preset="robo3d")
    with pytest.raises(SettingsError, match="found robo3d_light; there is none of noise"):
        settings_of("noise", preset="robo3d_light")


@pytest.mark.parametrize("beside", [{"severity": 3}, {"family": "paper"}])
def test_a_preset_is_not_taken_beside_a_severity_or_a_family(beside: dict) -> None:
    with pytest.raises(SettingsError, match=r"preset \w+ has a severity and family of its own; leave out the [sf]"):
        settings_of("fog", preset="robo3d_heavy", **beside)
