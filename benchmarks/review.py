"""The review: a step, the index of errors, the threshold over a run, memory; first picture and streaming in Chromium.

A drive of five agents with 85,000 points each, of which 60,000 are shown, lies on the disk and is stepped through;
frames that were seen are no longer kept when their turn comes again. A run of 200 frames has 60 detections and 40
objects in each, of three methods: right ones off by some decimetres, some twice, some missed, some of nothing.

Figures are medians of the CPU time of one thread, which other processes disturb least; `..._wall` of the wall time.
`first_picture_s` is wall time from the start of `dsrc view` on a drive of 200 frames until a Chromium that is already
open has drawn points, read from the pixels of its canvas, with the CPU time of the server and of the browser, which
draws in software, until then. `bare_first_picture_s` is the same of a bare viser page, the limit: a server that starts
and sends one cloud of as many points; `first_picture_over_bare` is the ratio. `stream_core_share` is the CPU time of
the server per second while a page of five clouds of 60,000 points steps ten times per second through frames in memory,
to such a Chromium. Without Chromium all of these are left out.

    python -m benchmarks.review            # about two minutes
    python -m benchmarks.review --quick    # fewer steps, under a minute
"""

import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from websockets.asyncio.server import ServerConnection

from dsrc.tables.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dsrc.data.drives import open_drive
from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.evaluation.detection_table import DetectionTable, join_tables, one_frame
from dsrc.ops.detections import Detections
from dsrc.review.errors.filters import ErrorFilter, Span
from dsrc.review.errors.index import ErrorIndex, changes, worst_frames
from dsrc.review.errors.judged import JudgedRun
from dsrc.review.frames import KEPT
from dsrc.review.model import ReviewModel
from dsrc.review.page.app import ReviewApp
from dsrc.review.page.output.screenshot import find_chromium, open_page
from dsrc.review.page.server import free_port, start_server
from dsrc.review.palette import AGENT_COLORS, LOOKS
from dsrc.review.sources.base import DriveSource, MemorySet, Setup
from dsrc.review.state import ReviewState
from sensors.frame import AgentFrame, Frame, count_points
from sensors.sweep import STATIC, Sweep, make_sweep
from sim.boxes import Boxes
from sim.geometry import invert, pose_matrix, transform_points

CHECKPOINT = Path(__file__).resolve().parents[1] / "dsrc/checkpoints/small-dsrc.pt"
METHODS = ("A", "B", "C")
FRAMES, BOXES, OBJECTS = 200, 60, 40
AGENTS, POINTS, SHOWN_POINTS = 5, 85_000, 60_000
GOALS = {"step_ms": 50.0, "threshold_ms": 100.0, "index_s": 1.0, "stream_core_share": 0.25}
GOALS |= {"first_picture_s": 3.0, "detector_first_picture_s": 3.0, "stream_step_ms": 50.0, "stream_step_mb": 0.7}
GOALS |= {"memory_mb": 400.0}
"""The most that a figure may be."""


