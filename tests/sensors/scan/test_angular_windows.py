import numpy as np
import pytest

from sensors.scan.angular_windows import angles_of, arc_of, between, runs_of
from sim.geometry import pose_matrix, transform_points

ALL_AROUND = np.linspace(-np.pi, np.pi, 3600, endpoint=False)
RINGS = np.linspace(1.5, -1.5, 3000)


def columns_in(azimuth: np.ndarray, start: float, width: float, spread: float = 0.0) -> set[int]:
    return {c for first, after in runs_of(azimuth, start, width, spread) for c in range(first, after)}


@pytest.mark.parametrize(
    "azimuth",
    [
        ALL_AROUND,
        ALL_AROUND[900:2700],
        *(pytest.param(one, marks=pytest.mark.slow) for one in (ALL_AROUND[::-1], ALL_AROUND + 2.0)),
    ],
)
def test_windows_hold_every_point_of_random_boxes(azimuth: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    for _ in range(50):
        size = rng.uniform(0.5, 12, 3)
        pose = pose_matrix(rng.uniform(-15, 15, 3), *rng.uniform(-0.5, 0.5, 3))
        inside = transform_points(pose, rng.uniform(-0.5, 0.5, (200, 3)) * size)
        seen = angles_of(np.asarray(transform_points(pose, signs * size)))
        level = np.hypot(inside[:, 0], inside[:, 1])
        assert (level >= seen.near - 1e-9).all()
        elevation = np.arctan2(inside[:, 2], level)
        assert (elevation >= seen.low).all() and (elevation <= seen.high).all()
        top, bottom = between(RINGS, seen.low, seen.high)
        assert ((RINGS >= seen.low) & (RINGS <= seen.high) == np.isin(range(3000), range(top, bottom))).all()
        # A point lies within half a step of the column that is nearest to it, if the field of view goes there.
        away = np.abs(np.angle(np.exp(1j * (azimuth - np.arctan2(inside[:, 1], inside[:, 0])[:, None]))))
        nearest = away.argmin(axis=1)[away.min(axis=1) < 1e-3]
        assert set(nearest.tolist()) <= columns_in(azimuth, seen.start, seen.width)


def test_an_arc_that_the_field_of_view_cuts_has_two_runs() -> None:
    cut, whole = (runs_of(ALL_AROUND, *arc, 0.0) for arc in ((3.0, 0.3), (0.5, 0.1)))
    assert len(cut) == 2 and len(whole) == 1
    assert cut[0][0] == 0 and cut[1][1] == 3600
    assert sum(after - first for first, after in cut) == pytest.approx(0.3 / (2 * np.pi) * 3600, abs=1)


def test_spread_widens_an_arc_on_both_sides() -> None:
    wide, narrow = columns_in(ALL_AROUND, 0.5, 0.1, 0.2), columns_in(ALL_AROUND, 0.5, 0.1)
    assert narrow < wide
    assert len(wide) - len(narrow) == pytest.approx(0.4 / (2 * np.pi) * 3600, abs=2)


def test_a_hull_around_the_sensor_spans_all_columns() -> None:
    ring = np.linspace(0.0, 2 * np.pi, 8)
    for discs in ((np.cos(ring), np.sin(ring), 0.1), (np.array([0.5]), np.array([0.0]), 2.0)):
        assert columns_in(ALL_AROUND, *arc_of(*discs)) == set(range(3600))


@pytest.mark.parametrize("azimuth", [ALL_AROUND, ALL_AROUND[::-1], ALL_AROUND[900:2700], ALL_AROUND + 2.0])
def test_no_column_counts_twice_however_wide_an_arc_and_its_spread_are(azimuth: np.ndarray) -> None:
    for start in np.random.default_rng(0).uniform(-np.pi, np.pi, 20):
        for width, spread in ((0.2, 0.1), (2 * np.pi - 0.1, 0.2), (2 * np.pi, 0.0), (2 * np.pi, 0.1)):
            runs = runs_of(azimuth, start, width, spread)
            columns = [column for first, after in runs for column in range(first, after)]
            assert len(columns) == len(set(columns))
            if width + 2 * spread >= 2 * np.pi:
                assert len(columns) == len(azimuth)


def test_a_disc_spans_twice_the_arcsine_of_its_radius_over_its_distance() -> None:
    start, width = arc_of(np.array([10.0]), np.array([0.0]), 1.0)
    assert width == pytest.approx(2 * np.arcsin(0.1), abs=0.01)
    assert start == pytest.approx(-np.arcsin(0.1), abs=0.005)
