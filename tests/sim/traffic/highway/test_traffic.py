"""Traffic on highway-env's roads: where its lanes are, physical, reproducible, and without SUMO."""

import inspect
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest
import shapely

from sim.catalog.load import load_scenario
from sim.collisions import overlapping_pairs
from sim.errors import ScenarioError, TrafficError
from sim.geometry import wrap_angle
from sim.scenario import Scenario
from sim.traffic.base import Actors, lit
from sim.traffic.highway.roads import ENVIRONMENTS, read_roads
from sim.traffic.highway.traffic import HighwayTraffic
from sim.traffic.log import TrafficLog
from sim.traffic.open import open_traffic

PLACES = ("merge", "roundabout", "intersection", "racetrack", "two_way")
STEPS = 80


def record(name: str, seed: int, path: Path) -> None:
    with open_traffic(msgspec.structs.replace(load_scenario(f"highway_env_{name}"), warmup_s=2.0), seed) as traffic:
        log = TrafficLog(traffic.step_s)
        for _ in range(20):
            log.append(traffic.step())
    log.save(path)


RECORD = f"""
import sys, msgspec
from pathlib import Path
from sim.catalog.load import load_scenario
from sim.traffic.open import open_traffic
from sim.traffic.log import TrafficLog
{inspect.getsource(record)}
record(sys.argv[1], 1, Path(sys.argv[2]))
"""

WITHOUT_SUMO = """
import sys
from importlib.abc import MetaPathFinder
from pathlib import Path

class Missing(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("libsumo", "traci", "sumolib", "sumo", "eclipse_sumo"):
            raise ModuleNotFoundError(f"{name} is not installed here")

sys.meta_path.insert(0, Missing())
import msgspec
from dsrc.data.write import generate
from dsrc.data.formats.opv2v.reader import DriveReader
from sim.catalog.load import load_scenario
scenario = load_scenario("highway_env_" + sys.argv[1])
units = tuple(msgspec.structs.replace(u, lidar="debug-16") for u in scenario.agents.roadside)
agents = msgspec.structs.replace(scenario.agents, lidar="debug-16", roadside=units)
drive = generate(msgspec.structs.replace(scenario, agents=agents), Path(sys.argv[2]), 3, seed=4)
frames = [DriveReader(drive).read(i) for i in range(3)]
assert all(len(agent.sweep) > 500 for frame in frames for agent in frame.agents)
assert all(frame.points_on.any() for frame in frames)
"""


def scenario_of(name: str) -> Scenario:
    return load_scenario(f"highway_env_{name}")


def soon(name: str) -> Scenario:
    """Return a place whose traffic is taken 2 s after it began: where its age says nothing."""
    return msgspec.structs.replace(scenario_of(name), warmup_s=2.0)


QUICK = ("merge", "intersection")
"""Places of the quick tests: one on which lanes end, one with traffic from all sides."""


@pytest.fixture(
    scope="module", params=[one if one in QUICK else pytest.param(one, marks=pytest.mark.slow) for one in PLACES]
)
def run(request: pytest.FixtureRequest) -> tuple[str, list[Actors]]:
    with HighwayTraffic(scenario_of(request.param), 3) as traffic:
        return request.param, [traffic.actors] + [traffic.step() for _ in range(STEPS)]


def tracks(run: list[Actors]) -> Iterator[tuple[Actors, Actors, int, int]]:
    """Yield (before, after, row before, row after) of everybody who is there at two steps."""
    for before, after in pairwise(run):
        for row, object_id in enumerate(after.boxes.object_id.tolist()):
            if object_id in before.boxes.object_id:
                yield before, after, before.row(object_id), row


def test_there_is_company(run: tuple[str, list[Actors]]) -> None:
    counts = [int(actors.boxes.is_vehicle.sum()) for actors in run[1]]
    assert min(counts) >= 6 and all((a.boxes.center[:, 2] == 0.5 * a.boxes.size[:, 2]).all() for a in run[1])


def test_every_vehicle_is_on_its_lane(run: tuple[str, list[Actors]]) -> None:
    """Within half its width of the centre line; more only where it changes lanes or lanes meet at an angle."""
    name, actors = run
    roads = read_roads(scenario_of(name).network.highway_env)
    lanes = {lane.name: lane for lane in roads.lanes}
    joined = {
        lane.name: shapely.unary_union(
            [shapely.LineString(lane.line)]
            + [shapely.LineString([lane.line[-1], roads.lanes[k].line[0]]) for k in lane.after]
            + [
                shapely.LineString([o.line[-1], lane.line[0]])
                for o in roads.lanes
                if roads.number(lane.index) in o.after
            ]
        )
        for lane in roads.lanes
    }
    away = []
    for now in actors[::5]:
        for row, lane in enumerate(now.lane):
            away.append(joined[lane].distance(shapely.Point(now.boxes.center[row, :2])) / (0.5 * lanes[lane].width))
    assert np.quantile(away, 0.95) < 0.75
    assert max(away) < 1.35


