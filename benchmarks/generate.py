"""How fast drives are made: frames per second on one and on two workers, and which stage takes which share.

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
from pathlib import Path
from typing import Any
from unittest import mock

import msgspec
import tyro

from benchmarks.quiet import others_s
from benchmarks.street import BENCHMARK_LIDAR
from dsrc.data.checksums import write_checksums
from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.data.simulate import TRAFFIC_LOG, WORLD, SimulatedDrive, open_simulated
from dsrc.data.write import DriveSpec
from dsrc.runs.executors import ProcessExecutor, Progress
from dsrc.tables.table import Table
from sensors.presets import register_sensor
from sim.catalog.load import load_scenario
from sim.scenario import Scenario

AGENTS, VEHICLES = 5, 60
STAGES: dict[str, tuple[str, ...]] = {
    "tracing": ("sensors.recording.rig.scan_all", "sensors.recording.rig.RayScene.with_bodies"),
    "visibility": ("sensors.recording.rig.visible_fraction", "sensors.recording.rig.lines_of_sight"),
    "encode": (
        "dsrc.data.formats.opv2v.reader.deskew_frame",
        "dsrc.data.formats.opv2v.reader.encode_pcd",
        "dsrc.data.formats.opv2v.reader.encode_agent",
    ),
}
"""Functions whose time is a stage's; writing is the rest of `write_frame` and the checksums."""


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


def busy_scenario() -> Scenario:
    """Return the made junctions with 60 vehicles, five of which carry the benchmarks' sensor."""
    scenario = load_scenario("four_way")
    demand = msgspec.structs.replace(
        scenario.demand,
        vehicles_per_hour=6000.0,
        bicycles_per_hour=0.0,
        persons_per_hour=0.0,
        max_vehicles=VEHICLES,
    )
    agents = msgspec.structs.replace(scenario.agents, vehicles=AGENTS, lidar=BENCHMARK_LIDAR.name, roadside=())
    return msgspec.structs.replace(scenario, demand=demand, agents=agents, warmup_s=45.0)


def make_frames(live: SimulatedDrive, drive: Path, first: int, last: int) -> None:
    """Make and write some frames, as `dsrc generate` does."""
    for index in range(first, last):
        frame = live.frame(index)
        write_frame(drive, frame, True, live.plans(index), motion="middle")


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


def stages(folder: Path, frames: int) -> tuple[dict[str, float], Path]:
    """Return CPU milliseconds per frame by stage, and the folder of the recording; in this process, on one thread."""
    register_sensor(BENCHMARK_LIDAR)
    from sim.traffic.open import open_traffic

    spec, drive, clock = DriveSpec(busy_scenario(), 1, frames), folder / "staged", Clock()
    with open_traffic(spec.scenario, spec.seed) as traffic:
        start = time.process_time()
        for _ in range(50):
            traffic.step()
        step_ms = 1e3 * (time.process_time() - start) / 50
    drive.mkdir()
    with _opened(spec, drive, None) as live:
        make_frames(live, drive, 0, 1)
        with clock.watching():
            start = time.process_time()
            make_frames(live, drive, 1, frames)
            whole_ms = 1e3 * (time.process_time() - start) / (frames - 1)
    start = time.process_time()
    write_checksums(drive)
    sums_ms = 1e3 * (time.process_time() - start) / frames
    parts = {stage: 1e3 * clock.seconds[stage] / (frames - 1) for stage in STAGES}
    rest = whole_ms - sum(parts.values())
    return {"traffic": step_ms, **parts, "write": rest + sums_ms}, drive


def rate_of(folder: Path, recorded: Path, workers: int, frames: int) -> tuple[float, float]:
    """Return frames per second that workers make together, each on one thread, and CPU milliseconds of a frame."""
    place = folder / f"workers_{workers}"
    shares = [Share(recorded, place / str(row), frames, workers) for row in range(workers)]
    with ProcessExecutor(workers) as pool:
        spans = [outcome.value for outcome in pool.run(work, shares)]
    starts, ends, cpu = zip(*spans, strict=True)
    made = workers * (frames - 1)
    return made / (max(ends) - min(starts)), 1e3 * sum(cpu) / made


def main(quick: bool = False, out: Path | None = None) -> None:
    """Measure how fast drives are made.

    Args:
        quick: fewer frames.
        out: folder on the disk to write to; in memory (/dev/shm) where there is such, so that no disk is measured.
    """
    frames = 6 if quick else 41
    memory = Path("/dev/shm")
    place = out if out is not None else memory if memory.is_dir() else None
    with tempfile.TemporaryDirectory(prefix="dsrc-benchmark-", dir=place) as name:
        folder, others, start = Path(name), others_s(), time.monotonic()
        parts, recorded = stages(folder, frames)
        load = (others_s() - others) / (time.monotonic() - start)
        size = sum(path.stat().st_size for path in recorded.glob("*/000001.*"))
        log = (recorded / TRAFFIC_LOG).stat().st_size
        world = (recorded / WORLD).stat().st_size
        counts = [1, 2] if quick else [count for count in (1, 2, 4, 8) if count <= max(2, os.cpu_count() or 1)]
        rates = {count: rate_of(folder, recorded, count, frames) for count in counts}
    total = sum(parts.values())
    stages_of = ((stage, f"{spent:.1f}", f"{spent / total:.1%}") for stage, spent in parts.items())
    print(Table.of(("stage", "CPU ms per frame", "share"), stages_of))
    rated = ((count, f"{rate:.2f}", f"{cpu_ms:.1f}") for count, (rate, cpu_ms) in rates.items())
    print(Table.of(("workers", "frames per s", "CPU ms per frame"), rated))
    figures = {
        "agents": AGENTS,
        "vehicles": VEHICLES,
        "rays": 64 * 1800,
        **{f"frames_per_s_{count}": round(rate, 3) for count, (rate, _) in rates.items()},
        **{f"worker_cpu_ms_{count}": round(cpu_ms, 1) for count, (_, cpu_ms) in rates.items()},
        "cpu_ms_per_frame": round(total, 1),
        **{f"share_{stage}": round(spent / total, 4) for stage, spent in parts.items()},
        "frame_mb": round(size / 1e6, 2),
        "written_to": str(place or tempfile.gettempdir()),
        "log_bytes_per_frame": round(log / (frames + 30)),
        "world_kb": round(world / 1e3),
        "others_load_cores": round(load, 2),
    }
    sys.stdout.write(json.dumps(figures) + "\n")


if __name__ == "__main__":
    tyro.cli(main)
