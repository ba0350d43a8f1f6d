"""The fit of presets to real sweeps: what it prints of a folder, and nothing without one."""

from pathlib import Path

import numpy as np
import pytest

from studies import sensor_fit
from tests.commands import run_study


@pytest.fixture
def frame(tmp_path: Path) -> Path:
    """Rings of 20 m around a sensor 1.7 m up, listed counter-clockwise from ahead; the lowest lacks what is behind."""
    rng = np.random.default_rng(0)
    rows = []
    for ring in range(16):
        azimuth = np.radians(np.arange(0.25, 360.0, 0.5))
        away = np.full(len(azimuth), 34.0 - 2.0 * ring)
        kept = (np.cos(azimuth) > -0.9) | (ring < 15)
        xyz = np.stack([away * np.cos(azimuth), away * np.sin(azimuth), np.full(len(azimuth), -1.7)], axis=1)
        rows.append(np.column_stack([xyz, np.full(len(azimuth), 0.3)])[kept])
    points = np.concatenate(rows) + rng.normal(0.0, [0.0, 0.0, 0.01, 0.0], (sum(map(len, rows)), 4))
    boxes, kind, empty = np.zeros((0, 7)), np.zeros(0, "U8"), np.zeros(0)
    path = tmp_path / "one.npz"
    np.savez(path, points=points.astype(np.float32), boxes=boxes, kind=kind, ring=empty)
    return path


def test_rings_are_read_from_the_order_of_the_points(frame: Path) -> None:
    sweep, boxes = sensor_fit.read_frame(frame)
    assert len(boxes) == 0
    np.testing.assert_array_equal(np.unique(sweep.ring), np.arange(16))


def test_what_the_carrier_hides_is_drawn(frame: Path) -> None:
    lines = sensor_fit.hidden_sectors([sensor_fit.read_frame(frame)[0]])
    assert len(lines) == 16
    assert "#" in lines[15] and not any("#" in line for line in lines[:15])
    assert lines[15][4] == "#" and lines[15][40] == "."


def test_without_real_sweeps_it_says_so() -> None:
    assert "DSRC_REAL_FRAMES" in run_study("sensor_fit").stdout
