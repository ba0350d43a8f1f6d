"""Readers of untrusted files, each with a real small file to start from."""

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dsrc.closed_loop.campaign.read import is_campaign, read_campaign
from dsrc.closed_loop.campaign.run import read_results
from dsrc.closed_loop.log import EpisodeLog
from dsrc.data.checksums import read_checksums
from dsrc.data.datasets.manifest import read_manifest
from dsrc.data.datasets.spec import expand, find_split_file, log_settings, read_dataset
from dsrc.data.drives import open_drive
from dsrc.data.formats.opv2v.compact import encode_compact, read_compact
from dsrc.data.formats.pcd import encode_pcd, read_pcd
from dsrc.data.write import write_drive
from dsrc.evaluation.config import check as check_plan
from dsrc.evaluation.config import read_benchmark
from dsrc.training.recipes import RECIPES, override
from sensors.corruptions.published.snow import read_calibration
from sim.catalog.import_map import import_map
from sim.catalog.load import load_scenario
from sim.mesh.meshfiles import read_3ds, read_obj
from sim.mesh.solids import to_mesh
from sim.radio.trace import read_trace
from sim.roads.networks import read_network
from sim.roads.osm import pbf_to_xml
from sim.roads.polygons import has_buildings, read_outlines
from sim.roads.tools import run_tool
from sim.traffic.log import TrafficLog
from sim.traffic.sumo.trips import read_trips
from sim.world.furniture.map_objects import read_map_objects
from sim.world.world_file import load_world
from tests.dsrc.closed_loop.logged import Mover, ahead, episode
from tests.dsrc.data import dair_tree
from tests.dsrc.data.toy import SETTINGS, ToySource, toy_frame
from tests.fuzz.foreign import foreign_targets
from tests.fuzz.learned import learned_targets
from tests.fuzz.sweeps import sweep_targets
from tests.fuzz.target import Target
from tests.paths import ROOT
from tests.sim.catalog.test_import_map import packed_file, town
from tests.sim.mesh.test_meshfiles import small_3ds
from tests.sim.traffic.test_log import example

RECORDED = ROOT / "scenarios" / "dsrc-sim" / "recorded" / "validation" / "ped_bus_stop_203"

POLYGONS = """<additional>
  <poly id="1" type="building.house" color="gray" layer="0" shape="0,0 10,0 10,8 0,8">
    <param key="height" value="9 m"/></poly>
  <poly id="2" type="barrier.hedge" color="gray" layer="0" shape="0,20 30,20"><param key="height" value="1.5"/></poly>
  <poi id="3" type="natural.tree" color="gray" x="3.5" y="14.25"/>
</additional>
"""
TRIPS = """<routes>
  <vehicle id="a" depart="3.50"><route edges="e1 e2 e3"/></vehicle>
  <trip id="b" depart="7.25" from="e1" to="e3"/>
  <vType id="lorry" vClass="truck"/><route id="r" edges="e1 e2"/>
  <flow id="c" type="lorry" route="r" begin="0" end="60" vehsPerHour="600"/>
  <person id="d" depart="4.00"><walk from="e1" to="e2"/></person>
</routes>
"""
TRACE = "time_s,delay_s,loss,sender,receiver\n0.0,0.1,0.02,1000,*\n1.5,0.25,0.5,,\n"
BENCHMARK = """[[methods]]
name = "DSRC"
detectors = ["a.pt"]
[[datasets]]
name = "x"
drives = ["y"]
[sweeps]
agents = [1, 2]
delay_s = [0.1, 0.2]
pose_error = [0.2]
"""
DATASET = """name = "few"
[[split.train]]
scenarios = ["four_way"]
seeds = [1, 2]
frames = [5]
vehicles = [2, 3]
[[split.test]]
scenarios = ["ima_building"]
seeds = [7]
"""


def targets(folder: Path) -> list[Target]:
    """Write a small file for every reader; return the readers."""
    return [
        *_drives(folder),
        *_clouds(folder),
        *_archives(folder),
        *_settings(folder),
        *_maps(folder),
        *_meshes(folder),
        *learned_targets(folder),
        *foreign_targets(folder),
        *sweep_targets(folder),
    ]


