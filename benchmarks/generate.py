"""What drives cost: CPU time per frame over agents, vehicles, clouds and worlds, and frames per second over workers.

Worlds of both versions by themselves: time to build, memory, size on disk.

Workers are processes of this machine, and Ray's where the package ray is installed. CPU time is the figure to trust
where other processes are busy.

python -m benchmarks.generate
python -m benchmarks.generate --quick
"""

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal
from unittest import mock

import msgspec
import tyro

from benchmarks.quiet import others_s
from benchmarks.street import BENCHMARK_LIDAR
from dsrc.data.changes import in_world
from dsrc.data.checksums import Written
from dsrc.data.drive_folder import TRAFFIC_LOG, WORLD
from dsrc.data.formats.opv2v.reader import CLOUDS, Clouds, write_frame
from dsrc.data.simulate import SimulatedDrive, open_simulated
from dsrc.data.write import DriveSpec
from dsrc.runs.executors import Executor, ProcessExecutor, Progress, RayExecutor
from dsrc.tables.table import Table
from sensors.presets import register_sensor
from sensors.scan.scene import RayScene
from sim.catalog.load import load_scenario
from sim.scenario import Scenario
from sim.world.build import build_world
from sim.world.world_file import save_world

AGENTS, VEHICLES = 5, 60
AGENT_COUNTS, VEHICLE_COUNTS = (1, 2, 5, 10, 20), (20, 60, 100)
STAGES: dict[str, tuple[str, ...]] = {
    "tracing": ("sensors.recording.rig.scan_all", "sensors.recording.rig.RayScene.with_bodies"),
    "visibility": ("sensors.recording.rig.visible_fraction", "sensors.recording.rig.lines_of_sight"),
    "encode": (
        "dsrc.data.formats.opv2v.reader.deskew_frame",
        "dsrc.data.formats.pcd.records_of",
        "dsrc.data.formats.opv2v.reader.encode_compact",
        "dsrc.data.formats.opv2v.reader.encode_agent",
    ),
}
"""Functions whose time is a stage's; writing is the rest: files and their SHA-256."""


@dataclass(slots=True)
class Clock:
    """CPU seconds of this process by stage."""

    seconds: dict[str, float] = field(default_factory=dict)

    def timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that does the same and adds its time to a stage."""

        def run(*args: Any, **more: Any) -> Any:
            start = time.process_time()
            try:
                return function(*args, **more)
            finally:
                self.seconds[stage] = self.seconds.get(stage, 0.0) + time.process_time() - start

        return run

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Time the functions of `STAGES` wherever they are called."""
        with ExitStack() as stack:
            for stage, names in STAGES.items():
                for name in names:
                    owner, _, attribute = name.rpartition(".")
                    module, _, kind = owner.rpartition(".")
                    place = getattr(import_module(module), kind) if kind[0].isupper() else import_module(owner)
                    function = getattr(place, attribute)
                    stack.enter_context(mock.patch.object(place, attribute, self.timed(stage, function)))
            yield


@dataclass(frozen=True, slots=True)
class Point:
    """Point of the curve: what is made."""

    agents: int = AGENTS
    vehicles: int = VEHICLES
    clouds: Clouds = "pcd"
    world: Literal[1, 2] = 1


@dataclass(frozen=True, slots=True)
class Cost:
    """What a frame costs: CPU milliseconds by stage, and megabytes."""

    stages: dict[str, float]
    mb: float

    @property
    def cpu_ms(self) -> float:
        """CPU milliseconds of all stages."""
        return sum(self.stages.values())

    def shown(self) -> tuple[str, str, str]:
        """Return CPU milliseconds of a frame, core-hours and terabytes of a million."""
        return f"{self.cpu_ms:.1f}", f"{self.cpu_ms / 3.6:.1f}", f"{self.mb:.1f}"


