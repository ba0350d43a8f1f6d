"""Field of view: a sector from straight ahead."""

import itertools

import numpy as np
import pytest

from sensors.corruptions.field_of_view import FieldOfView, corrupt
from sensors.sweep import make_sweep
from sim.errors import SettingsError
from tests.sensors.corruptions.street import same, street


def rng() -> np.random.Generator:
    return np.random.default_rng(1)


@pytest.mark.parametrize("severity", range(1, 6))
def test_the_sector_lies_straight_ahead(severity: int) -> None:
    sweep = street()
    azimuth = np.degrees(np.arctan2(sweep.points[:, 1], sweep.points[:, 0]))
    assert same(
        corrupt(sweep, FieldOfView.severity(severity), rng()),
        sweep[np.abs(azimuth) < FieldOfView.LEVELS["half_width_deg"][severity - 1] + 1e-3],
    )


def test_it_narrows_with_severity() -> None:
    sizes = [len(corrupt(street(), FieldOfView.severity(severity), rng())) for severity in range(1, 6)]
    assert all(a > b > 0 for a, b in itertools.pairwise(sizes))


def test_it_can_look_elsewhere_across_the_seam() -> None:
    points = np.array([[-1.0, 0.1, 0.0], [-1.0, -0.1, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    assert len(corrupt(make_sweep(points), FieldOfView(half_width_deg=30.0, middle_deg=180.0), rng())) == 2
    assert len(corrupt(make_sweep(points), FieldOfView(half_width_deg=30.0, middle_deg=90.0), rng())) == 1


def test_a_full_circle_keeps_everything_and_no_points() -> None:
    sweep = street()
    assert corrupt(sweep, FieldOfView(half_width_deg=180.0), rng()) is sweep
    assert len(corrupt(sweep[:0], FieldOfView.severity(5), rng())) == 0
    with pytest.raises(SettingsError, match="half_width_deg: expected 0 to 180"):
        FieldOfView(half_width_deg=200.0)