def test_traffic_keeps_to_the_right() -> None:
    with HighwayTraffic(soon("two_way"), 3) as traffic:
        boxes = traffic.actors.boxes
    eastbound = np.cos(boxes.yaw) > 0.0
    assert eastbound.any() and not eastbound.all()
    # The centre line of the road is at y = -2.
    assert (boxes.center[eastbound, 1] < -3.0).all() and (boxes.center[~eastbound, 1] > -1.0).all()


def test_a_roundabout_is_driven_counter_clockwise() -> None:
    with HighwayTraffic(soon("roundabout"), 3) as traffic:
        seen = 0
        for _ in range(60):
            actors = traffic.step()
            inside = np.hypot(*actors.boxes.center[:, :2].T) < 25.5
            x, y = actors.boxes.center[inside, :2].T
            vx, vy = actors.velocity[inside].T
            moving = np.hypot(vx, vy) > 1.0
            assert ((x * vy - y * vx)[moving] > 0.0).all()
            seen += int(moving.sum())
    assert seen > 50


def test_vehicles_look_where_they_go(run: tuple[str, list[Actors]]) -> None:
    for actors in run[1][1:]:
        fast = np.hypot(*actors.velocity.T) > 3.0
        course = np.arctan2(actors.velocity[fast, 1], actors.velocity[fast, 0])
        assert (np.abs(wrap_angle(course - actors.boxes.yaw[fast])) < np.radians(25.0)).all()


def test_nobody_starts_or_drives_inside_another(run: tuple[str, list[Actors]]) -> None:
    assert not any(len(overlapping_pairs(actors.boxes)) for actors in run[1])


@pytest.mark.slow
@pytest.mark.parametrize("name", PLACES)
@pytest.mark.parametrize("seed", range(4, 8))
def test_nobody_drives_inside_another_for_20_s(name: str, seed: int) -> None:
    with HighwayTraffic(scenario_of(name), seed) as traffic:
        assert not any(len(overlapping_pairs(traffic.step().boxes)) for _ in range(200))


def test_motion_is_physical(run: tuple[str, list[Actors]]) -> None:
    sideways, braking = [], []
    for before, after, old, new in tracks(run[1]):
        step = after.boxes.center[new, :2] - before.boxes.center[old, :2]
        assert np.hypot(*step) <= 41.0 * 0.1
        assert after.velocity[new] == pytest.approx(step / 0.1, abs=1e-6)
        assert abs(wrap_angle(after.boxes.yaw[new] - before.boxes.yaw[old])) < 0.25
        yaw = after.boxes.yaw[new]
        forward = np.array([np.cos(yaw), np.sin(yaw)])
        assert step @ forward > -0.02
        sideways.append(abs(after.acceleration[new] @ [-forward[1], forward[0]]))
        braking.append(after.acceleration[new] @ forward)
    assert np.quantile(sideways, 0.99) < 6.0 and max(sideways) < 9.5
    assert -9.5 < min(braking) and max(braking) < 6.0


def test_acceleration_is_the_change_of_the_velocity_and_brakes_light_up(run: tuple[str, list[Actors]]) -> None:
    hard = shown = 0
    for before, after, old, new in tracks(run[1]):
        change = after.velocity[new] - before.velocity[old]
        assert after.acceleration[new] == pytest.approx(change / 0.1, abs=1e-6)
        yaw = after.boxes.yaw[new]
        if after.acceleration[new] @ [np.cos(yaw), np.sin(yaw)] < -2.5:
            hard += 1
            shown += "brake light" in lit(int(after.signals[new]))
    assert shown >= 0.9 * hard


def test_lanes_are_lanes_of_the_roads(run: tuple[str, list[Actors]]) -> None:
    names = {lane.name for lane in read_roads(scenario_of(run[0]).network.highway_env).lanes}
    assert {lane for actors in run[1] for lane in actors.lane} <= names


