"""How fast frames are read, and how soon a batch for training is ready.

Frames are made of formulas: five cars among 45 vehicles of a street, each with a sweep of 60,000 points. They lie on
disk twice, as `dsrc` writes them (binary points, our record beside OPV2V's keys) and as OPV2V's own tool does (points
as text, OPV2V's keys alone). The rival is what its users write: PyYAML's `Loader`, which is Python, and numpy's parser
of text; OpenCOOD reads with the same loader and Open3D.

    python -m benchmarks.reading            # half a minute
    python -m benchmarks.reading --quick    # fewer samples
"""

import json
import os
import re
import sys
import tempfile
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import tyro
import yaml
from msgspec.structs import replace
from numpy.typing import NDArray
from rich.console import Console

from dsrc.tables.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.quiet import Timing, measure
from dsrc.data.drives import open_drive
from dsrc.data.formats.opv2v.reader import write_frame
from dsrc.data.sample import Sample, make_sample
from dsrc.models.inputs.batch import collate
from dsrc.models.settings import ModelSettings
from dsrc.training.augmentation.augment import augment, source_grid
from dsrc.training.recipes import RECIPES, Recipe
from sensors.frame import AgentFrame, Frame, count_points
from sensors.presets import get_lidar
from sensors.sweep import make_sweep
from sim.boxes import Boxes
from sim.geometry import invert, pose_matrix, transform_points

AGENTS, POINTS, VEHICLES = 5, 60_000, 45
FRAMES = 4
ON_VEHICLES = 0.2
"""Share of the points."""
STREET_M = 120.0
"""Half the length of the street."""
SAMPLES = 2
"""Of a batch."""
STEP_TFLOP = 2.4
"""Of a training step of DSRC on such a batch: the student forward and backward, the teacher forward."""


def make_frame(index: int) -> Frame:
    """Return a frame of the street, the same in every run."""
    rng = np.random.default_rng(index)
    x = np.linspace(-STREET_M + 10, STREET_M - 10, VEHICLES)
    size = np.tile([4.5, 1.8, 1.5], (VEHICLES, 1)) * rng.uniform(0.9, 1.3, (VEHICLES, 1))
    lane = np.arange(VEHICLES) % 4
    yaw = np.where(lane < 2, 0.0, np.pi) + rng.normal(0.0, 0.02, VEHICLES)
    array = np.column_stack([x + index, lane * 3.6 - 5.4, size[:, 2] / 2, size, yaw])
    truth = Boxes.from_array(array, np.zeros(VEHICLES, np.int64), np.arange(1000, 1000 + VEHICLES))
    rows = np.linspace(0.35 * VEHICLES, 0.6 * VEHICLES, AGENTS).astype(int)
    agents = tuple(_agent(truth, int(row), 0.1 * index, rng) for row in rows)
    return Frame(
        index=index,
        time_s=0.1 * index,
        agents=agents,
        truth=truth,
        velocity=10.0 * np.stack([np.cos(yaw), np.sin(yaw)], axis=1),
        points_on=np.stack([count_points(agent.sweep, truth.object_id) for agent in agents]),
    )


def _agent(truth: Boxes, row: int, time_s: float, rng: np.random.Generator) -> AgentFrame:
    """Return a car whose points lie on the road around it, densest nearby, and on the other vehicles."""
    body = pose_matrix([*truth.center[row, :2], 0.0], truth.yaw[row])
    lidar = body @ pose_matrix([0.0, 0.0, 1.9])
    on_road = round((1 - ON_VEHICLES) * POINTS)
    radius, angle = np.exp(rng.uniform(np.log(4.0), np.log(70.0), on_road)), rng.uniform(-np.pi, np.pi, on_road)
    across = np.clip(radius * np.sin(angle), -36.0, 36.0) + truth.center[row, 1] * 0.5
    road = np.stack([truth.center[row, 0] + radius * np.cos(angle), across, rng.normal(0.0, 0.02, on_road)], axis=1)
    owner = rng.choice(np.delete(np.arange(len(truth)), row), POINTS - on_road)
    local = rng.uniform(-0.49, 0.49, (len(owner), 3)) * truth.size[owner]
    c, s = np.cos(truth.yaw[owner]), np.sin(truth.yaw[owner])
    turned = np.stack([c * local[:, 0] - s * local[:, 1], s * local[:, 0] + c * local[:, 1], local[:, 2]], axis=1)
    world = np.concatenate([road, truth.center[owner] + turned])
    owners = np.concatenate([np.full(on_road, -1), truth.object_id[owner]]).astype(np.int32)
    shuffled = rng.permutation(POINTS)
    points = transform_points(invert(lidar), world)[shuffled].astype(np.float32)
    sweep = make_sweep(
        points,
        lidar,
        time_s,
        get_lidar("opv2v-64"),
        intensity=rng.random(POINTS, dtype=np.float32),
        object_id=owners[shuffled],
    )
    return AgentFrame(int(truth.object_id[row]), "vehicle", body, 10.0, sweep)