def points(quick: bool) -> list[Point]:
    """Return the points of the curve: one of agents, vehicles, clouds and worlds changes at a time."""
    agents = (1, AGENTS) if quick else AGENT_COUNTS
    vehicles = (20, VEHICLES) if quick else VEHICLE_COUNTS
    varied = [Point(), *(Point(clouds=clouds) for clouds in CLOUDS)]
    varied += [*(Point(agents=count) for count in agents), *(Point(vehicles=count) for count in vehicles)]
    varied.append(Point(world=2))
    return list(dict.fromkeys(varied))


def busy_scenario(agents: int = AGENTS, vehicles: int = VEHICLES, world: Literal[1, 2] = 1) -> Scenario:
    """Return the made junctions with that many vehicles, some of which carry the benchmarks' sensor."""
    scenario = load_scenario("four_way")
    demand = msgspec.structs.replace(
        scenario.demand,
        vehicles_per_hour=6000.0,
        bicycles_per_hour=0.0,
        persons_per_hour=0.0,
        max_vehicles=vehicles,
    )
    rule = msgspec.structs.replace(scenario.agents, vehicles=agents, lidar=BENCHMARK_LIDAR.name, roadside=())
    return in_world(msgspec.structs.replace(scenario, demand=demand, agents=rule, warmup_s=45.0), world)


def make_frames(live: SimulatedDrive, drive: Path, first: int, last: int, clouds: Clouds = "pcd") -> None:
    """Make and write some frames with their SHA-256, as `dsrc generate` does."""
    written = Written()
    for index in range(first, last):
        frame = live.frame(index)
        plans = live.plans(index)
        write_frame(drive, frame, True, plans, motion="middle", clouds=clouds, write=written.write)


@dataclass(frozen=True, slots=True)
class Share:
    """What one worker makes: a drive of its own out of the recording of the parent."""

    recorded: Path
    drive: Path
    frames: int
    workers: int


def work(share: Share, report: Progress) -> tuple[float, float, float]:
    """Make a drive in a worker; return when its second frame began, when its last was done, and CPU seconds between."""
    register_sensor(BENCHMARK_LIDAR)
    spec = DriveSpec(busy_scenario(), 1, share.frames)
    share.drive.mkdir(parents=True)
    with _opened(spec, share.drive, share.recorded) as live:
        make_frames(live, share.drive, 0, 1)
        (share.drive.parent / f"{share.drive.name}.ready").touch()
        while len(list(share.drive.parent.glob("*.ready"))) < share.workers:
            time.sleep(0.005)
        start, cpu = time.monotonic(), time.process_time()
        make_frames(live, share.drive, 1, share.frames)
        return start, time.monotonic(), time.process_time() - cpu


def _opened(spec: DriveSpec, drive: Path, recorded: Path | None) -> Any:
    log = drive / TRAFFIC_LOG
    return open_simulated(spec.scenario, spec.seed, spec.frames, spec.interval_s, log, True, recorded, threads=1)


def traffic_ms() -> float:
    """Return CPU milliseconds of a step of the traffic."""
    from sim.traffic.open import open_traffic

    with open_traffic(busy_scenario(), 1) as traffic:
        start = time.process_time()
        for _ in range(50):
            traffic.step()
        return 1e3 * (time.process_time() - start) / 50


def cost_of(point: Point, drive: Path, frames: int, recorded: Path | None) -> Cost:
    """Return what a frame costs in this process, on one thread, without the traffic."""
    spec, clock = DriveSpec(busy_scenario(point.agents, point.vehicles, point.world), 1, frames), Clock()
    drive.mkdir()
    with _opened(spec, drive, recorded) as live:
        make_frames(live, drive, 0, 1, point.clouds)
        with clock.watching():
            start = time.process_time()
            make_frames(live, drive, 1, frames, point.clouds)
            whole_ms = 1e3 * (time.process_time() - start) / (frames - 1)
    parts = {stage: 1e3 * clock.seconds[stage] / (frames - 1) for stage in STAGES}
    size = sum(path.stat().st_size for path in drive.glob("*/000001.*"))
    return Cost({**parts, "write": whole_ms - sum(parts.values())}, size / 1e6)