@pytest.mark.slow
def test_who_leaves_is_replaced() -> None:
    with HighwayTraffic(soon("merge"), 5) as traffic:
        first = set(traffic.actors.boxes.object_id.tolist())
        for _ in range(200):
            last = traffic.step()
    assert len(first - set(last.boxes.object_id.tolist())) > 5
    assert len(set(last.boxes.object_id.tolist()) - first) > 5


@pytest.mark.parametrize("name", ["intersection"])
def test_one_seed_gives_the_same_log_in_two_processes_and_another_gives_another(name: str, tmp_path: Path) -> None:
    files = [tmp_path / f"{k}.npz" for k in range(3)]
    subprocess.run([sys.executable, "-c", RECORD, name, str(files[0])], check=True, timeout=100)
    for path, seed in zip(files[1:], (1, 2), strict=True):
        record(name, seed, path)
    assert files[0].read_bytes() == files[1].read_bytes() != files[2].read_bytes()


def test_what_ran_before_in_a_process_changes_nothing() -> None:
    """highway-env's junction changes the constants of the class of vehicles that it is given."""
    runs = []
    for _ in range(2):
        with HighwayTraffic(soon("merge"), 1) as traffic:
            runs.append([traffic.step().boxes.array for _ in range(20)][-1])
        with HighwayTraffic(soon("intersection"), 1) as traffic:
            traffic.step()
    assert runs[0].tobytes() == runs[1].tobytes()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["roundabout", "merge"])
