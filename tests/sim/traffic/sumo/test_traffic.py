"""SUMO traffic: reproducible, smooth, one at a time, and where the boxes say it is."""

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

from sim.boxes import CLASSES
from sim.catalog.load import load_scenario
from sim.collisions import overlapping_pairs
from sim.errors import ScenarioError, TrafficError
from sim.geometry import wrap_angle
from sim.roads.networks import read_network, resolve_network
from sim.scenario import Scenario, SignalProgram
from sim.traffic.base import Actors, lit
from sim.traffic.log import TrafficLog
from sim.traffic.replay import ReplayTraffic
from sim.traffic.sumo.lane_path import LanePaths
from sim.traffic.sumo.traffic import SumoTraffic


def record(seed: int, path: Path) -> None:
    with SumoTraffic(msgspec.structs.replace(load_scenario("four_way"), warmup_s=25.0), seed) as traffic:
        log = TrafficLog(traffic.step_s)
        log.append(traffic.actors)
        for _ in range(100):
            log.append(traffic.step())
    log.save(path)


RECORD = f"""
import sys, msgspec
from pathlib import Path
from sim.catalog.load import load_scenario
from sim.traffic.log import TrafficLog
from sim.traffic.sumo.traffic import SumoTraffic
{inspect.getsource(record)}
record(1, Path(sys.argv[1]))
"""


def quick(name: str, warmup_s: float) -> Scenario:
    return msgspec.structs.replace(load_scenario(name), warmup_s=warmup_s)


@pytest.fixture(scope="module")
def run() -> list[Actors]:
    """40 s of the made grid, with every kind of road user."""
    with SumoTraffic(quick("four_way", 25.0), 5) as traffic:
        return [traffic.actors] + [traffic.step() for _ in range(400)]


@pytest.fixture
def traffic() -> Iterator[SumoTraffic]:
    with SumoTraffic(quick("four_way", 30.0), 2) as running:
        yield running


def test_one_seed_gives_the_same_log_in_two_processes_and_another_gives_another(tmp_path: Path) -> None:
    files = [tmp_path / f"{k}.npz" for k in range(3)]
    subprocess.run([sys.executable, "-c", RECORD, str(files[0])], check=True, timeout=100)
    for path, seed in zip(files[1:], (1, 2), strict=True):
        record(seed, path)
    assert files[0].read_bytes() == files[1].read_bytes()
    replays = [ReplayTraffic(path) for path in (files[0], files[2])]
    assert len(replays[0]) == 101
    assert not np.array_equal(replays[0].actors.boxes.array, replays[1].actors.boxes.array)


def test_every_kind_of_road_user_is_there_with_the_size_of_its_class(run: list[Actors]) -> None:
    labels = {CLASSES[k] for actors in run for k in actors.boxes.label.tolist()}
    assert {"car", "van", "truck", "bicycle", "pedestrian"} <= labels
    cars = {tuple(s) for a in run for s in a.boxes.size[a.boxes.label == 0].tolist()}
    assert len(cars) >= 5 and all(3.6 <= length <= 5.1 for length, _, _ in cars)


def test_ids_count_from_1000_in_order_and_rows_are_sorted(run: list[Actors]) -> None:
    seen: set[int] = set()
    for actors in run:
        ids = actors.boxes.object_id.tolist()
        assert ids == sorted(ids) and (not ids or ids[0] >= 1000)
        new = sorted(set(ids) - seen)
        assert all(i > max(seen, default=999) for i in new)
        seen |= set(ids)


def test_a_vehicle_that_departs_again_shares_its_id_with_nobody(traffic: SumoTraffic) -> None:
    import libsumo

    actors = traffic.actors
    name = actors.name[actors.row(fastest_car(actors))]
    kind = libsumo.vehicle.getTypeID(name)
    libsumo.route.add("route", libsumo.vehicle.getRoute(name))
    libsumo.vehicle.remove(name)
    assert name not in traffic.step().name
    for again in (name, "another"):
        libsumo.vehicle.add(again, "route", kind)
        while again not in (now := traffic.step()).name:
            assert now.time_s < 120.0
        assert np.hypot(*now.velocity[now.name.index(again)]) < 25.0
    assert len(set(now.boxes.object_id.tolist())) == len(now)


def test_boxes_stand_on_the_road_and_time_advances_by_the_step(run: list[Actors]) -> None:
    assert run[0].time_s == 25.0
    assert np.allclose(np.diff([a.time_s for a in run]), 0.1)
    for actors in run[::50]:
        assert np.allclose(actors.world_from_body()[:, 2, 3], 0.0, atol=1e-9)


