"""OpenSCENARIO files that scenariogeneration writes are played by the standard: trajectories, speeds, lane changes."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dsrc.data.datasets.tracks import record_tracks
from sim.errors import DataError
from sim.roads.opendrive import LanePlace, OpenDrive
from sim.traffic.tracks.base import Track
from sim.traffic.tracks.open import read_tracks

pytest.importorskip("scenariogeneration", reason="the package is not installed: pip install scenariogeneration")

from scenariogeneration import xodr, xosc

LANE_M = 3.5
RADIUS_M = 120.0


def write_road(path: Path, bent: bool = False) -> Path:
    """A road of two lanes each way: 400 m straight, or a straight, a clothoid and an arc."""
    pieces = [xodr.Line(400)]
    if bent:
        bend = 1.0 / RADIUS_M
        pieces = [xodr.Line(50), xodr.Spiral(1e-12, bend, 40), xodr.Arc(bend, length=100)]
    road = xodr.create_road(pieces, 7, left_lanes=2, right_lanes=2, lane_width=LANE_M)
    drive = xodr.OpenDrive("road")
    drive.add_road(road)
    drive.adjust_roads_and_lanes()
    drive.write_xml(str(path))
    return path


def vehicle(name: str, kind: Any = xosc.VehicleCategory.car) -> Any:
    box = xosc.BoundingBox(1.8, 4.5, 1.5, 1.4, 0.0, 0.75)
    axles = (xosc.Axle(0.5, 0.6, 1.6, 2.7, 0.3), xosc.Axle(0.5, 0.6, 1.6, 0.0, 0.3))
    return xosc.Vehicle(name, kind, box, *axles, 60, 10, 10)


def near(distance_m: float) -> Any:
    condition = xosc.TimeHeadwayCondition("a", distance_m, xosc.Rule.lessThan)
    return xosc.EntityTrigger("near", 0, xosc.ConditionEdge.none, condition, "a")


def at(time_s: float, point: str = "start") -> Any:
    condition = xosc.SimulationTimeCondition(time_s, xosc.Rule.greaterThan)
    return xosc.ValueTrigger("time", 0, xosc.ConditionEdge.none, condition, triggeringpoint=point)


def step_speed(value: float) -> Any:
    dynamics = xosc.TransitionDynamics(xosc.DynamicsShapes.step, xosc.DynamicsDimension.time, 0)
    return xosc.AbsoluteSpeedAction(value, dynamics)


def write_scenario(
    path: Path, init: dict[str, list[Any]], events: list[tuple[str, float, Any]], end: float = 8.0, minor: int = 1
) -> Path:
    entities, start = xosc.Entities(), xosc.Init()
    for name, actions in init.items():
        entities.add_scenario_object(name, vehicle(name))
        for action in actions:
            start.add_init_action(name, action)
    story = xosc.StoryBoard(start, at(end, "stop"))
    for k, (name, time_s, action) in enumerate(events):
        event = xosc.Event(f"event {k}", xosc.Priority.parallel)
        event.add_trigger(at(time_s))
        event.add_action(f"action {k}", action)
        maneuver = xosc.Maneuver(f"maneuver {k}")
        maneuver.add_event(event)
        story.add_maneuver(maneuver, name)
    roads = xosc.RoadNetwork(roadfile="road.xodr")
    scenario = xosc.Scenario(
        "s", "a", xosc.ParameterDeclarations(), entities, story, roads, xosc.Catalog(), osc_minor_version=minor
    )
    scenario.write_xml(str(path))
    return path


def play(path: Path) -> dict[str, Track]:
    (recording,) = read_tracks(path)
    assert len(recording.lanes) > 0
    return {one.name: one for one in recording.tracks}


def reference(one: Track, time_s: float) -> np.ndarray:
    """Return the reference point and the heading at a time: 1.4 m behind the middle of the box."""
    row = int(np.argmin(np.abs(one.time_s - time_s)))
    assert one.time_s[row] == pytest.approx(time_s)
    x, y = one.center[row, :2] - 1.4 * np.array([np.cos(one.yaw[row]), np.sin(one.yaw[row])])
    return np.array([x, y, one.yaw[row]])


@pytest.mark.parametrize("minor", [0, 1, 2, 3])
@pytest.mark.parametrize("shape", ["sinusoidal", "linear", "cubic"])
def test_a_cut_in_crosses_to_the_next_lane_in_its_time(tmp_path: Path, minor: int, shape: str) -> None:
    write_road(tmp_path / "road.xodr")
    dynamics = xosc.TransitionDynamics(getattr(xosc.DynamicsShapes, shape), xosc.DynamicsDimension.time, 3.0)
    init = {
        "ego": [xosc.TeleportAction(xosc.LanePosition(50, 0, -2, 7)), step_speed(15)],
        "other": [xosc.TeleportAction(xosc.LanePosition(60, 0, -1, 7)), step_speed(18)],
    }
    events = [("other", 2.0, xosc.RelativeLaneChangeAction(-1, "other", dynamics))]
    tracks = play(write_scenario(tmp_path / "cut_in.xosc", init, events, minor=minor))
    other = tracks["other"]
    np.testing.assert_allclose(reference(tracks["ego"], 6.0), [50 + 90, -1.5 * LANE_M, 0.0], atol=1e-6)
    np.testing.assert_allclose(reference(other, 2.0), [60 + 36, -0.5 * LANE_M, 0.0], atol=0.1)
    _, y, heading = reference(other, 3.5)
    assert y == pytest.approx(-LANE_M, abs=0.1)  # halfway in half the time
    assert -0.3 < heading < -0.02
    np.testing.assert_allclose(reference(other, 6.0)[1:], [-1.5 * LANE_M, 0.0], atol=1e-6)
    assert reference(other, 6.0)[0] == pytest.approx(60 + 6 * 18, abs=0.5)
    assert record_tracks(tmp_path / "cut_in.xosc", tmp_path / "log")[0].exists()


def test_lanes_of_the_other_way_are_driven_backwards_along_the_road(tmp_path: Path) -> None:
    write_road(tmp_path / "road.xodr")
    dynamics = xosc.TransitionDynamics(xosc.DynamicsShapes.linear, xosc.DynamicsDimension.distance, 30.0)
    init = {"a": [xosc.TeleportAction(xosc.LanePosition(300, 0, 2, 7)), step_speed(10)]}
    events = [("a", 1.0, xosc.RelativeLaneChangeAction(1, "a", dynamics))]
    track = play(write_scenario(tmp_path / "a.xosc", init, events))["a"]
    x, y, heading = reference(track, 1.0)
    assert (x, y) == (pytest.approx(290.0, abs=0.6), pytest.approx(1.5 * LANE_M))
    assert abs(abs(heading) - math.pi) < 1e-6
    assert reference(track, 6.0)[1] == pytest.approx(0.5 * LANE_M)


def test_speeds_change_in_their_shapes(tmp_path: Path) -> None:
    write_road(tmp_path / "road.xodr")
    slow = xosc.TransitionDynamics(xosc.DynamicsShapes.linear, xosc.DynamicsDimension.rate, 4.0)
    init = {"a": [xosc.TeleportAction(xosc.LanePosition(10, 0, -1, 7)), step_speed(20)]}
    track = play(write_scenario(tmp_path / "a.xosc", init, [("a", 1.0, xosc.AbsoluteSpeedAction(8, slow))]))["a"]
    assert reference(track, 1.0)[0] == pytest.approx(30.0, abs=0.1)
    assert reference(track, 4.0)[0] == pytest.approx(30.0 + 3 * 14.0, abs=0.3)  # 12 m/s less in 3 s
    assert reference(track, 7.0)[0] == pytest.approx(72.0 + 24.0, abs=0.3)


def test_a_bent_lane_is_followed_at_its_speed(tmp_path: Path) -> None:
    road = OpenDrive(write_road(tmp_path / "road.xodr", bent=True))
    init = {"a": [xosc.TeleportAction(xosc.LanePosition(20, 0, -2, 7)), step_speed(15)]}
    track = play(write_scenario(tmp_path / "a.xosc", init, []))["a"]
    way = np.hypot(
        *np.diff(track.center[:, :2] - 1.4 * np.column_stack([np.cos(track.yaw), np.sin(track.yaw)]), axis=0).T
    )
    np.testing.assert_allclose(way, 15 * 0.05, rtol=0.01)
    x, y, _, heading = road.place("end", LanePlace("7", -2, 120.0))
    gaps = np.hypot(track.center[:, 0] - 1.4 * np.cos(track.yaw) - x, track.center[:, 1] - 1.4 * np.sin(track.yaw) - y)
    assert gaps.min() < 0.5
    assert track.yaw[int(np.argmin(gaps))] == pytest.approx(heading, abs=0.01)
    assert heading == pytest.approx(20.0 / RADIUS_M + 30.0 / RADIUS_M, abs=1e-6)  # half a clothoid's turn, an arc's


@pytest.mark.parametrize("minor", [0, 1, 2])
def test_a_trajectory_is_interpolated_between_its_vertices(tmp_path: Path, minor: int) -> None:
    write_road(tmp_path / "road.xodr")
    places = [xosc.WorldPosition(x, y, 0, h) for x, y, h in ((0, 0, 0), (20, 0, 0), (30, 10, math.pi / 2))]
    trajectory = xosc.Trajectory("t", False)
    trajectory.add_shape(xosc.Polyline([0, 2, 4], places))
    follow = xosc.FollowTrajectoryAction(
        trajectory, xosc.FollowingMode.position, xosc.ReferenceContext.relative, 1, 0.5
    )
    init = {"a": [xosc.TeleportAction(places[0]), step_speed(1)]}
    track = play(write_scenario(tmp_path / "a.xosc", init, [("a", 1.0, follow)], minor=minor))["a"]
    np.testing.assert_allclose(reference(track, 2.5), [10, 0, 0], atol=1e-6)
    np.testing.assert_allclose(reference(track, 4.5), [25, 5, math.pi / 4], atol=1e-6)
    np.testing.assert_allclose(reference(track, 8.0), [30, 10, math.pi / 2], atol=1e-6)


def test_what_is_not_played_is_named(tmp_path: Path) -> None:
    write_road(tmp_path / "road.xodr")
    place = xosc.TeleportAction(xosc.LanePosition(10, 0, -1, 7))
    path = tmp_path / "a.xosc"

    def refused(init: dict[str, list[Any]], events: list[tuple[str, float, Any]], says: str) -> None:
        write_scenario(path, init, events)
        with pytest.raises(DataError, match=says) as wrong:
            read_tracks(path)
        assert "\n" not in str(wrong.value)

    dynamics = xosc.TransitionDynamics(xosc.DynamicsShapes.linear, xosc.DynamicsDimension.time, 1)
    far = xosc.TeleportAction(xosc.LanePosition(9999, 0, -1, 7))
    nowhere = xosc.TeleportAction(xosc.LanePosition(10, 0, -5, 7))
    refused({"a": [far]}, [], r"expected s in \[0, 400\] on road 7, found 9999")
    refused({"a": [nowhere]}, [], "expected a lane of road 7 at s = 10, found -5")
    refused({"a": [place]}, [("a", 1.0, xosc.AbsoluteLaneChangeAction(-9, dynamics))], "a lane of road 7, found -9")
    refused(
        {"a": [place]}, [("a", 1.0, xosc.AcquirePositionAction(xosc.WorldPosition()))], "found AcquirePositionAction"
    )
    story = xosc.StoryBoard(xosc.Init(), at(5.0, "stop"))
    event = xosc.Event("cut in", xosc.Priority.parallel)
    event.add_trigger(near(2.0))
    event.add_action("go", step_speed(3))
    maneuver = xosc.Maneuver("m")
    maneuver.add_event(event)
    story.add_maneuver(maneuver, "a")
    entities = xosc.Entities().add_scenario_object("a", vehicle("a"))
    roads = xosc.RoadNetwork(roadfile="road.xodr")
    xosc.Scenario("s", "a", xosc.ParameterDeclarations(), entities, story, roads, xosc.Catalog()).write_xml(str(path))
    with pytest.raises(DataError, match=r"StartTrigger of event 'cut in'.*found TimeHeadwayCondition"):
        read_tracks(path)
    (tmp_path / "road.xodr").unlink()
    refused({"a": [place]}, [], "file not found")


def test_roads_in_a_namespace_are_read(tmp_path: Path) -> None:
    path = write_road(tmp_path / "road.xodr")
    path.write_text(path.read_text().replace("<OpenDRIVE", '<OpenDRIVE xmlns="http://code.asam.net/simulation"', 1))
    assert OpenDrive(path).place("lane", LanePlace("7", -1, 10.0))[1] == pytest.approx(-0.5 * LANE_M)


def write_catalog(folder: Path, name: str, *entries: Any) -> None:
    folder.mkdir(exist_ok=True)
    catalog = xosc.CatalogFile()
    catalog.create_catalog(str(folder / f"{name}.xosc"), name, "entries", "a")
    for entry in entries:
        catalog.add_to_catalog(entry)
    catalog.dump()


def from_catalogs(path: Path, *, entry: str = "small", folder: str = "catalogs") -> Path:
    """A vehicle and a maneuver of catalogs: it slows to a speed that the reference gives."""
    write_catalog(path.parent / "catalogs", "Vehicles", vehicle("large"), vehicle("small"))
    slow = xosc.TransitionDynamics(xosc.DynamicsShapes.step, xosc.DynamicsDimension.time, 0)
    parameters = xosc.ParameterDeclarations()
    parameters.add_parameter(xosc.Parameter("wanted", xosc.ParameterType.double, "3"))
    maneuver = xosc.Maneuver("slow", parameters)
    event = xosc.Event("slow", xosc.Priority.parallel)
    event.add_trigger(at(2.0))
    event.add_action("slow", xosc.AbsoluteSpeedAction("$wanted", slow))
    maneuver.add_event(event)
    write_catalog(path.parent / "catalogs", "Maneuvers", maneuver)
    entities, start = xosc.Entities(), xosc.Init()
    entities.add_scenario_object("a", xosc.CatalogReference("Vehicles", entry))
    start.add_init_action("a", xosc.TeleportAction(xosc.LanePosition(10, 0, -1, 7)))
    start.add_init_action("a", step_speed(10))
    reference_to = xosc.CatalogReference("Maneuvers", "slow")
    reference_to.add_parameter_assignment("wanted", 5)
    group = xosc.ManeuverGroup("group")
    group.add_actor("a")
    group.add_maneuver(reference_to)
    act = xosc.Act("act", at(0.0))
    act.add_maneuver_group(group)
    story = xosc.StoryBoard(start, at(6.0, "stop"))
    story.add_act(act)
    catalogs = xosc.Catalog()
    catalogs.add_catalog("VehicleCatalog", folder)
    catalogs.add_catalog("ManeuverCatalog", folder)
    roads = xosc.RoadNetwork(roadfile="road.xodr")
    xosc.Scenario("s", "a", xosc.ParameterDeclarations(), entities, story, roads, catalogs).write_xml(str(path))
    return path


def test_vehicles_and_maneuvers_lie_in_catalogs(tmp_path: Path) -> None:
    write_road(tmp_path / "road.xodr")
    track = play(from_catalogs(tmp_path / "a.xosc"))["a"]
    np.testing.assert_allclose(track.size, [4.5, 1.8, 1.5])
    assert reference(track, 2.0)[0] == pytest.approx(30.0, abs=0.6)
    assert reference(track, 6.0)[0] - reference(track, 3.0)[0] == pytest.approx(15.0, abs=1e-6)


def test_a_catalog_or_an_entry_that_is_not_there_is_named(tmp_path: Path) -> None:
    write_road(tmp_path / "road.xodr")
    with pytest.raises(DataError, match="CatalogReference Vehicles: medium: expected an entry of this name"):
        play(from_catalogs(tmp_path / "a.xosc", entry="medium"))
    with pytest.raises(DataError, match="CatalogReference Vehicles: small: expected a file with this catalog"):
        play(from_catalogs(tmp_path / "a.xosc", folder="elsewhere"))