def _drives(folder: Path) -> list[Target]:
    own, foreign, dair = folder / "own" / "toy_3", folder / "foreign" / "toy_3", folder / "dair"
    write_drive(own, {**SETTINGS, "frames": 1}, ToySource().open)
    write_drive(foreign, {**SETTINGS, "frames": 1}, ToySource().open)
    notes = sorted(foreign.glob("*/*.yaml"))
    for path in notes:
        path.write_text(path.read_text().partition("\n")[2])
    (foreign / "data_protocol.yaml").unlink()
    dair_tree.make(dair, tracks=True)

    def first(drive: Path) -> Callable[[Path], object]:
        return lambda _: open_drive(drive).read(0)

    def batch(_: Path) -> object:
        from dsrc.data.drives import open_drives

        return [drive.read(0) for drive in open_drives(dair)]

    tables = sorted(path for path in dair.rglob("*.json") if path.stat().st_size < 100_000)
    return [
        Target("OPV2V annotation, own", sorted(own.glob("*/*.yaml"))[0], first(own), "text"),
        Target("OPV2V protocol", own / "data_protocol.yaml", first(own), "text"),
        Target("OPV2V annotation, of others", notes[0], first(foreign), "text"),
        Target("checksums", own / "SHA256SUMS", lambda path: read_checksums(path.parent), "text"),
        *(Target(f"DAIR-V2X-C {path.relative_to(dair)}", path, batch, "text") for path in tables),
    ]


def _clouds(folder: Path) -> list[Target]:
    sweep = toy_frame(0, points=30).agents[0].sweep
    binary, text, compact = folder / "binary.pcd", folder / "text.pcd", folder / "points.compact"
    binary.write_bytes(b"".join(encode_pcd(sweep)))
    compact.write_bytes(encode_compact(sweep))
    head = (
        "VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 3\nHEIGHT 1\nPOINTS 3\n"
    )
    text.write_text(f"{head}DATA ascii\n1 2 3 0.5\n4.5 -1 0 1\n7 8 9 0\n")
    packed = folder / "packed.pcd"
    columns = np.arange(12, dtype="<f4").tobytes()
    # Literals of at most 32 bytes are valid LZF.
    literals = b"".join(bytes([len(part) - 1]) + part for part in (columns[k : k + 32] for k in range(0, 48, 32)))
    sizes = np.array([len(literals), len(columns)], "<u4").tobytes()
    packed.write_bytes(f"{head}DATA binary_compressed\n".encode() + sizes + literals)
    return [
        Target("PCD, binary", binary, read_pcd, "text"),
        Target("PCD, ASCII", text, read_pcd, "text"),
        Target("PCD, compressed", packed, read_pcd, "text"),
        Target("compact cloud", compact, read_compact, "text"),
    ]


def _archives(folder: Path) -> list[Target]:
    log, world, recorded = folder / "log.npz", folder / "world.npz", folder / "recorded" / "traffic.npz"
    example().save(log)
    world.write_bytes((RECORDED / "world.npz").read_bytes())
    recorded.parent.mkdir()
    recorded.write_bytes((RECORDED / "traffic.npz").read_bytes())
    driven = folder / "episode.npz"
    episode([Mover(1, ahead(8.0)), Mover(2, ahead(3.0, 30.0))], 5).save(driven)
    focus = folder / "focus.npz"
    np.savez(focus, focal_distance_m=np.full(64, 10.0), focal_slope=np.ones(64), min_intensity=np.zeros(64))

    return [
        Target("traffic log", log, TrafficLog.load, "arrays"),
        Target("recorded log", recorded, lambda path: (log_settings(path), TrafficLog.load(path)), "arrays"),
        Target("static world", world, to_mesh_of, "arrays"),
        Target("episode log", driven, EpisodeLog.load, "arrays"),
        Target("calibration", focus, _calibration, "arrays"),
    ]


def _calibration(path: Path) -> object:
    read_calibration.cache_clear()
    return read_calibration(str(path))


def to_mesh_of(path: Path) -> object:
    """Read a world and the meshes of its bodies."""
    world = load_world(path)
    return world.static.vertices.sum(), [to_mesh(part) for part in world.shapes.values()]