def curve(folder: Path, frames: int, quick: bool) -> tuple[dict[Point, Cost], Path]:
    """Return what each point costs, and the folder of the recording of the first."""
    register_sensor(BENCHMARK_LIDAR)
    step_ms, costs = traffic_ms(), dict[Point, Cost]()
    recordings: dict[tuple[int, int], Path] = {}
    for row, point in enumerate(points(quick)):
        drive = folder / f"point_{row}"
        cost = cost_of(point, drive, frames, recordings.get((point.vehicles, point.world)))
        costs[point] = Cost({"traffic": step_ms, **cost.stages}, cost.mb)
        recordings.setdefault((point.vehicles, point.world), drive)
        for cloud in [path for clouds in CLOUDS for path in drive.glob(f"*/*.{clouds}")]:
            cloud.unlink()  # a drive may have a gigabyte, in memory
    return costs, recordings[VEHICLES, 1]


@dataclass(frozen=True, slots=True)
class WorldCost:
    """What a world costs: seconds of CPU to build, megabytes meanwhile and afterwards, kilobytes of its file."""

    build_s: float
    peak_mb: float
    held_mb: float
    file_kb: float
    triangles: int


def world_cost(place: tuple[str, Literal[1, 2]], report: Progress) -> WorldCost:
    """Build the world of a scenario, by name and version, and its hierarchy of rays, in a process of its own."""
    scenario = in_world(load_scenario(place[0]), place[1])
    Path("/proc/self/clear_refs").write_text("5")  # the most so far, that of the parent, is forgotten
    before, start = _memory_mb("VmRSS"), time.process_time()
    world = build_world(scenario, 1)
    scene = RayScene(world)
    spent = time.process_time() - start
    held, peak = _memory_mb("VmRSS") - before, _memory_mb("VmHWM") - before
    with tempfile.TemporaryDirectory() as folder:
        size = save_world(world, {}, Path(folder) / WORLD).stat().st_size
    del scene
    return WorldCost(spent, peak, held, size / 1e3, len(world.faces))


