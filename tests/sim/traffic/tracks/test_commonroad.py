"""CommonRoad files that commonroad-io writes: our tracks are the obstacles that it reads back."""

import logging
import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dsrc.data.datasets.tracks import record_tracks
from sim.errors import DataError
from sim.traffic.tracks.base import Track
from sim.traffic.tracks.open import read_tracks

pytest.importorskip("commonroad", reason="the package commonroad-io is not installed: pip install commonroad-io")

from commonroad.common.file_reader import CommonRoadFileReader
from commonroad.common.file_writer import CommonRoadFileWriter, OverwriteExistingFile, PolygonXMLNode
from commonroad.common.util import AngleInterval, Interval
from commonroad.geometry.shape import Circle, Polygon, Rectangle, Shape, ShapeGroup
from commonroad.planning.planning_problem import PlanningProblemSet
from commonroad.prediction.prediction import Occupancy, SetBasedPrediction, TrajectoryPrediction
from commonroad.scenario.lanelet import Lanelet, LaneletType
from commonroad.scenario.obstacle import DynamicObstacle, ObstacleType, StaticObstacle
from commonroad.scenario.scenario import Scenario, ScenarioID
from commonroad.scenario.trajectory import State, Trajectory
from lxml import etree

STEP_S = 0.2
BOX = Rectangle(4.6, 1.9)


def state(step: int, position: Any, yaw: Any = 0.3) -> State:
    return State(time_step=step, position=position, orientation=yaw, velocity=8.0, acceleration=0.0)


def driven(number: int, shape: Shape = BOX, kind: ObstacleType = ObstacleType.CAR) -> DynamicObstacle:
    """On along a bow of 50 m radius at 8 m/s."""

    def at(step: int) -> State:
        turn = 0.3 + 8.0 * STEP_S * step / 50.0
        return state(step, 50.0 * np.array([math.sin(turn), -math.cos(turn) + number]), turn)

    states = [at(step) for step in range(1, 11)]
    return DynamicObstacle(number, kind, shape, at(0), TrajectoryPrediction(Trajectory(1, states), shape))


def lanelet() -> Lanelet:
    """Left bound, centre and right bound; a published file has more points on one side, see `write`."""
    along = np.linspace(-10.0, 60.0, 8)
    left, middle, right = (np.column_stack([along, np.full(8, y)]) for y in (2.0, 0.0, -2.0))
    return Lanelet(left, middle, right, 900, lanelet_type={LaneletType.URBAN})


def write(path: Path, obstacles: Sequence[Any], version: str = "2020a", unequal: bool = False) -> Path:
    scenario = Scenario(STEP_S, ScenarioID(country_id="ZAM", map_name="Test", map_id=1))
    scenario.add_objects([lanelet(), *obstacles])
    writer = CommonRoadFileWriter(scenario, PlanningProblemSet(), "a", "b", "c", set(), decimal_precision=9)
    writer.write_scenario_to_file(str(path), OverwriteExistingFile.ALWAYS)
    tree = ET.parse(path)
    if unequal:
        bound = tree.find("lanelet/rightBound")
        assert bound is not None
        for point in bound.findall("point")[2:5]:
            bound.remove(point)
    if version == "2018b":  # which the library reads and no longer writes
        tree.getroot().set("commonRoadVersion", version)
        tree.getroot().set("tags", "urban")
        for tag in ("dynamicObstacle", "staticObstacle"):
            for obstacle in tree.findall(tag):
                obstacle.tag = "obstacle"
                role = ET.Element("role")
                role.text = tag.removesuffix("Obstacle")
                obstacle.insert(0, role)
    tree.write(path)
    return path


def by_name(path: Path) -> dict[str, Track]:
    return {one.name: one for one in read_tracks(path)[0].tracks}


def expected(path: Path, number: int, steps: Sequence[int]) -> np.ndarray:
    """Return rows of time, x, y and yaw as the library reads them."""
    scenario, _ = CommonRoadFileReader(str(path)).open()
    obstacle = scenario.obstacle_by_id(number)
    states = {step: obstacle.state_at_time(step) for step in steps}
    return np.array([[step * scenario.dt, *one.position, one.orientation] for step, one in states.items()])


def rows_of(one: Track) -> np.ndarray:
    return np.column_stack([one.time_s, one.center[:, :2], one.yaw])


@pytest.mark.parametrize("version", ["2018b", "2020a"])
def test_tracks_are_the_states_that_the_library_reads(tmp_path: Path, version: str) -> None:
    parked = StaticObstacle(5, ObstacleType.PARKED_VEHICLE, BOX, state(0, np.array([30.0, 3.5]), 0.1))
    path = write(tmp_path / "a.xml", [driven(1), driven(2, kind=ObstacleType.TRUCK), parked], version)
    tracks = by_name(path)
    assert [(one.name, one.class_name) for one in tracks.values()] == [("1", "car"), ("2", "truck"), ("5", "car")]
    for number in (1, 2):
        np.testing.assert_allclose(rows_of(tracks[str(number)]), expected(path, number, range(11)), atol=1e-6)
    stands = tracks["5"]
    assert (stands.time_s[0], stands.time_s[-1]) == (0.0, 2.0)
    np.testing.assert_allclose(stands.center[:, :2], [[30.0, 3.5]] * len(stands.time_s))
    np.testing.assert_allclose(tracks["1"].size[:2], [4.6, 1.9])


