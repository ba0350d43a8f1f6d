"""The world of a drive is drawn, or said to be missing in a line."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from dsrc.review.static import WORLD, StaticPart, cut_around, static_parts
from sim.catalog.load import load_scenario
from sim.errors import DataError
from sim.world.build import build_world
from sim.world.world_file import save_world


@pytest.mark.parametrize("seed", [[1], None, float("inf"), "x"])
def test_a_seed_that_is_no_number_is_told(seed: Any) -> None:
    protocol = {"testbed": {"scenario": {"name": "four_way"}, "seed": seed}}
    with pytest.raises(DataError, match="roads and buildings are not drawn"):
        static_parts(protocol, np.zeros(3), np.zeros((1, 2)))


def test_a_drive_is_drawn_in_the_world_that_was_recorded_and_one_that_is_damaged_is_told(tmp_path: Path) -> None:
    scenario = load_scenario("ped_dartout")
    protocol = {"testbed": {"scenario": msgspec.to_builtins(scenario), "seed": 1}}
    recorded = build_world(scenario, 1)
    recorded.vertices[:, 2] += 5.0
    save_world(recorded, {}, tmp_path / WORLD)
    there = (np.zeros(3), np.zeros((1, 2)))
    built, read = (
        {part.name: part.vertices for part in static_parts(protocol, *there, folder, radius_m=1e4)}
        for folder in (None, tmp_path)
    )
    assert built.keys() == read.keys() >= {"roads", "buildings"}
    assert read["roads"][:, 2].mean() - built["roads"][:, 2].mean() == pytest.approx(5.0, abs=0.01)
    (tmp_path / WORLD).write_bytes(b"none")
    with pytest.raises(DataError, match=r"roads and buildings are not drawn: .*world\.npz"):
        static_parts(protocol, *there, tmp_path)


def test_a_world_is_cut_to_what_is_near_and_keeps_the_ground_below() -> None:
    corners = np.array([[-500, -500], [500, -500], [0, 900], [90, 0], [91, 0], [90, 1]], float)
    vertices = np.column_stack([corners, np.zeros(6)]).astype(np.float32)
    parts = [
        StaticPart("ground", vertices[:3], np.array([[0, 1, 2]], np.uint32)),
        StaticPart("roads", vertices, np.array([[0, 1, 2], [3, 4, 5]], np.uint32)),
        StaticPart("plants", vertices[3:], np.array([[0, 1, 2]], np.uint32)),
    ]
    cut = {part.name: part for part in cut_around(parts, np.zeros(2), 80.0)}
    assert list(cut) == ["ground", "roads"] and len(cut["roads"].vertices) == 3
    np.testing.assert_array_equal(cut["roads"].vertices[cut["roads"].faces[0]], vertices[:3])
    assert len(cut_around(parts, np.zeros(2), 100.0)) == 3
