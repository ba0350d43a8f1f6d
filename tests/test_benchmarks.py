"""The benchmarks start, and measure the streets that they say they measure."""

import time
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro

from benchmarks.closed_loop import Run
from benchmarks.corruptions import GOALS, POINTS, REFERENCES, STATED, goal_of, make_frame, peak_mb, variants_of
from benchmarks.frames import rays_of
from benchmarks.generate import STAGES, Clock, Cost, Point, busy_scenario, points
from benchmarks.lidar import figures_of, stage_ms
from benchmarks.quiet import Timing, measure
from benchmarks.street import BENCHMARK_LIDAR, FLEETS, baked, city, fleet, street_world
from sensors.corruptions import CORRUPTIONS
from sim.collisions import overlapping_pairs
from sim.mesh.materials import MATERIALS
from tests.dsrc.data.toy import toy_frame


@pytest.mark.parametrize(
    "name",
    ["lidar", "corruptions", "generate", "inference", "evaluation", "reading", "training", "closed_loop", "review"],
)
def test_benchmark_explains_itself(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        tyro.cli(import_module(f"benchmarks.{name}").main, args=["--help"])
    assert stop.value.code == 0
    assert "--quick" in capsys.readouterr().out


def test_sixty_vehicles_of_which_five_scan_keep_the_makers_of_drives_busy() -> None:
    scenario = busy_scenario()
    assert (scenario.agents.vehicles, scenario.demand.max_vehicles) == (5, 60)
    clock = Clock()
    with clock.watching():
        opv2v = import_module("dsrc.data.formats.opv2v.reader")
        list(opv2v.encode_pcd(toy_frame(0).agents[0].sweep))
    assert clock.seconds["encode"] > 0.0 and set(clock.seconds) == {"encode"}
    assert set(STAGES) | {"traffic", "write"} == {"traffic", "tracing", "visibility", "encode", "write"}


def test_a_slow_variant_sits_out_rounds_and_the_others_take_part_in_all() -> None:
    calls = {"slow": 0, "fast": 0}

    def run(name: str, seconds: float) -> None:
        calls[name] += 1
        time.sleep(seconds)

    variants = {"slow": lambda: run("slow", 0.3), "fast": lambda: run("fast", 0.001)}
    found = measure(variants, rounds=6, keep=5, sample_s=0.001, most_s=0.1)
    assert found["slow"].samples == 2 and calls["slow"] == 2 + 2
    assert found["fast"].samples == 5 and calls["fast"] >= 2 + 6


def test_the_start_of_an_episode_is_not_counted_as_a_step() -> None:
    run = Run("", step=lambda: None, begin=lambda: time.sleep(0.05))
    run.take(3, until=float("inf"))
    assert run.steps == 3 and run.wall_s < 0.05


def test_one_run_varies_agents_vehicles_and_clouds_around_the_same_drive() -> None:
    for quick in (True, False):
        varied = points(quick)
        assert varied[0] == Point(5, 60, "pcd") and Point(5, 60, "compact") in varied
        assert all((p.agents != 5) + (p.vehicles != 60) + (p.clouds != "pcd") <= 1 for p in varied)
        assert len(varied) == len(set(varied))
    assert Cost({"tracing": 30.0, "write": 6.0}, 17.5).shown() == ("36.0", "10.0", "17.5")


def test_streets_have_the_stated_triangles() -> None:
    world = street_world()
    assert 275_000 <= len(world.faces) <= 285_000
    material = world.face_attributes["material"]
    found = {MATERIALS[index].name for index in np.unique(material)}
    assert {"asphalt", "marking", "pavement", "kerb", "ground", "leaves", "bark", "glass", "metal"} <= found
    assert np.abs(world.bounds[:, :2]).max() < 202.0
    assert (world.area_faces > 0.0).all()


@pytest.mark.parametrize(("vehicles", "triangles"), [(60, 260_000), (200, 1_110_000)])
def test_fleets_have_the_stated_triangles(vehicles: int, triangles: int) -> None:
    cars = fleet(vehicles)
    assert vehicles in FLEETS
    assert len(cars.start) == vehicles
    assert len(cars.agents) == 5
    assert sum(len(mesh.faces) for mesh in cars.meshes()) == pytest.approx(triangles, rel=0.02)
    for time_s in (-0.1, 0.0, 0.1):
        assert len(overlapping_pairs(cars.actors(time_s).boxes)) == 0
    for mesh, size in zip(cars.meshes(), cars.start.boxes.size, strict=True):
        assert mesh.extents == pytest.approx(size, abs=1e-3)
        assert len(mesh.face_attributes["material"]) == len(mesh.faces)


def test_vehicles_drive_where_they_look_and_at_their_speed() -> None:
    cars = fleet(60)
    before, now, after = (cars.actors(time_s) for time_s in (-0.05, 0.0, 0.05))
    driven = (after.boxes.center - before.boxes.center)[:, :2] / 0.1
    assert driven == pytest.approx(now.velocity, abs=0.01)
    heading = np.stack([np.cos(now.boxes.yaw), np.sin(now.boxes.yaw)], axis=1)
    speed = np.linalg.norm(now.velocity, axis=1)
    assert (heading * now.velocity).sum(axis=1) == pytest.approx(speed)
    assert speed.min() > 1.0


def test_sensors_ride_above_their_cars() -> None:
    cars = fleet(60)
    sensors = cars.sensors(0.0, np.random.default_rng(0))
    poses = cars.actors(0.0).world_from_body()
    for sensor, row in zip(sensors, cars.agents, strict=True):
        assert sensor.rides_on == cars.start.boxes.object_id[row]
        offset = sensor.path.at(np.array([0.0]))[0, :3, 3] - poses[row, :3, 3]
        assert offset == pytest.approx(BENCHMARK_LIDAR.mount_xyz_m, abs=1e-6)


def test_baked_scene_leaves_one_vehicle_out() -> None:
    world, cars = street_world(), fleet(60)
    _, faces = baked(world, cars, 0.0)
    vertices, without = baked(world, cars, 0.0, left_out=7)
    assert len(faces) - len(without) == len(cars.meshes()[7].faces)
    assert without.max() == len(vertices) - 1


def test_city_is_districts_side_by_side() -> None:
    one, two = street_world(), city(300_000)
    assert 1.9 * len(one.faces) < len(two.faces) < 2.1 * len(one.faces)
    assert two.extents[0] == pytest.approx(one.extents[0] + 400.0, abs=2.0)


def test_variants_take_turns_and_each_gets_its_samples() -> None:
    called = []
    timings = measure({name: lambda name=name: called.append(name) for name in "ab"}, rounds=4, keep=3, sample_s=1e-9)
    assert {name: timing.samples for name, timing in timings.items()} == {"a": 3, "b": 3}
    assert all(timing.wall_s >= 0.0 for timing in timings.values())
    # Two calls each to find the number of calls, then a sample is a call to warm up and one that counts.
    assert "".join(called) == "aabb" + 2 * ("aabb" + "bbaa")


def test_rays_leave_the_sensor_where_it_is_when_they_fire() -> None:
    cars = fleet(60)
    sensor = cars.sensors(0.0, np.random.default_rng(0))[0]
    rays = rays_of(sensor)
    assert len(rays.origins) == 64 * 1800
    assert np.linalg.norm(rays.directions, axis=1) == pytest.approx(1.0, abs=1e-6)
    speed = np.linalg.norm(cars.start.velocity[cars.agents[0]])
    driven = np.linalg.norm(rays.origins[1799] - rays.origins[0])
    assert driven == pytest.approx(speed * 0.1, rel=0.01)


def test_figures_say_null_for_what_was_not_measured() -> None:
    times = {"bare": 0.1, "public_1t": 0.13, "trimesh": 1.0}
    figures = figures_of({name: Timing(wall, wall, 0.0, 5, 1) for name, wall in times.items()}, 5)
    assert figures["ratio_public_1t"] == pytest.approx(1.3)
    assert figures["bare_sweep_ms"] == pytest.approx(20.0)
    assert figures["ratio_fused_1t"] is figures["realtime_factor"] is figures["speedup_open3d"] is None


def test_stages_add_up_to_the_sweep() -> None:
    parts = ("update_60", "python", "kernel", "kernel_lost", "kernel_static", "kernel_void", "fused_1t")
    times = dict(zip(parts, (0.001, 0.002, 0.050, 0.040, 0.030, 0.005, 0.060), strict=True))
    stages = stage_ms({name: Timing(wall, wall, 0.0, 5, 1) for name, wall in times.items()}, 5)
    assert sum(stages.values()) == pytest.approx(12.0)
    assert stages["report"] == pytest.approx(2.0)
    assert stages["static"] == pytest.approx(3.0)


def test_every_corruption_is_timed_on_a_sweep_of_the_stated_size() -> None:
    frame = make_frame()
    assert len(frame.agents[0].sweep) == POINTS
    variants = variants_of(frame, 3)
    assert set(CORRUPTIONS) | set(REFERENCES) <= set(variants)
    assert (set(GOALS) - {"peak_mb"}) | set(STATED) <= set(variants)
    assert (goal_of("fog"), goal_of("wet_ground"), goal_of("paper_fog"), goal_of("spray")) == (0.05, 0.035, None, None)
    assert 5.0 < peak_mb(variants["rain"]) < 300.0


def test_every_stage_of_every_method_is_timed_and_counted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    from benchmarks import inference
    from dsrc.models.fusion import FUSIONS
    from dsrc.training.recipes import debug

    monkeypatch.setattr(inference, "POINTS", 500)
    bench = inference.Bench(debug().model, "cpu", "fused", True, float("inf"))
    for agents in inference.AGENTS:
        for method in FUSIONS:
            bench.add(method, agents)
    found = inference.figures(bench, rate=10.0)
    for method in FUSIONS:
        assert set(found["latency_ms"][method]) == set(found["floor_ms"][method]) == {"1", "2", "5"}
        assert all(value > 0 for value in found["latency_ms"][method].values())
        assert sum(found["share_of_2_agents"][method].values()) == pytest.approx(1.0, abs=0.01)
    # Late fusion runs everything for every cloud, early fusion once for all.
    floor = found["floor_ms"]
    assert floor["late"]["5"] == pytest.approx(5 * floor["none"]["1"], rel=0.1)
    assert floor["early"]["5"] == pytest.approx(floor["none"]["1"], rel=0.1)
    for method in set(FUSIONS) - {"none", "early"}:
        assert floor[method]["1"] < floor[method]["2"] < floor[method]["5"]


def test_the_parts_of_a_training_step_add_up_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    from benchmarks import reading, training
    from dsrc.training.recipes import debug

    monkeypatch.setattr(reading, "POINTS", 2000)
    steps = training.make_steps(debug(), "cpu")
    before = steps["dsrc"].module.detector.reg_head.weight.detach().clone()
    for step in steps.values():
        step()
    assert not torch.equal(steps["dsrc"].module.detector.reg_head.weight, before)
    timings = {name: Timing(0.2 if "dsrc" in name else 0.1, 0.1, 0.0, 1, 1) for name in steps}
    found = training.figures_of(steps, timings)
    assert (found["step_ms_plain"], found["step_ms_dsrc"], found["dsrc_over_plain"]) == (100.0, 100.0, 1.0)
    for name, share in found["share"].items():
        assert sum(share.values()) == pytest.approx(1.0, abs=0.01)
        assert (share["teacher"] > 0) == (share["reconstruction"] > 0) == ("dsrc" in name)
        assert min(share.values()) >= 0.0


def test_the_loop_over_polygons_finds_the_same_precisions() -> None:
    from benchmarks.evaluation import make_frames, shapely_metrics
    from dsrc.evaluation.metrics.ap import evaluate

    frames = make_frames(12)
    result = evaluate(frames)
    assert all(20 <= len(frame.detections) <= 60 for frame in frames)
    assert 0.5 < result.curves["bev", 0.5].ap < 0.95
    assert shapely_metrics(frames) == pytest.approx(result.metrics(), abs=1e-9)


def test_the_plain_script_reads_what_our_reader_reads(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from benchmarks import reading

    monkeypatch.setattr(reading, "POINTS", 2000)
    ours, theirs = reading.write_trees(tmp_path, frames=reading.SAMPLES)
    reading.check_same(ours, theirs)
    variants = reading.variants_of(ours, theirs)
    notes, points = variants["plain_binary"]()[0]
    assert points.shape == (2000, 4) and "lidar_pose" in notes and "testbed" in notes
    assert variants["batch_dsrc"]().teacher is not None and variants["batch_plain"]().teacher is None
    assert len(variants["batch_plain"]().student.count) > 0