def sideways(run: list[Actors]) -> tuple[np.ndarray, np.ndarray]:
    """Return the sideways motion (m) and the turn (rad) of every vehicle in every step."""
    lateral, turn = [], []
    for before, after in pairwise(run):
        _, i, j = np.intersect1d(before.boxes.object_id, after.boxes.object_id, return_indices=True)
        driving = before.boxes.label[i] != CLASSES.index("pedestrian")
        i, j = i[driving], j[driving]
        move = after.boxes.center[j, :2] - before.boxes.center[i, :2]
        turned = wrap_angle(after.boxes.yaw[j] - before.boxes.yaw[i])
        yaw = before.boxes.yaw[i] + 0.5 * turned
        lateral.append(np.abs(np.cos(yaw) * move[:, 1] - np.sin(yaw) * move[:, 0]))
        turn.append(np.abs(turned))
    return np.concatenate(lateral), np.concatenate(turn)


def test_nobody_jumps_sideways_or_spins_on_the_made_grid(run: list[Actors]) -> None:
    lateral, turn = sideways(run)
    assert lateral.max() < 0.25
    assert np.degrees(turn.max()) / 0.1 < 130.0


def test_velocity_is_the_motion_of_the_centre(run: list[Actors]) -> None:
    for before, after in pairwise(run[:51]):
        _, i, j = np.intersect1d(before.boxes.object_id, after.boxes.object_id, return_indices=True)
        moved = (after.boxes.center[j, :2] - before.boxes.center[i, :2]) / 0.1
        assert np.allclose(after.velocity[j], moved, atol=1e-9)
        assert np.hypot(*after.velocity.T).max() < 25.0


def test_acceleration_is_the_change_of_the_velocity(run: list[Actors]) -> None:
    compared = 0
    for before, after in pairwise(run):
        for row, object_id in enumerate(after.boxes.object_id.tolist()):
            if object_id in before.boxes.object_id:
                change = after.velocity[row] - before.velocity[before.row(object_id)]
                assert after.acceleration[row] == pytest.approx(change / 0.1, abs=1e-9)
                compared += bool(np.abs(change).max() > 0.05)
            else:
                assert not after.acceleration[row].any()
    assert compared > 1000


def test_who_brakes_hard_shows_the_brake_light(run: list[Actors]) -> None:
    hard, lit_rows = 0, 0
    for actors in run[1:]:
        forward = np.stack([np.cos(actors.boxes.yaw), np.sin(actors.boxes.yaw)], axis=1)
        braking = actors.boxes.is_vehicle & ((actors.acceleration * forward).sum(axis=1) < -2.0)
        hard += int(braking.sum())
        lit_rows += sum("brake light" in lit(int(signals)) for signals in actors.signals[braking])
    # SUMO takes the light's decision within its step, so at the edges of a braking it is a step early or late.
    assert hard > 50 and lit_rows > 0.95 * hard


def test_lanes_are_lanes_of_the_network_and_the_vehicle_is_on_its_lane(run: list[Actors]) -> None:
    net = read_network(resolve_network(quick("four_way", 25.0), 5))
    for actors in run[::25]:
        for row, lane in enumerate(actors.lane):
            if lane:
                shape = shapely.LineString(net.getLane(lane).getShape())
                front = actors.boxes.center[row, :2] + 0.5 * actors.boxes.size[row, 0] * np.array(
                    [np.cos(actors.boxes.yaw[row]), np.sin(actors.boxes.yaw[row])]
                )
                where = front if actors.boxes.is_vehicle[row] else actors.boxes.center[row, :2]
                assert shape.distance(shapely.Point(where)) < 2.5, (actors.name[row], lane)
        assert all(lane for row, lane in enumerate(actors.lane) if actors.boxes.is_vehicle[row])


def test_boxes_of_vehicles_hardly_ever_overlap(run: list[Actors]) -> None:
    """SUMO's junctions are not free of contacts, but deep overlaps would spoil the ground truth."""
    vehicles = [actors.boxes[actors.boxes.is_vehicle] for actors in run[::5]]
    assert np.mean([len(overlapping_pairs(boxes, margin=-0.15)) > 0 for boxes in vehicles]) < 0.1


def test_a_second_simulation_in_the_process_is_an_error_until_the_first_ends(traffic: SumoTraffic) -> None:
    with pytest.raises(TrafficError, match="already runs in this process"):
        SumoTraffic(quick("four_way", 1.0), 1)
    traffic.step()  # the first one is unharmed
    traffic.close()
    with SumoTraffic(quick("four_way", 1.0), 1) as second:
        second.step()
    with pytest.raises(TrafficError, match="closed"):
        traffic.step()
    with pytest.raises(TrafficError, match="closed"):
        _ = traffic.actors