def test_frames_are_generated_where_sumo_is_not_installed(name: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_SUMO, name, str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_a_commanded_vehicle_stops_within_its_brakes_and_goes_on() -> None:
    with HighwayTraffic(soon("two_way"), 2) as traffic:
        object_id = int(traffic.actors.boxes.object_id[np.abs(traffic.actors.boxes.center[:, 0] - 300.0).argmin()])
        assert traffic.speed(object_id) > 8.0 and traffic.limits(object_id).speed_mps == 20.0
        way = traffic.route(object_id, 50.0)
        length = np.hypot(*np.diff(way, axis=0).T).sum()
        assert length == pytest.approx(50.0, abs=0.2)
        assert way[0] == pytest.approx(traffic.actors.boxes.center[traffic.actors.row(object_id), :2])
        full_brake = traffic.limits(object_id).deceleration_mps2
        brakes = []
        traffic.command(object_id, 0.0)
        for _ in range(100):
            speed = traffic.speed(object_id)
            traffic.step()
            brakes.append((speed - traffic.speed(object_id)) / 0.1)
        assert traffic.speed(object_id) == pytest.approx(0.0, abs=0.01)
        assert 7.5 <= max(brakes) == pytest.approx(full_brake)
        assert traffic.signals(object_id) == () and traffic.claims() == {}
        traffic.command(object_id, None)
        for _ in range(30):
            traffic.step()
        assert traffic.speed(object_id) > 1.0
        with pytest.raises(ValueError, match="speed_mps"):
            traffic.command(object_id, -1.0)
        with pytest.raises(KeyError):
            traffic.speed(7)


def test_a_placed_vehicle_is_on_the_lane_where_it_is_or_off_the_lanes() -> None:
    with HighwayTraffic(soon("merge"), 1) as traffic:
        car = int(traffic.actors.boxes.object_id[traffic.actors.lane.index("a-b_1")])
        for xy, yaw, lane in (
            ((60.0, 0.5), 0.0, "a-b_1"),
            ((62.0, -3.0), 0.0, "a-b_0"),
            ((62.0, -14.0), 0.0, "j-k_0"),
            ((64.0, -14.0), np.pi, "j-k_0"),
            ((64.0, 2.5), 0.0, ""),
            ((64.0, 100.0), 0.0, ""),
        ):
            traffic.place(car, np.array(xy), yaw, 20.0)
            actors = traffic.step()
            assert actors.lane[actors.row(car)] == lane
            if lane:
                onward = {"a-b_1": 0.0, "a-b_0": -4.0, "j-k_0": -14.5}[lane]
                assert traffic.route(car, 50.0)[-1] == pytest.approx((xy[0] + 50.0, onward), abs=5.0)
        traffic.command(car, 10.0)
        assert traffic.step().lane[traffic.actors.row(car)] == ""
        traffic.place(car, np.array((64.0, -4.0)), 0.0, 10.0)
        traffic.step()
        traffic.command(car, None)
        assert traffic.step().lane[traffic.actors.row(car)] == "a-b_0"


def test_where_overtakers_drive_is_a_lane() -> None:
    with HighwayTraffic(soon("two_way"), 1) as traffic:
        car = int(traffic.actors.boxes.object_id[traffic.actors.lane.index("a-b_0")])
        traffic.place(car, np.array((300.0, 0.0)), 0.0, 20.0)
        assert traffic.step().lane[traffic.actors.row(car)] == "a-b_1"
        assert traffic.route(car, 50.0)[-1] == pytest.approx((350.0, -4.0), abs=5.0)


@pytest.mark.parametrize(
    ("name", "cars"),
    [
        ("merge", 1),
        *(pytest.param(name, 3, marks=pytest.mark.slow) for name in PLACES),
    ],
)
@pytest.mark.slow
def test_a_vehicle_that_is_placed_along_its_way_keeps_its_lanes_and_its_way(name: str, cars: int) -> None:
    with HighwayTraffic(soon(name), 3) as traffic:
        ways = [traffic.actors] + [traffic.step() for _ in range(STEPS)]
    stayed = set.intersection(*(set(actors.boxes.object_id.tolist()) for actors in ways))
    for car in sorted(stayed)[:cars]:
        poses = [(a.boxes.center[a.row(car), :2], float(a.boxes.yaw[a.row(car)])) for a in ways]
        with HighwayTraffic(soon(name), 3) as traffic:
            for step, pose in enumerate(poses[1:], start=1):
                assert np.hypot(*(traffic.route(car, 30.0) - pose[0]).T).min() < 2.0
                traffic.place(car, *pose, 10.0)
                lane = traffic.step().lane[traffic.actors.row(car)]
                # Where lanes meet or a lane change begins the two differ for a moment.
                near = ways[max(step - 10, 0) : step + 11]
                assert lane in {actors.lane[actors.row(car)] for actors in near}


def test_who_merges_makes_room_for_a_placed_vehicle_where_it_is_and_not_where_it_was() -> None:
    """All but the merging car are placed in a field, and one of them beside it."""
    braked = []
    for beside in (False, True):
        with HighwayTraffic(soon("merge"), 1) as traffic:
            actors = traffic.step()
            row = actors.lane.index("b-c_0")
            merging, x = int(actors.boxes.object_id[row]), actors.boxes.center[row, 0]
            speed, others = traffic.speed(merging), [i for i in actors.boxes.object_id.tolist() if i != merging]
            for number, other in enumerate(others):
                traffic.place(other, np.array((x, 100.0 + 10.0 * number)), 0.0, 0.0)
            for step in range(8):
                if beside:
                    traffic.place(others[0], np.array((x + 2.0 * step, -4.0)), 0.0, 20.0)
                traffic.step()
            braked.append(speed - traffic.speed(merging))
    assert braked[0] < 0.2 and braked[1] > 1.0


def test_a_closed_simulation_takes_no_step() -> None:
    traffic = HighwayTraffic(soon("racetrack"), 1)
    traffic.close()
    with pytest.raises(TrafficError, match="closed"):
        traffic.step()


def test_what_cannot_be_is_told_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "scenario.toml"
    text = 'name = "x"\ndescription = ""\n[network]\nhighway_env = "merge-v9"\n[agents]\n'
    path.write_text(text)
    with pytest.raises(ScenarioError, match=r"network.highway_env: .*merge-v9.*did you mean 'merge-v0'"):
        load_scenario(path)
    walking = msgspec.structs.replace(scenario_of("merge").demand, persons_per_hour=10.0)
    with pytest.raises(ScenarioError, match="persons_per_hour"):
        HighwayTraffic(msgspec.structs.replace(scenario_of("merge"), demand=walking), 1)


def test_the_backend_is_chosen_by_the_network() -> None:
    with open_traffic(soon("racetrack"), 1) as traffic:
        assert isinstance(traffic, HighwayTraffic)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_lanes_lead_on_to_lanes(environment: str) -> None:
    roads = read_roads(environment)
    for lane in roads.lanes:
        assert np.hypot(*np.diff(lane.line, axis=0).T).max() < 1.2
        for after in lane.after:
            assert np.hypot(*(roads.lanes[after].line[0] - lane.line[-1])) < 7.0
    # Who comes can leave, but not everywhere where he came from.
    assert len(roads.entries) <= len(roads.exits) + (environment == "merge-v0")
    for number in roads.entries:
        ways = [way for goal in roads.exits if (way := roads.route(number, goal)) is not None]
        assert ways and all(b in roads.lanes[a].after for way in ways for a, b in pairwise([number, *way]))