def write_trees(root: Path, frames: int = FRAMES) -> tuple[Path, Path]:
    """Write the drive as we do and as OPV2V's tool does; return both folders."""
    ours, theirs = root / "ours", root / "opv2v"
    for index in range(frames):
        write_frame(ours, make_frame(index))
    for path in sorted(ours.rglob("*.yaml")):
        copy = theirs / path.relative_to(ours)
        copy.parent.mkdir(parents=True, exist_ok=True)
        if re.fullmatch(r"\d+", path.stem):
            # In block style, which is PyYAML's and so the other tools' own.
            copy.write_text(yaml.dump(yaml.safe_load(path.read_text().partition("\n")[2])))
            copy.with_suffix(".pcd").write_bytes(_as_text(path.with_suffix(".pcd")))
    return ours, theirs


def _as_text(path: Path) -> bytes:
    """Return the points of one of our files as Open3D writes them in text."""
    content = path.read_bytes()
    start = content.index(b"DATA binary\n") + len(b"DATA binary\n")
    table = np.frombuffer(content, _record(content[:start]), offset=start)
    head = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\n"
        f"COUNT 1 1 1 1\nWIDTH {len(table)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(table)}\nDATA ascii\n"
    )
    columns = [table["x"], table["y"], table["z"], table["rgb"].copy().view(np.float32)]
    text = BytesIO()
    np.savetxt(text, np.stack(columns, axis=1), fmt="%.10g")
    return head.encode() + text.getvalue()


def _record(header: bytes) -> np.dtype:
    """Return the type of a point that a header describes."""
    lines = dict(line.split(" ", 1) for line in header.decode().splitlines() if not line.startswith("#"))
    kinds = {"F": "f", "U": "u", "I": "i"}
    parts = zip(lines["FIELDS"].split(), lines["TYPE"].split(), lines["SIZE"].split(), strict=True)
    return np.dtype([(name, f"<{kinds[kind]}{size}") for name, kind, size in parts])


def plain_read(drive: Path, stem: str) -> list[tuple[dict[str, Any], NDArray[np.float32]]]:
    """Return of each agent the annotations and (P, 4) points with their colour, as a plain script reads a frame."""
    found = []
    for folder in sorted(path for path in drive.iterdir() if path.is_dir()):
        with open(folder / f"{stem}.yaml") as file:
            notes = yaml.load(file, Loader=yaml.Loader)  # noqa: S506 - what the rival does, on files made here
        content = (folder / f"{stem}.pcd").read_bytes()
        header, data, body = content.partition(b"DATA ascii\n")
        if data:
            points = np.loadtxt(BytesIO(body), np.float32)
        else:
            header, data, body = content.partition(b"DATA binary\n")
            table = np.frombuffer(body, _record(header))
            points = np.stack([table["x"], table["y"], table["z"], table["rgb"].copy().view(np.float32)], axis=1)
        found.append((notes, points))
    return found


def check_same(ours: Path, theirs: Path) -> None:
    """Compare what all of the readers make of the first frame."""
    frame, foreign = open_drive(ours).read(0), open_drive(theirs).read(0)
    for agent, other, (notes, points) in zip(frame.agents, foreign.agents, plain_read(theirs, "000000"), strict=True):
        mirrored = points[:, :3] * [1.0, -1.0, 1.0]
        for sweep in (agent.sweep, other.sweep):
            if not np.allclose(sweep.points, mirrored, atol=1e-4):
                raise AssertionError("the readers' points differ")
        # An agent lists what it has points on, itself left out.
        if not set(notes["vehicles"]) <= set(frame.truth.object_id.tolist()) or len(notes["vehicles"]) < VEHICLES / 2:
            raise AssertionError("the readers' objects differ")


def read_samples(drive: Path, recipe: Recipe) -> list[Sample]:
    """Return the samples of a batch, augmented; from the disk."""
    reader = open_drive(drive)
    wide = source_grid(recipe.model.grid, recipe.augmentation)
    rng = np.random.default_rng(0)
    samples = [make_sample(reader.read(i), None, wide) for i in range(SAMPLES)]
    return [augment(sample, recipe.model.grid, recipe.augmentation, rng) for sample in samples]


