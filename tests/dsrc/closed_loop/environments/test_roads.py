"""Lanes of SUMO networks for highway-env: its own arithmetic, faster."""

import numpy as np
import pytest
from highway_env.road.lane import PolyLaneFixedWidth

from dsrc.closed_loop.environments.roads import SampledLane, mirrored_network
from sim.catalog.load import load_scenario
from sim.encounters import network_file

BEND = np.array([[0.0, 0.0], [20.0, 0.0], [30.0, 4.0], [34.0, 14.0], [34.0, 40.3]])


def test_a_place_beside_a_lane_is_where_highway_env_says() -> None:
    ours, theirs = SampledLane(BEND, 3.2, 14.0), PolyLaneFixedWidth(BEND.tolist(), 3.2)
    for place in np.random.default_rng(0).uniform(-15.0, 60.0, (300, 2)):
        assert ours.local_coordinates(place) == pytest.approx(theirs.local_coordinates(place), abs=1e-9)


def test_borders_lie_half_a_width_beside_the_middle() -> None:
    lane = SampledLane(BEND, 3.2, 14.0)
    assert np.allclose(lane.left[0], [0.0, -1.6]) and np.allclose(lane.right[0], [0.0, 1.6])
    assert np.allclose(np.linalg.norm(lane.right - lane.left, axis=1), 3.2)


def test_lanes_in_a_window_are_those_that_touch_it_junctions_below() -> None:
    network = mirrored_network(network_file(load_scenario("four_way"), 1))
    lanes = network.lanes_within(np.array([-1e4, -1e4]), np.array([1e4, 1e4]))
    assert len(lanes) == len(network.lanes_list())
    bordered = [lane.bordered for lane in lanes]
    assert bordered == sorted(bordered) and len(set(bordered)) == 2
    assert network.lanes_within(np.array([1e5, 1e5]), np.array([1e5 + 1, 1e5 + 1])) == []