def draw_truth(rng: np.random.Generator) -> Boxes:
    """Objects in the lanes of a street, the agents first."""
    spots = rng.permutation(24 * 8)[:OBJECTS]
    xy = np.stack([(spots % 24 - 12) * 8.0, (spots // 24 - 4) * 3.6], axis=1)
    size = np.array([[4.5, 1.8, 1.5], [5.9, 2.0, 2.6], [7.4, 2.4, 3.2]])[rng.choice(3, OBJECTS, p=[0.8, 0.15, 0.05])]
    yaw = rng.choice([0.0, np.pi], OBJECTS)
    return Boxes.from_array(np.column_stack([xy, 0.5 * size[:, 2], size, yaw]), object_id=1000 + np.arange(OBJECTS))


def draw_table(rng: np.random.Generator, row: int, truth: Boxes) -> DetectionTable:
    """Draw the detections of one frame: most objects, off a little, and boxes of nothing."""
    right = truth.array[rng.random(len(truth)) < 0.85]
    again = right[rng.random(len(right)) < 0.2]
    found = np.concatenate([right, again])
    found[:, :2] += rng.normal(0.0, 0.25, (len(found), 2))
    found[:, 6] += rng.normal(0.0, 0.05, len(found))
    ghosts = np.column_stack(
        [rng.uniform(-90, 90, (BOXES, 1)), rng.uniform(-35, 35, (BOXES, 1)), np.ones(BOXES), np.full((BOXES, 3), 2.5)]
    )
    boxes = np.concatenate([found, np.column_stack([ghosts, rng.uniform(-3, 3, BOXES)])])[:BOXES]
    score = rng.random(BOXES).astype(np.float32)
    ego = rng.integers(0, 50, len(truth))
    points = np.stack([ego, ego + rng.integers(0, 90, len(truth)), ego // 2, ego], axis=1)
    return one_frame(row, row, int(truth.object_id[0]), Detections(Boxes.from_array(boxes), score), truth, points)


def draw_run(seed: int, frames: int) -> DetectionTable:
    """Draw a run; seeds share the objects."""
    tables = []
    for row in range(frames):
        truth = draw_truth(np.random.default_rng([7, row]))
        tables.append(draw_table(np.random.default_rng([seed, row]), row, truth))
    return join_tables(tables)


def draw_frame(index: int, points: int = POINTS) -> Frame:
    """Draw a frame of agents on a street, each with points on the road and on the objects."""
    rng = np.random.default_rng([11, index])
    truth = draw_truth(rng)
    agents = [_agent(rng, index, truth, row, points) for row in range(AGENTS)]
    points_on = np.stack([count_points(agent.sweep, truth.object_id) for agent in agents])
    return Frame(index, 0.1 * index, tuple(agents), truth, np.zeros((len(truth), 2)), points_on)


def _agent(rng: np.random.Generator, index: int, truth: Boxes, row: int, points: int) -> AgentFrame:
    foot = truth.center[row] - [0.0, 0.0, 0.5 * truth.size[row, 2]]
    body = np.asarray(pose_matrix(foot, truth.yaw[row]), np.float64)
    sweep = _sweep(rng, truth, row, body @ pose_matrix([0, 0, 1.9]), index, points)
    return AgentFrame(int(truth.object_id[row]), "vehicle", body, 8.0, sweep)


def _sweep(
    rng: np.random.Generator, truth: Boxes, own: int, world_from_lidar: NDArray[np.float64], index: int, points: int
) -> Sweep:
    others = np.delete(np.arange(len(truth)), own)
    on = rng.choice(others, points // 4)
    local = (rng.random((len(on), 3)) - 0.5) * truth.size[on]
    turn = np.stack([np.cos(truth.yaw[on]), np.sin(truth.yaw[on])], axis=1)
    across = np.stack([-turn[:, 1], turn[:, 0]], axis=1)
    objects = truth.center[on] + np.column_stack([turn * local[:, :1] + across * local[:, 1:2], local[:, 2]])
    radius, angle = rng.uniform(3.0, 90.0, points - len(on)), rng.uniform(0.0, 2.0 * np.pi, points - len(on))
    road = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(len(radius))], axis=1)
    world = np.concatenate([objects, road + np.append(world_from_lidar[:2, 3], 0.0)])
    return make_sweep(
        np.asarray(transform_points(invert(world_from_lidar), world)),
        world_from_lidar,
        0.1 * index,
        intensity=rng.random(points),
        ring=np.arange(points) % 64,
        object_id=np.concatenate([truth.object_id[on], np.full(len(road), STATIC)]),
    )


def make_model(folder: Path, frames: int) -> ReviewModel:
    """Write a drive and open it with the detections of all methods."""
    drive = folder / "drive"
    sets = {name: MemorySet(name) for name in METHODS}
    for index in range(frames):
        frame = draw_frame(index)
        write_frame(drive, frame)
        inverse = invert(frame.agents[0].sweep.world_from_lidar)
        for seed, name in enumerate(METHODS):
            seen = frame.truth.transform(inverse)
            sets[name].put(index, draw_table(np.random.default_rng([seed, index]), index, seen))
    source = DriveSource(open_drive(drive))
    source.sets.update(sets)
    return ReviewModel([source])


def seconds_of(run: Callable[[int], object], times: int) -> tuple[float, float]:
    """Median CPU and wall seconds of several calls, which get their number."""
    taken = []
    for number in range(times):
        wall, cpu = time.perf_counter(), time.process_time()
        run(number)
        taken.append((time.process_time() - cpu, time.perf_counter() - wall))
    busy, passed = np.median(taken, axis=0).tolist()
    return busy, passed


def in_ms(name: str, seconds: tuple[float, float]) -> dict[str, float]:
    """Figures of CPU and wall seconds, in ms."""
    return {f"{name}_ms": round(1e3 * seconds[0], 1), f"{name}_ms_wall": round(1e3 * seconds[1], 1)}


def resident_mb() -> float:
    """Memory of this process, MB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def step_figures(quick: bool) -> dict[str, float]:
    """Milliseconds of a step with its frame on the disk and read ahead, and the memory that many steps leave, MB."""
    frames, steps = KEPT + 6, 60 if quick else 1000
    with tempfile.TemporaryDirectory() as folder:
        model = make_model(Path(folder), frames)
        states = [ReviewState(frame=row, methods=METHODS, max_points=SHOWN_POINTS) for row in range(frames)]
        for state in states:
            model.view(state)
        before = resident_mb()
        step = seconds_of(lambda number: model.view(states[number % frames]), steps)
        memory = resident_mb()
        ahead = []
        for row in range(frames):
            model.stores[0].recorded(row)
            ahead.append(seconds_of(lambda _, row=row: model.view(states[row]), 1))  # type: ignore[misc]
    busy, passed = np.median(ahead, axis=0).tolist()
    return {
        **in_ms("step", step),
        **in_ms("step_ahead", (busy, passed)),
        "growth_mb": round(memory - before, 1),
        "memory_mb": round(memory, 1),
        "steps": steps,
    }


def run_figures(quick: bool) -> dict[str, float]:
    """Seconds of the index of three methods, and milliseconds of what follows the threshold, a filter, a comparison."""
    tables = {name: draw_run(seed, FRAMES) for seed, name in enumerate(METHODS)}

    def index() -> ErrorIndex:
        made = ErrorIndex([JudgedRun(name, Setup(), table) for name, table in tables.items()])
        made.errors(0.3, 0.5)
        return made

    known, times = index(), 3 if quick else 21
    near = ErrorFilter(distance_m=Span(0.0, 30.0), classes=("car",))

    def move(number: int, only: ErrorFilter | None = None) -> None:
        threshold = 0.05 + 0.9 * number / times
        errors = known.errors(threshold, 0.5, only)
        known.counts(threshold, 0.5, only)
        known.curves(0.5, only)
        worst_frames(errors, known.runs["A"].table.position)

    runs, seconds = list(known.runs.values()), seconds_of(lambda _: index(), times)
    return {
        "index_s": round(seconds[0], 3),
        "index_s_wall": round(seconds[1], 3),
        **in_ms("threshold", seconds_of(move, times)),
        **in_ms("filter", seconds_of(lambda number: move(number, near), times)),
        **in_ms("changes", seconds_of(lambda _: changes(runs[0], runs[1], 0.3, 0.5), times)),
        "errors": len(known.errors(0.3, 0.5)),
    }


def browser_figures(quick: bool) -> dict[str, float]:
    """Seconds to the first picture of a page, and the share of a core that streaming takes; none without Chromium."""
    if find_chromium() is None:
        return {}
    with tempfile.TemporaryDirectory() as folder:
        frames = 12 if quick else FRAMES
        drive = Path(folder) / "drive"
        for index in range(min(frames, KEPT - 1)):
            write_frame(drive, draw_frame(index, SHOWN_POINTS))
        for index in range(KEPT - 1, frames):
            copy_frame(drive, index % (KEPT - 1), index)
        with_detector = first_picture(drive, "detector_", "--checkpoint", str(CHECKPOINT))
        ours, bare = first_picture(drive), bare_picture()
        ratio = {"first_picture_over_bare": round(ours["first_picture_s"] / bare["bare_first_picture_s"], 2)}
        return {**ours, **with_detector, **bare, **ratio, **streaming(drive, 3.0 if quick else 15.0)}


def copy_frame(drive: Path, index: int, to: int) -> None:
    """Write the files of a frame again under another number."""
    for path in sorted(drive.glob(f"*/{index:06d}.*")):
        shutil.copyfile(path, path.with_name(f"{to:06d}{path.suffix}"))


BARE = """
import sys, time, numpy as np, viser
server = viser.ViserServer(host="127.0.0.1", port=int(sys.argv[1]), verbose=False)
points = np.random.default_rng(0).uniform(-60.0, 60.0, (int(sys.argv[2]), 3)).astype(np.float32)
server.scene.add_point_cloud("/points", points, colors=tuple(map(int, sys.argv[3].split(","))), point_size=0.1)
time.sleep(600.0)
"""
"""A page of viser with one cloud: what any page of it costs."""

_POINTS = "Object.entries((window.__viserMutable||{}).nodeRefFromName||{}).some(([n,o])=>n.endsWith('/points')&&o)"
# A screenshot takes a software renderer longer than the page takes to come up.
_DRAWN = f"""
(()=>{{const from=[...document.querySelectorAll('canvas')].pop(),
to=new OffscreenCanvas(from.width,from.height).getContext('2d');
to.drawImage(from,0,0);const p=to.getImageData(0,0,from.width,from.height).data;
return {json.dumps([*AGENT_COLORS[:AGENTS], LOOKS["light"].ink])}.some(([r,g,b])=>{{let n=0;for(let i=0;i<p.length;i+=4)
 n+=Math.abs(p[i]-r)<5&&Math.abs(p[i+1]-g)<5&&Math.abs(p[i+2]-b)<5;return n>20;}})}})()
"""


def busy_s(parent: int) -> float:
    """CPU seconds of a process and of all that it has started and that still run."""
    seconds, children = {}, {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has ended
            fields = path.read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
            seconds[int(path.parent.name)] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
            children.setdefault(int(fields[1]), []).append(int(path.parent.name))
    family = [parent]
    for one in family:
        family += children.get(one, [])
    return sum(seconds.get(one, 0.0) for one in family)


def first_picture(drive: Path, prefix: str = "", *options: str) -> dict[str, float]:
    """Seconds from the start of `dsrc view` until its address answers, and until a browser shows points.

    Args:
        prefix: of the names of the figures.
        options: further options of `dsrc view`.
    """
    port = free_port()
    command = ["-m", "dsrc", "view", str(drive), "--port", str(port), *options]
    return {prefix + name: seconds for name, seconds in first_drawn(port, command).items()}


def bare_picture() -> dict[str, float]:
    """`first_picture` of a bare viser page of as many points."""
    port, rgb = free_port(), ",".join(map(str, AGENT_COLORS[0]))
    figures = first_drawn(port, ["-c", BARE, str(port), str(AGENTS * SHOWN_POINTS), rgb])
    return {f"bare_{name}": seconds for name, seconds in figures.items()}


def first_drawn(port: int, command: list[str]) -> dict[str, float]:
    """Seconds from the start of a Python command until its port answers, and until a browser shows its points."""
    # Byte code is kept, as that of an installation is.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    with open_page("about:blank", (640, 400)) as page:
        before, started = busy_s(os.getpid()), time.perf_counter()
        silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": environment}
        with subprocess.Popen([sys.executable, *command], **silent) as server:
            try:
                while not _answers(port):
                    time.sleep(0.02)
                    if server.poll() is not None:
                        raise RuntimeError(f"the server ended with code {server.returncode}")
                answered = time.perf_counter() - started
                page.send("Page.navigate", url=f"http://127.0.0.1:{port}/?fixedDpr=1")
                page.wait_for("document.readyState === 'complete' && document.querySelector('canvas')", 120.0)
                page.wait_for(_POINTS, 120.0)
                arrived = time.perf_counter() - started
                page.wait_for(_DRAWN, 120.0)
                passed, server_cpu = time.perf_counter() - started, busy_s(server.pid)
                return {
                    "first_picture_s": round(passed, 2),
                    "first_picture_server_cpu_s": round(server_cpu, 2),
                    "first_picture_browser_cpu_s": round(busy_s(os.getpid()) - before - server_cpu, 2),
                    "points_s": round(arrived, 2),
                    "server_s": round(answered, 2),
                }
            finally:
                server.kill()  # what it does until it ends is not measured


def _answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def streaming(drive: Path, seconds: float) -> dict[str, float]:
    """CPU time and bytes of a step of a server that sends five clouds ten times per second, and its share of a core."""
    sent, send = [0], ServerConnection.send

    async def counted(connection: ServerConnection, message: Any, *more: Any) -> None:
        sent.append(len(message))
        await send(connection, message, *more)

    ServerConnection.send = counted  # type: ignore[method-assign]
    model, rows = ReviewModel([DriveSource(open_drive(drive))]), KEPT - 1
    for row in range(rows):
        model.stores[0].recorded(row)
    app = ReviewApp(model, start_server(), ReviewState(max_points=SHOWN_POINTS))
    try:
        with open_page(f"{app.url}/?fixedDpr=1", (640, 400)) as page:
            page.wait_for("document.querySelector('canvas')", 60.0)
            (session,) = app.wait_session(1, 60.0)
            session.wait_drawn(60.0)
            time.sleep(3.0)
            drawn, before, wall, cpu = 0, sum(sent), time.perf_counter(), time.process_time()
            while (passed := time.perf_counter() - wall) < seconds:
                session.update(frame=(drawn + 1) % rows)
                session.wait_drawn(rested=False)
                drawn += 1
                time.sleep(max(wall + 0.1 * drawn - time.perf_counter(), 0.0))
            busy, megabytes = time.process_time() - cpu, (sum(sent) - before) / 1e6
    finally:
        app.close()
        ServerConnection.send = send  # type: ignore[method-assign]
    per_step = {"stream_step_ms": round(1e3 * busy / drawn, 1), "stream_step_mb": round(megabytes / drawn, 3)}
    return {**per_step, "stream_core_share": round(busy / passed, 3), "stream_hz": round(drawn / passed, 1)}


_WHAT = {
    "step_ms": "a step: five clouds from the disk, thinned, coloured, matches of three methods",
    "step_ahead_ms": "the same with the frame read ahead",
    "index_s": f"index of the errors of {FRAMES} frames x {BOXES} boxes x {len(METHODS)} methods",
    "threshold_ms": "another threshold over the run: errors, counts, curves, worst frames",
    "filter_ms": "the same with a filter of distance and class",
    "changes_ms": "what one method finds and another misses",
    "growth_mb": "memory that the steps leave behind",
    "memory_mb": "memory of the process after the steps",
    "first_picture_s": "from the start of dsrc view to points drawn by a browser",
    "first_picture_server_cpu_s": "CPU time of dsrc view until then",
    "first_picture_browser_cpu_s": "CPU time of the browser, which draws in software, until then",
    "bare_first_picture_s": "the same of a bare viser page of as many points, the limit",
    "bare_first_picture_server_cpu_s": "CPU time of its server until then",
    "first_picture_over_bare": "ours over the bare page's",
    "detector_first_picture_s": "the same with a detector",
    "detector_first_picture_server_cpu_s": "CPU time of dsrc view until then",
    "points_s": "the same until its points are in the browser's scene",
    "server_s": "the same until its address answers",
    "stream_step_ms": "CPU time of the server for a step that is sent to a browser",
    "stream_step_mb": "what is sent for it, MB",
    "stream_core_share": f"share of a core: {AGENTS} x {SHOWN_POINTS:,} points at 10 Hz to a browser",
}


def main(quick: bool = False) -> None:
    """Time the review: a table for people, then one line of JSON.

    Args:
        quick: fewer steps and repetitions.
    """
    figures = {**run_figures(quick), **step_figures(quick), **browser_figures(quick)}
    goals = {name: f"<= {goal:g}" for name, goal in GOALS.items()}
    rows = ((name, what, figures[name], goals.get(name, "")) for name, what in _WHAT.items() if name in figures)
    title = f"Review: {AGENTS} agents of {POINTS:,} points, {SHOWN_POINTS:,} shown"
    print(Table.of(("figure", "what", "measured", "goal"), rows, 2, title=title).text(120))
    print(json.dumps({**figures, "cores": os.cpu_count()}))


if __name__ == "__main__":
    tyro.cli(main)