def test_a_lanelet_may_have_more_points_on_one_side(tmp_path: Path) -> None:
    path = write(tmp_path / "unequal.xml", [driven(1)], unequal=True)
    (outline,) = read_tracks(path)[0].lanes
    assert len(outline) == 8 + 5
    assert all(log.exists() for log in record_tracks(path, tmp_path))


def test_equal_states_of_one_step_count_once_and_others_are_refused(tmp_path: Path) -> None:
    car = driven(1)
    path = write(tmp_path / "twice.xml", [car])
    tree = ET.parse(path)
    trajectory, first = (tree.find(f"dynamicObstacle/{tag}") for tag in ("trajectory", "initialState"))
    assert trajectory is not None and first is not None
    again = ET.fromstring(ET.tostring(first))
    again.tag = "state"
    trajectory.insert(0, again)
    tree.write(path)
    np.testing.assert_allclose(rows_of(by_name(path)["1"]), expected(path, 1, range(11)), atol=1e-6)

    x = again.find("position/point/x")
    assert x is not None
    x.text = "0.5"
    tree.write(path)
    with pytest.raises(DataError, match="obstacle 1: expected one state at step 0, found two that differ"):
        read_tracks(path)


def test_of_intervals_and_areas_the_middle_is_taken(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    areas = [
        Rectangle(2.0, 1.0, np.array([11.0, 3.0]), 0.4),
        Circle(0.5, np.array([12.0, 3.5])),
        Circle(0.5, np.array([13.0, 4.0])),
    ]
    turns = [AngleInterval(0.2, 0.4), AngleInterval(3.1, 3.3), AngleInterval(-0.1, 0.3)]
    states = [state(step + 1, *pair) for step, pair in enumerate(zip(areas, turns, strict=True))]
    first = state(0, np.array([10.0, 3.0]))
    first.velocity = Interval(7.0, 9.0)
    car = DynamicObstacle(7, ObstacleType.CAR, BOX, first, TrajectoryPrediction(Trajectory(1, states), BOX))
    path = write(tmp_path / "a.xml", [car])
    tree = ET.parse(path)
    last = tree.findall(".//state/position")[-1]
    corners = Polygon(np.array([[12.0, 3.0], [14.0, 3.0], [14.0, 5.0], [12.0, 5.0]]))
    last[0] = ET.fromstring(etree.tostring(PolygonXMLNode.create_polygon_node(corners)))
    tree.write(path)
    with caplog.at_level(logging.WARNING):
        track = by_name(path)["7"]
    np.testing.assert_allclose(track.center[:, :2], [[10, 3], [11, 3], [12, 3.5], [13, 4]], atol=1e-6)
    np.testing.assert_allclose(track.yaw, [0.3, 0.3, 3.2, 0.1], atol=1e-6)
    assert any("obstacle 7: of intervals and areas" in record.getMessage() for record in caplog.records)


def test_shapes_become_the_boxes_around_them(tmp_path: Path) -> None:
    corners = np.array([[-1.0, -1.0], [3.0, -1.0], [3.0, 1.0], [-1.0, 1.0]])
    group = ShapeGroup([Rectangle(6.0, 2.0), Circle(1.5)])  # the library writes no centres of a vehicle's shapes
    obstacles = [
        driven(1, Circle(0.4), ObstacleType.PEDESTRIAN),
        driven(2, Polygon(corners)),
        driven(3, group, ObstacleType.BUS),
    ]
    path = write(tmp_path / "shapes.xml", obstacles)
    tracks = by_name(path)
    sizes, ahead = {"1": (0.8, 0.8), "2": (4.0, 2.0), "3": (6.0, 3.0)}, {"1": 0.0, "2": 1.0, "3": 0.0}
    for name, one in tracks.items():
        np.testing.assert_allclose(one.size[:2], sizes[name])
        rows = expected(path, int(name), range(11))
        middle = rows[:, 1:3] + ahead[name] * np.column_stack([np.cos(rows[:, 3]), np.sin(rows[:, 3])])
        np.testing.assert_allclose(one.center[:, :2], middle, atol=1e-6)


def test_sets_of_occupancies_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    occupancies = [Occupancy(step, Rectangle(5.0, 2.0, np.array([step, 0.0]))) for step in range(1, 4)]
    predicted = SetBasedPrediction(1, occupancies)
    car = DynamicObstacle(4, ObstacleType.CAR, BOX, state(0, np.zeros(2)), predicted)
    with caplog.at_level(logging.WARNING):
        assert list(by_name(write(tmp_path / "both.xml", [driven(1), car]))) == ["1"]
    assert any("obstacle 4: moves as a set of occupancies" in record.getMessage() for record in caplog.records)
    with pytest.raises(DataError, match="obstacle 4: expected a trajectory, found a set of occupancies"):
        read_tracks(write(tmp_path / "alone.xml", [car]))