def variants_of(ours: Path, theirs: Path) -> dict[str, Callable[[], object]]:
    """Return what is timed, by name."""
    own, foreign = open_drive(ours), open_drive(theirs)
    recipe = RECIPES["opv2v"]()
    # Every agent takes part in every sample, as in the stated batch.
    recipe = replace(recipe, augmentation=replace(recipe.augmentation, dropout=0.0))
    grid, wide = recipe.model.grid, source_grid(recipe.model.grid, recipe.augmentation)
    plain, dsrc = recipe.settings("plain"), recipe.settings("student")
    frames = [own.read(i) for i in range(SAMPLES)]
    wide_samples = [make_sample(frame, None, wide) for frame in frames]
    samples = read_samples(ours, recipe)
    if any(len(sample.clouds) != AGENTS for sample in samples):
        raise AssertionError("an agent is missing in the batch")

    def batch(settings: ModelSettings) -> Callable[[], object]:
        return lambda: collate(read_samples(ours, recipe), settings, training=True)

    def crop() -> list[Sample]:
        rng = np.random.default_rng(0)
        return [augment(sample, grid, recipe.augmentation, rng) for sample in wide_samples]

    return {
        "frame": lambda: own.read(0),
        "frame_opv2v": lambda: foreign.read(1),
        "plain_text": lambda: plain_read(theirs, "000001"),
        "plain_binary": lambda: plain_read(ours, "000000"),
        "batch_plain": batch(plain),
        "batch_dsrc": batch(dsrc),
        "stage_read": lambda: [own.read(i) for i in range(SAMPLES)],
        "stage_sample": lambda: [make_sample(frame, None, wide) for frame in frames],
        "stage_augment": crop,
        "stage_collate_plain": lambda: collate(samples, plain, training=True),
        "stage_collate_dsrc": lambda: collate(samples, dsrc, training=True),
    }


def show(console: Console, timings: dict[str, Timing]) -> None:
    """Print the tables."""
    labels = {
        "frame": "our reader, our files",
        "plain_binary": "plain script, our files",
        "frame_opv2v": "our reader, OPV2V's files",
        "plain_text": "plain script, OPV2V's files",
    }
    rows: list[tuple[str, ...]] = []
    for name, label in labels.items():
        timing = timings[name]
        rows.append((label, f"{1e3 * timing.wall_s:.1f}", f"{1e3 * timing.cpu_s:.1f}", f"{1 / timing.wall_s:.1f}"))
    title = f"One frame of {AGENTS} agents, {POINTS} points each, one thread"
    console.print(Table.of(("what", "ms", "CPU ms", "frames per s"), rows, title=title))
    rows = []
    for name, timing in timings.items():
        if name not in labels:
            label = name.replace("batch_", "whole batch, ").removeprefix("stage_").replace("_", " ")
            rows.append((label, f"{1e3 * timing.wall_s:.0f}", f"{1e3 * timing.cpu_s:.0f}"))
    title = f"One batch of {SAMPLES} samples, from the disk on, one thread"
    console.print(Table.of(("what", "ms", "CPU ms"), rows, title=title))


def figures_of(timings: dict[str, Timing]) -> dict[str, object]:
    """Return the JSON's figures; ratios and batches are CPU time, which others on the machine disturb least."""
    cpu = {name: timing.cpu_s for name, timing in timings.items()}
    return {
        "reader_speedup": round(cpu["plain_text"] / cpu["frame"], 1),
        "reader_speedup_binary": round(cpu["plain_binary"] / cpu["frame"], 1),
        "reader_speedup_opv2v": round(cpu["plain_text"] / cpu["frame_opv2v"], 1),
        "frames_per_s": round(1 / timings["frame"].wall_s, 1),
        "batch_s": round(cpu["batch_dsrc"], 3),
        "batch_plain_s": round(cpu["batch_plain"], 3),
        "batch_wall_s": round(timings["batch_dsrc"].wall_s, 3),
        **{f"{name}_ms": round(1e3 * timing.wall_s, 1) for name, timing in timings.items() if "stage" in name},
    }


def main(quick: bool = False) -> None:
    """Time reading and batches: tables for people, then one line of JSON.

    Args:
        quick: fewer samples.
    """
    console = Console(width=100, highlight=False)
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        ours, theirs = write_trees(Path(folder))
        check_same(ours, theirs)
        variants = variants_of(ours, theirs)
        rounds, keep = (4, 2) if quick else (9, 4)
        timings = measure(variants, rounds=rounds, keep=keep, sample_s=0.0)
    show(console, timings)
    ready = timings["batch_dsrc"].cpu_s
    console.print(
        f"A worker of DSRC's training has a batch ready every {ready:.2f} s, four every {ready / 4:.2f} s.\n"
        f"A step on it is {STEP_TFLOP} TFLOP: {STEP_TFLOP / 20:.2f} s on a GPU at 20 TFLOP of convolutions a second."
    )
    others = float(np.median([timing.load for timing in timings.values()]))
    facts = {"agents": AGENTS, "points": POINTS, "samples": SAMPLES, "cores": os.cpu_count()}
    print(json.dumps(figures_of(timings) | facts | {"others_load_cores": round(others, 2)}))


if __name__ == "__main__":
    tyro.cli(main)