def _memory_mb(kind: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return float(next(line.split()[1] for line in lines if line.startswith(kind))) / 1024


def world_costs(quick: bool) -> dict[tuple[str, int], WorldCost]:
    """Return what worlds of both versions cost."""
    places = [(name, version) for name in ("four_way", "braunschweig")[: 1 if quick else 2] for version in (1, 2)]
    costs = {}
    for place in places:  # a process each, so that none has the memory of another
        with ProcessExecutor(1) as pool:
            for outcome in pool.run(world_cost, [place]):
                if outcome.error is not None:
                    raise outcome.error
                costs[place] = outcome.value
    return costs


def rate_of(place: Path, recorded: Path, executor: Executor, workers: int, frames: int) -> tuple[float, float]:
    """Return frames per second that workers make together, each on one thread, and CPU milliseconds of a frame."""
    shares = [Share(recorded, place / str(row), frames, workers) for row in range(workers)]
    with executor as pool:
        outcomes = list(pool.run(work, shares))
    for outcome in outcomes:
        if outcome.error is not None:
            raise outcome.error
    starts, ends, cpu = zip(*(outcome.value for outcome in outcomes), strict=True)
    made = workers * (frames - 1)
    return made / (max(ends) - min(starts)), 1e3 * sum(cpu) / made


def main(quick: bool = False, out: Path | None = None) -> None:
    """Measure what drives cost.

    Args:
        quick: fewer frames and points, and none on Ray.
        out: folder on the disk to write to; in memory (/dev/shm) where there is such, so that no disk is measured.
    """
    frames = 4 if quick else 21
    memory = Path("/dev/shm")
    place = out if out is not None else memory if memory.is_dir() else None
    kinds: dict[str, Callable[[int], Executor]] = {"local": ProcessExecutor}
    if not quick and find_spec("ray") is not None:  # its start takes longer than all else
        kinds["ray"] = RayExecutor
    cores = os.cpu_count() or 1
    counts = [1, 2] if quick else [count for count in (1, 2, 4, 8, 16) if count <= max(2, cores)]
    with tempfile.TemporaryDirectory(prefix="dsrc-benchmark-", dir=place) as name:
        folder, others, start = Path(name), others_s(), time.monotonic()
        costs, recorded = curve(folder, frames, quick)
        load = (others_s() - others) / (time.monotonic() - start)
        worlds = world_costs(quick)
        log = (recorded / TRAFFIC_LOG).stat().st_size
        world = (recorded / WORLD).stat().st_size
        rates = {
            (kind, count): rate_of(folder / f"{kind}_{count}", recorded, executor(count), count, frames)
            for kind, executor in kinds.items()
            for count in counts
        }
    parts, total = costs[Point()].stages, costs[Point()].cpu_ms
    stages = ((stage, f"{spent:.1f}", f"{spent / total:.1%}") for stage, spent in parts.items())
    print(Table.of(("stage", "CPU ms per frame", "share"), stages))
    columns = ("agents", "vehicles", "clouds", "world", "CPU ms per frame", "core-hours per million", "TB per million")
    print(Table.of(columns, ((p.agents, p.vehicles, p.clouds, p.world, *cost.shown()) for p, cost in costs.items())))
    columns = ("place", "world", "triangles", "CPU s to build", "MB at most", "MB held", "kB on disk")
    built = (
        (*place, c.triangles, f"{c.build_s:.1f}", f"{c.peak_mb:.0f}", f"{c.held_mb:.0f}", f"{c.file_kb:.0f}")
        for place, c in worlds.items()
    )
    print(Table.of(columns, built))
    rated = ((*key, f"{rate:.2f}", f"{cpu_ms:.1f}") for key, (rate, cpu_ms) in rates.items())
    print(Table.of(("executor", "workers", "frames per s", "CPU ms per frame"), rated))
    figures = {
        "agents": AGENTS,
        "vehicles": VEHICLES,
        "rays": 64 * 1800,
        **{f"frames_per_s_{count}": round(rate, 3) for (kind, count), (rate, _) in rates.items() if kind == "local"},
        **{f"worker_cpu_ms_{count}": round(ms, 1) for (kind, count), (_, ms) in rates.items() if kind == "local"},
        **{f"ray_frames_per_s_{count}": round(rate, 3) for (kind, count), (rate, _) in rates.items() if kind == "ray"},
        **{f"ray_worker_cpu_ms_{count}": round(ms, 1) for (kind, count), (_, ms) in rates.items() if kind == "ray"},
        "cpu_ms_per_frame": round(total, 1),
        **{f"share_{stage}": round(spent / total, 4) for stage, spent in parts.items()},
        "frame_mb": round(costs[Point()].mb, 2),
        "compact_cpu_ms_per_frame": round(costs[Point(clouds="compact")].cpu_ms, 1),
        "compact_frame_mb": round(costs[Point(clouds="compact")].mb, 2),
        "curve": [
            msgspec.to_builtins(p) | {"cpu_ms": round(c.cpu_ms, 1), "mb": round(c.mb, 2)} for p, c in costs.items()
        ],
        "tracing_ms": {p.world: round(costs[p].stages["tracing"], 1) for p in (Point(), Point(world=2))},
        "worlds": [
            {"place": place, "world": version, **msgspec.to_builtins(c)} for (place, version), c in worlds.items()
        ],
        "written_to": str(place or tempfile.gettempdir()),
        "log_bytes_per_frame": round(log / (frames + 30)),
        "world_kb": round(world / 1e3),
        "others_load_cores": round(load, 2),
    }
    sys.stdout.write(json.dumps(figures) + "\n")


if __name__ == "__main__":
    tyro.cli(main)