def _settings(folder: Path) -> list[Target]:
    scenario = folder / "scenario.toml"
    scenario.write_text((ROOT / "scenarios" / "four_way" / "scenario.toml").read_text())
    campaign = folder / "campaign.toml"
    shipped = (ROOT / "studies/closed_loop/campaign.toml").read_text()
    shipped = shipped.replace("../../dsrc", f"{ROOT}/dsrc")
    campaign.write_text(
        shipped.replace("../../runs/single_s0/student/detector.pt", f"{ROOT}/dsrc/checkpoints/small-plain.pt")
    )
    driven = folder / "results.csv"
    driven.write_bytes((ROOT / "studies/closed_loop/report/nothing-is-hidden/results.csv").read_bytes())
    files = {"benchmark.toml": BENCHMARK, "few.toml": DATASET, "trace.csv": TRACE, "set.txt": "batch_size=2"}
    benchmark, dataset, trace, words = (folder / name for name in files)
    for name, text in files.items():
        (folder / name).write_text(text)
    manifest = folder / "built" / "manifest.json"
    manifest.parent.mkdir()
    manifest.write_text('{"version": 1, "name": "a", "description": "b", "drives": 0, "items": [], "failed": {}}')

    return [
        Target("scenario", scenario, load_scenario, "text"),
        Target("campaign", campaign, lambda path: is_campaign(path) and read_campaign(path), "text"),
        Target("results of a campaign", driven, lambda path: read_results([path]), "text"),
        Target("benchmark", benchmark, lambda path: check_plan(read_benchmark(path), "benchmark"), "text"),
        Target("dataset", dataset, _drives_of, "text"),
        Target("channel trace", trace, _channel, "text"),
        Target("manifest", manifest, lambda path: read_manifest(path.parent), "text"),
        Target(
            "--set",
            words,
            lambda path: override(RECIPES["debug"](), [path.read_text("utf-8", "replace")]),
            "text",
            False,
        ),
    ]


def _channel(path: Path) -> object:
    read_trace.cache_clear()
    return read_trace(str(path)).at(0.5, 1000, 2)


def _drives_of(path: Path) -> object:
    found = find_split_file(path)
    return None if found is None else expand(read_dataset(found), found)


def _maps(folder: Path) -> list[Target]:
    packed, polygons, trips = folder / "two.osm.pbf", folder / "map.poly.xml", folder / "trips.rou.xml"
    packed_file(packed)
    polygons.write_text(POLYGONS)
    trips.write_text(TRIPS)
    net, town_map, drive_map = folder / "town.net.xml", folder / "town.osm", folder / "town.xodr"
    town_map.write_text(town())
    run_tool("netconvert", {"osm-files": str(town_map), "output-file": str(net), "no-warnings": True}, net, "town")
    drive = {"sumo-net-file": str(net), "opendrive-output": str(drive_map), "no-warnings": True}
    run_tool("netconvert", drive, drive_map, "town")

    def imported(path: Path) -> object:
        with tempfile.TemporaryDirectory(dir=folder) as made:
            return import_map(path, name="town", out=Path(made) / "town", seeds=(1,))

    return [
        Target("SUMO network", net, lambda path: read_network(path).getEdges(), "text"),
        *(Target(f"map {path.suffix}", path, imported, "text") for path in (net, town_map, drive_map)),
        Target("OpenStreetMap, binary", packed, lambda path: pbf_to_xml(path, folder / "two.osm")),
        Target("buildings", polygons, lambda path: has_buildings(path) and read_outlines(path), "text"),
        Target("roadside objects", polygons, read_map_objects, "text"),
        Target("trips", trips, read_trips, "text"),
    ]


def _meshes(folder: Path) -> list[Target]:
    studio, wavefront = folder / "small.3ds", folder / "quad.obj"
    studio.write_bytes(small_3ds())
    wavefront.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nusemtl roof\nf 1//1 2//1 3//1 4//1\nf -4 -3 -2\n")
    return [
        Target("mesh .3ds", studio, read_3ds),
        Target("mesh .obj", wavefront, read_obj, "text"),
    ]