@pytest.mark.parametrize(
    ("junctions", "state", "message"),
    [
        (["A2"], "G" * 32, r"signals\[0\]\.junction: expected a traffic light .*, found A2; did you mean 'A[01]'\?"),
        (["A0", "A0"], "G" * 32, r"signals\[1\]\.junction: expected one program each, found A0"),
        (["A0", "A1"], "G" * 31, r"signals\[0\]\.phases: expected states of 32 letters, .*, found 31 letters"),
        (["A0"], "G" * 33, r"signals\[0\]\.phases: .*, found 33 letters"),
    ],
)
def test_signals_that_the_network_does_not_have_are_told(junctions: list[str], state: str, message: str) -> None:
    scenario = quick("four_way", 0.0)
    signals = tuple(SignalProgram(junction=name, phases=((9.0, state),)) for name in junctions)
    broken = msgspec.structs.replace(scenario, network=msgspec.structs.replace(scenario.network, signals=signals))
    with pytest.raises(ScenarioError, match=f"four_way: network.{message}"):
        SumoTraffic(broken, 1)


def test_a_simulation_that_cannot_start_is_told_and_leaves_the_process_free(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = quick("four_way", 0.0)
    with monkeypatch.context() as patch:
        patch.setattr("sim.traffic.sumo.traffic.sumo_options", lambda scenario, seed: ["--no-such-option"])
        with pytest.raises(TrafficError, match="four_way: SUMO does not start") as caught:
            SumoTraffic(scenario, 1)
    assert "\n" not in str(caught.value)
    with SumoTraffic(scenario, 1) as traffic:
        assert len(traffic.actors) == 0
        traffic.step()


def fastest_car(actors: Actors) -> int:
    speed = np.hypot(*actors.velocity.T) * (actors.boxes.label == 0)
    return int(actors.boxes.object_id[np.argmax(speed)])


def speeds(traffic: SumoTraffic, object_id: int, steps: int) -> np.ndarray:
    found = []
    for _ in range(steps):
        actors = traffic.step()
        if object_id not in actors.boxes.object_id:
            break
        found.append(np.hypot(*actors.velocity[actors.row(object_id)]))
    return np.array(found)


def test_a_commanded_vehicle_stops_and_starts_within_its_limits(traffic: SumoTraffic) -> None:
    car = fastest_car(traffic.actors)
    full_brake = traffic.limits(car).deceleration_mps2
    traffic.command(car, 0.0)
    braking = speeds(traffic, car, 60)
    assert braking[0] > 5.0 and braking[-1] < 0.01
    assert (np.diff(braking) / 0.1).min() == pytest.approx(-full_brake, abs=0.5) and full_brake >= 7.5
    traffic.command(car, None)
    assert speeds(traffic, car, 300).max() > 3.0
    with pytest.raises(ValueError, match="finite"):
        traffic.command(car, float("nan"))


def test_a_commanded_vehicle_stops_at_the_line_of_a_red_light_within_its_limits(traffic: SumoTraffic) -> None:
    import libsumo

    target = None
    while target is None:
        actors = traffic.step()
        for row in np.flatnonzero(actors.boxes.label == 0):
            light = libsumo.vehicle.getNextTLS(actors.name[row])
            fast = np.hypot(*actors.velocity[row]) > 8.0
            if fast and light and light[0][3] == "r" and 35.0 < light[0][2] < 60.0:
                target = int(actors.boxes.object_id[row]), actors.name[row]
                state = libsumo.trafficlight.getRedYellowGreenState(light[0][0])
                libsumo.trafficlight.setRedYellowGreenState(light[0][0], "r" * len(state))  # and red it stays
                break
    lights = traffic.signals(target[0])
    assert lights[0].state == "red" and 35.0 < lights[0].distance_m < 60.0 and traffic.claims() == {}
    traffic.command(target[0], 12.0)
    found = speeds(traffic, target[0], 90)
    assert (np.diff(found) / 0.1).min() > -5.0
    assert found[-1] < 0.1 and libsumo.vehicle.getNextTLS(target[1])[0][2] < 1.0


@pytest.mark.parametrize("aside_m", [0.0, 30.0, 240.0])
def test_a_placed_vehicle_drives_on_along_its_lane_when_it_is_commanded(traffic: SumoTraffic, aside_m: float) -> None:
    car, actors = fastest_car(traffic.actors), traffic.actors
    yaw = float(actors.boxes.yaw[actors.row(car)])
    place = actors.boxes.center[actors.row(car), :2] + aside_m * np.array([-np.sin(yaw), np.cos(yaw)])
    traffic.place(car, place, yaw, 5.0)
    assert (traffic.step().lane[traffic.actors.row(car)] == "") == (aside_m > 0.0)
    traffic.command(car, 5.0)
    driven = [traffic.step() for _ in range(20)][5:]
    assert all(now.lane[now.row(car)] for now in driven)
    moved = np.diff([now.boxes.center[now.row(car), :2] for now in driven], axis=0)
    # After a jump back to its lane its body has to turn behind its front.
    assert (np.hypot(*moved.T) > 0.25).all() and traffic.speed(car) == pytest.approx(5.0)


@pytest.mark.parametrize("speed_mps", [5.0, None])
def test_a_vehicle_that_was_placed_changes_lanes_as_before(traffic: SumoTraffic, speed_mps: float | None) -> None:
    import libsumo

    car, actors = fastest_car(traffic.actors), traffic.actors
    name = actors.name[actors.row(car)]
    before = libsumo.vehicle.getLaneChangeMode(name)
    for _ in range(2):
        traffic.place(car, actors.boxes.center[actors.row(car), :2], float(actors.boxes.yaw[actors.row(car)]), 5.0)
        traffic.step()
    assert libsumo.vehicle.getLaneChangeMode(name) == 0
    traffic.command(car, speed_mps)
    assert libsumo.vehicle.getLaneChangeMode(name) == before > 0


def test_lanes_read_once_give_the_routes_of_lanes_read_anew(traffic: SumoTraffic) -> None:
    import libsumo

    far = 0
    for _ in range(20):
        actors = traffic.step()
        for i in actors.boxes.object_id[actors.boxes.is_vehicle].tolist():
            row = actors.row(i)
            kept, anew = (
                traffic.route(i, 300.0),
                LanePaths(libsumo).path(actors.name[row], actors.boxes.center[row, :2], 300.0),
            )
            assert np.array_equal(kept, anew)
            far += np.linalg.norm(np.diff(kept, axis=0), axis=1).sum() > 100.0
    assert far > 20


def test_the_route_ahead_starts_at_the_vehicle_and_is_where_it_drives(traffic: SumoTraffic) -> None:
    actors = traffic.actors
    driving = actors.boxes.object_id[actors.boxes.is_vehicle].tolist()
    paths = {i: traffic.route(i, 40.0) for i in driving}
    for i, path in paths.items():
        assert np.allclose(path[0], actors.boxes.center[actors.row(i), :2])
        assert len(path) >= 2
        assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() <= 40.0 + 1e-6
    off = []
    for _ in range(30):
        actors = traffic.step()
        for i in set(driving) & set(actors.boxes.object_id.tolist()):
            steps = np.linspace(0, 1, 50)[:, None, None]
            dense = (paths[i][:-1] + steps * np.diff(paths[i], axis=0)).reshape(-1, 2)
            off.append(np.linalg.norm(dense - actors.boxes.center[actors.row(i), :2], axis=1).min())
    assert np.median(off) < 0.3 and np.quantile(off, 0.9) < 1.0


def test_pedestrians_take_no_commands(traffic: SumoTraffic) -> None:
    boxes = traffic.actors.boxes
    person = int(boxes.object_id[boxes.label == CLASSES.index("pedestrian")][0])
    with pytest.raises(TrafficError, match="pedestrian"):
        traffic.command(person, 1.0)
    with pytest.raises(KeyError):
        traffic.command(999_999, 1.0)


@pytest.mark.parametrize(
    "name",
    [
        "highway",
        *(pytest.param(one, marks=pytest.mark.slow) for one in ("braunschweig", "ingolstadt", "koenigs_wusterhausen")),
    ],
)
def test_shipped_scenario_runs(name: str) -> None:
    with SumoTraffic(quick(name, 20.0), 1) as traffic:
        for _ in range(50):
            actors = traffic.step()
    assert len(actors) > 5
    assert np.isfinite(actors.boxes.array).all()


@pytest.fixture(scope="module")
def braunschweig() -> list[Actors]:
    with SumoTraffic(quick("braunschweig", 100.0), 7) as traffic:
        return [traffic.actors] + [traffic.step() for _ in range(300)]


def test_braunschweig_has_a_crowd_of_vehicles_at_the_junction(braunschweig: list[Actors]) -> None:
    """Three cooperating cars and the roadside unit need company at any time of the drive."""
    counts = []
    for actors in braunschweig[::20]:
        away = np.hypot(*(actors.boxes.center[:, :2] - [671.0, 639.0]).T)
        counts.append(int((actors.boxes.is_vehicle & (away < 60.0)).sum()))
    assert min(counts) >= 8


def test_on_a_real_network_only_long_vehicles_at_kinks_move_sideways(braunschweig: list[Actors]) -> None:
    """Real lanes have kinks, where SUMO turns a bus about its bumper; a lane change would jump by 3.2 m."""
    lateral, _ = sideways(braunschweig)
    assert np.quantile(lateral, 0.998) < 0.25
    assert lateral.max() < 0.8
