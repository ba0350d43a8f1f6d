import numpy as np
import pytest

from sensors.scan.angular_windows import Arcs, angular_windows, arcs_of
from sim.geometry import pose_matrix, transform_points

ALL_AROUND = np.linspace(-np.pi, np.pi, 3600, endpoint=False)
RINGS = np.linspace(1.5, -1.5, 3000)


def columns_in(arcs: Arcs, azimuth: np.ndarray, spread: float = 0.0) -> set[int]:
    return {int(c) for _, first, after in zip(*arcs.columns(azimuth, spread), strict=True) for c in range(first, after)}


@pytest.mark.parametrize("azimuth", [ALL_AROUND, ALL_AROUND[::-1], ALL_AROUND[900:2700], ALL_AROUND + 2.0])
def test_windows_hold_every_point_of_random_boxes(azimuth: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    for _ in range(50):
        size = rng.uniform(0.5, 12, 3)
        pose = pose_matrix(rng.uniform(-15, 15, 3), *rng.uniform(-0.5, 0.5, 3))
        inside = transform_points(pose, rng.uniform(-0.5, 0.5, (200, 3)) * size)
        windows = angular_windows(np.asarray(transform_points(pose, signs * size))[None])
        level = np.hypot(inside[:, 0], inside[:, 1])
        assert (level >= windows.near[0] - 1e-9).all()
        elevation = np.arctan2(inside[:, 2], level)
        assert (elevation >= windows.low[0]).all() and (elevation <= windows.high[0]).all()
        top, bottom = (int(edge[0]) for edge in windows.rings(RINGS, 0.0))
        assert (
            (RINGS >= windows.low[0]) & (RINGS <= windows.high[0]) == np.isin(range(3000), range(top, bottom))
        ).all()
        # A point lies within half a step of the column that is nearest to it, if the field of view goes there.
        away = np.abs(np.angle(np.exp(1j * (azimuth - np.arctan2(inside[:, 1], inside[:, 0])[:, None]))))
        nearest = away.argmin(axis=1)[away.min(axis=1) < 1e-3]
        assert set(nearest.tolist()) <= columns_in(windows.arcs, azimuth)


def test_an_arc_that_the_field_of_view_cuts_has_two_runs() -> None:
    arcs = Arcs(np.array([3.0, 0.5]), np.array([0.3, 0.1]))
    arc, first, after = arcs.columns(ALL_AROUND, 0.0)
    assert arc.tolist() == [0, 0, 1]
    assert first[0] == 0 and after[1] == 3600
    total = (after - first)[:2].sum()
    assert total == pytest.approx(0.3 / (2 * np.pi) * 3600, abs=1)


def test_spread_widens_an_arc_on_both_sides() -> None:
    arcs = Arcs(np.array([0.5]), np.array([0.1]))
    wide, narrow = columns_in(arcs, ALL_AROUND, 0.2), columns_in(arcs, ALL_AROUND)
    assert narrow < wide
    assert len(wide) - len(narrow) == pytest.approx(0.4 / (2 * np.pi) * 3600, abs=2)


def test_a_hull_around_the_sensor_spans_all_columns() -> None:
    ring = np.linspace(0.0, 2 * np.pi, 8)
    surrounding = arcs_of(np.cos(ring)[None], np.sin(ring)[None], np.full((1, 1), 0.1))
    within = arcs_of(np.array([[0.5]]), np.array([[0.0]]), np.array([[2.0]]))
    for arcs in (surrounding, within):
        assert columns_in(arcs, ALL_AROUND) == set(range(3600))


def test_a_disc_spans_twice_the_arcsine_of_its_radius_over_its_distance() -> None:
    arcs = arcs_of(np.array([[10.0]]), np.array([[0.0]]), np.array([[1.0]]))
    assert arcs.width[0] == pytest.approx(2 * np.arcsin(0.1), abs=0.01)
    assert arcs.start[0] == pytest.approx(-np.arcsin(0.1), abs=0.005)
