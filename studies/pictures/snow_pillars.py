"""What flakes do to a pillar network: snowy clouds are changed bit by bit until it finds the near objects again.

Usage:
    python -m studies.pictures.snow_pillars --data data/dsrc-sim/validation --checkpoint dsrc/checkpoints/small-dsrc.pt
    python -m studies.pictures.snow_pillars --data data/validation --checkpoint detector.pt --docs docs/corruptions.md
"""

import argparse
import copy
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from dsrc.data.drives import open_drives
from dsrc.data.points_in_boxes import points_in_boxes
from dsrc.data.sample import Sample, make_sample
from dsrc.evaluation.metrics.matching import match
from dsrc.models.detector import Detector
from dsrc.models.inputs.batch import collate, pillars_of
from dsrc.models.inputs.lone_points import without_lone_points
from dsrc.models.storage.checkpoint import load_detector
from dsrc.ops.grid import GridSpec
from dsrc.ops.iou import bev_iou
from sensors.corruptions.snow import Snow
from sensors.corruptions.snow import corrupt as snow
from sensors.frame import Frame
from sensors.sweep import SCATTERED, Sweep
from sim.boxes import Boxes
from studies.look import put_table

NEAR_M, IOU = 15.0, 0.5
SEVERITIES = (3, 5)
TALL_M = 1.0
"""Height above the road that only objects and houses reach in clear air."""

_MARK = 2.0
"""Added to the intensity of flakes, which is at most 1, to know them in a sample's clouds."""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """One instant in snow.

    Attributes:
        clear: the sample without snow.
        snowy: the same with it.
        flake: per agent (P,) bool which points of its snowy cloud are flakes.
        road_m: height of the road in the ego LiDAR's frame, m.
    """

    clear: Sample
    snowy: Sample
    flake: tuple[NDArray[np.bool_], ...]
    road_m: float

    @property
    def near(self) -> NDArray[np.bool_]:
        """(N,) true objects within `NEAR_M` of the ego."""
        return np.linalg.norm(self.snowy.boxes.center[:, :2], axis=1) < NEAR_M


Mask = Callable[[Scene, int], NDArray[np.bool_]]
"""(P,) of the points of an agent's snowy cloud, by its row."""
Edit = Callable[[Scene, int], NDArray[np.float32]]
"""The (P, 4) cloud that an agent has instead of its snowy one."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="drives")
    parser.add_argument("--checkpoint", type=Path, required=True, help="detector of pillars")
    parser.add_argument("--frames", type=int, default=6, help="of each drive, evenly spread: %(default)s when left out")
    parser.add_argument("--docs", type=Path, help="document whose tables `snow_pillars` are replaced")
    options = parser.parse_args()
    torch.set_num_threads(1)
    detector = load_detector(options.checkpoint).eval()
    grid = detector.settings.grid
    tested, others = pick(options.data, options.frames)
    scenes = {severity: [scene(frame, severity, grid) for frame in tested] for severity in SEVERITIES}
    count = sum(int(part.near.sum()) for part in scenes[SEVERITIES[0]])
    head = [f"{count} objects within {NEAR_M:g} m, {len(tested)} frames"]
    head += [f"{what}, severity {severity}" for what in ("found, %", "false per frame") for severity in SEVERITIES]
    put_table(options.docs, "snow_pillars/experiments", head, list(experiments(detector, scenes, others)))
    head = ["within 15 m of the ego", "clear", *(f"severity {severity}" for severity in SEVERITIES)]
    put_table(options.docs, "snow_pillars/pillars", head, list(pillars(detector, scenes)))


def pick(data: Path, count: int) -> tuple[list[Frame], list[Frame]]:
    """Return some frames of each drive, evenly spread, and others from between them."""
    drives = open_drives(data)
    places = [np.linspace(0, len(drive) - 1, 2 * count + 3).round().astype(int)[1:-1] for drive in drives]
    tested = [drive.read(int(i)) for drive, place in zip(drives, places, strict=True) for i in place[1::2]]
    others = [drive.read(int(i)) for drive, place in zip(drives, places, strict=True) for i in place[::2]]
    return tested, others


def scene(frame: Frame, severity: int, grid: GridSpec) -> Scene:
    """Let it snow on all agents of a frame."""
    sweeps = [
        _marked(agent.sweep, severity, np.random.default_rng([frame.index, row]))
        for row, agent in enumerate(frame.agents)
    ]
    made, clear = (make_sample(part, None, grid) for part in (frame.with_sweeps(sweeps), frame))
    flake = tuple(cloud[:, 3] >= _MARK for cloud in made.clouds)
    clouds = [
        np.column_stack([c[:, :3], c[:, 3] - _MARK * f]).astype(np.float32)
        for c, f in zip(made.clouds, flake, strict=True)
    ]
    ego = frame.agent(made.agent_ids[0])
    height = float(ego.sweep.world_from_lidar[2, 3] - ego.world_from_body[2, 3])
    return Scene(clear, replace(made, clouds=tuple(clouds)), flake, -height)


def _marked(sweep: Sweep, severity: int, rng: np.random.Generator) -> Sweep:
    out = snow(sweep, Snow.severity(severity), rng)
    return replace(out, intensity=(out.intensity + _MARK * (out.fate == SCATTERED)).astype(np.float32))


def experiments(
    detector: Detector, scenes: dict[int, list[Scene]], others: Sequence[Frame]
) -> Iterator[tuple[str, ...]]:
    """Yield the lines of the table of experiments."""
    grid = detector.settings.grid
    edits: dict[str, Edit] = {
        "clear air": lambda s, row: s.clear.clouds[row],
        "**snow**": lambda s, row: s.snowy.clouds[row],
        "no flakes: surfaces dimmed and lost alone": without(lambda s, row: s.flake[row]),
        "flakes only within true objects' columns": without(lambda s, row: ~within_objects(s, row)),
        "flakes only outside of them": without(within_objects),
        "flakes only in pillars with surfaces": without(lambda s, row: ~beside_surfaces(s, row, grid)),
        "flakes only in pillars without": without(lambda s, row: beside_surfaces(s, row, grid)),
        "flakes of intensity 0": lambda s, row: changed(s, row, 3, 0.0),
        "flakes of the surfaces' mean intensity": lambda s, row: changed(s, row, 3, mean_intensity(s, row)),
        "flakes only below 1 m": without(lambda s, row: height(s, row) >= TALL_M),
        "flakes only above 1 m": without(lambda s, row: height(s, row) < TALL_M),
        "flakes laid down on the road": lambda s, row: changed(s, row, 2, s.road_m),
        "flakes only within 5 m of the ego": without(lambda s, row: reach(s, row) >= 5.0),
        "flakes only beyond 5 m of the ego": without(lambda s, row: reach(s, row) < 5.0),
        "only the ego's flakes": without(lambda s, row: np.full(len(s.flake[row]), row > 0)),
        "only the others' flakes": without(lambda s, row: np.full(len(s.flake[row]), row == 0)),
        "every fourth flake": without(lambda s, row: np.cumsum(s.flake[row]) % 4 > 0),
        "pillars of one point dropped": lambda s, row: crowded(s, row, 2, grid),
        "points with few neighbours dropped (DROR)": lambda s, row: without_lone_points(s.snowy).clouds[row],
        "the same in clear air": lambda s, row: without_lone_points(s.clear).clouds[row],
    }
    for name, edit in edits.items():
        yield _line(name, [recall(detector, part, edit) for part in scenes.values()])
    normed = {severity: measured_again(detector, [scene(f, severity, grid) for f in others]) for severity in scenes}
    yield _line(
        "norms' statistics measured again in snow, on other frames",
        [recall(normed[severity], part, edits["**snow**"]) for severity, part in scenes.items()],
    )


def _line(name: str, results: Sequence[tuple[float, float]]) -> tuple[str, ...]:
    return name, *(f"{100.0 * found:.0f}" for found, _ in results), *(f"{false:.1f}" for _, false in results)


def recall(detector: Detector, scenes: Iterable[Scene], edit: Edit) -> tuple[float, float]:
    """Return the share of the near objects that are found, and the false detections per frame, far ones included."""
    found, false = [], []
    for part in scenes:
        clouds = tuple(edit(part, row) for row in range(len(part.snowy.clouds)))
        seen = detector.detect(replace(part.snowy, clouds=clouds))
        truth = match(bev_iou(seen.boxes.array, part.snowy.boxes.array), seen.score, IOU).truth
        found.append(np.isin(np.arange(len(part.snowy.boxes)), truth)[part.near])
        false.append(np.count_nonzero(truth < 0))
    return float(np.concatenate(found).mean()), float(np.mean(false))


def without(mask: Mask) -> Edit:
    """Return the edit that takes those flakes away of which the mask holds."""
    return lambda s, row: s.snowy.clouds[row][~(s.flake[row] & mask(s, row))]


def changed(s: Scene, row: int, column: int, value: float) -> NDArray[np.float32]:
    """Return a cloud whose flakes have this value in a column of x, y, z, intensity."""
    cloud = s.snowy.clouds[row].copy()
    cloud[s.flake[row], column] = value
    return cloud


def mean_intensity(s: Scene, row: int) -> float:
    """Return the mean intensity of an agent's surfaces."""
    return float(s.snowy.clouds[row][~s.flake[row], 3].mean())


def height(s: Scene, row: int) -> NDArray[np.float32]:
    """Return (P,) heights above the road of an agent's points, m."""
    return s.snowy.clouds[row][:, 2] - np.float32(s.road_m)


def reach(s: Scene, row: int) -> NDArray[np.float32]:
    """Return (P,) distances of an agent's points from the ego in the plane, m."""
    return np.hypot(*s.snowy.clouds[row][:, :2].T)


def within_objects(s: Scene, row: int) -> NDArray[np.bool_]:
    """Return (P,) whether points lie in, above or below a true box, or a pillar's width beside it."""
    box = s.snowy.boxes.array.copy()
    box[:, 3:5] += 0.8
    box[:, 5] = 100.0
    inside = np.zeros(len(s.flake[row]), bool)
    inside[points_in_boxes(Boxes.from_array(box), s.snowy.clouds[row])[0]] = True
    return inside


def beside_surfaces(s: Scene, row: int, grid: GridSpec) -> NDArray[np.bool_]:
    """Return (P,) whether points lie in a pillar with a point of a surface."""
    cell = pillar_of(s.snowy.clouds[row], grid)
    return np.isin(cell, cell[~s.flake[row]])


def crowded(s: Scene, row: int, least: int, grid: GridSpec) -> NDArray[np.float32]:
    """Return the points of pillars that have at least so many, flakes or not."""
    cell = pillar_of(s.snowy.clouds[row], grid)
    _, place, count = np.unique(cell, return_inverse=True, return_counts=True)
    return s.snowy.clouds[row][count[place] >= least]


def pillar_of(cloud: NDArray[np.float32], grid: GridSpec) -> NDArray[np.int64]:
    """Return (P,) a number for the pillar of each point."""
    column, row = np.floor((cloud[:, :2] - np.float32(grid.range_m[:2])) / np.float32(grid.cell_m)).astype(int).T
    return row * grid.width + column


def measured_again(detector: Detector, scenes: Sequence[Scene], momentum: float = 0.1) -> Detector:
    """Return a copy whose batch norms have their statistics of snowy clouds; weights stay."""
    detector = copy.deepcopy(detector)
    for module in detector.modules():
        if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
            module.train()
            module.momentum = momentum
    with torch.no_grad():
        for part in scenes:
            batch = collate([part.snowy], detector.settings, training=False)
            assert batch.student is not None
            detector(batch.student, batch.layout)
    return detector.eval()


@dataclass(frozen=True, slots=True)
class Look:
    """What the ego's near pillars are in one cloud, means over them or their points.

    Attributes:
        pillars: how many have points.
        tall: share with a point at least `TALL_M` above the road.
        bare: share without a point of a surface.
        offset_m: distance of a point from the mean of its pillar's.
        off: deviations of the encoder's norm that its inputs are off its mean.
        beyond: share of these inputs beyond three deviations.
        feature: norm of a pillar's feature.
        strongest: largest channel of a pillar's feature.
    """

    pillars: float
    tall: float
    bare: float
    offset_m: float
    off: float
    beyond: float
    feature: float
    strongest: float


def pillars(detector: Detector, scenes: dict[int, list[Scene]]) -> Iterator[tuple[str, ...]]:
    """Yield the lines of the table of pillars."""
    first = next(iter(scenes.values()))
    looks = [[look(detector, s, s.clear.clouds[0], np.zeros(len(s.clear.clouds[0]), bool)) for s in first]]
    looks += [[look(detector, s, s.snowy.clouds[0], s.flake[0]) for s in part] for part in scenes.values()]
    for field, name, form in (
        ("pillars", "occupied pillars of the ego's cloud", "{:.0f}"),
        ("tall", "of them with a point above 1 m", "{:.0%}"),
        ("bare", "of them with flakes alone", "{:.0%}"),
        ("offset_m", "points off their pillar's mean, m", "{:.2f}"),
        ("off", "inputs of the encoder's norm off its mean, deviations", "{:.2f}"),
        ("beyond", "inputs beyond three deviations", "{:.1%}"),
        ("feature", "norm of a pillar's feature", "{:.2f}"),
        ("strongest", "its strongest channel", "{:.2f}"),
    ):
        yield name, *(form.format(np.mean([getattr(one, field) for one in part])) for part in looks)
    rows = {"change of the encoder's map at true objects, relative": [0.0], "of the fused map": [0.0]}
    logits: list[float] = []
    for number, part in enumerate(scenes.values()):
        encoded, fused, clear, snowy = (np.array(v) for v in zip(*differences(detector, part), strict=True))
        for name, values in zip(rows, (encoded, fused), strict=True):
            rows[name].append(float(np.median(values)))
        logits += [float(np.median(clear))] * (number == 0) + [float(np.median(snowy))]
    for name, found in rows.items():
        yield name, *(f"{value:.2f}" for value in found)
    yield "median confidence at true objects", *(f"{1.0 / (1.0 + np.exp(-logit)):.2f}" for logit in logits)


@torch.inference_mode()
def look(detector: Detector, s: Scene, cloud: NDArray[np.float32], flake: NDArray[np.bool_]) -> Look:
    """Return what the near pillars of the ego's cloud are."""
    encoder, grid = detector.encoder, detector.settings.grid
    parts = pillars_of([cloud], detector.settings)
    low = torch.tensor(grid.range_m[:2])
    middle = (parts.coords[:, [2, 1]] + 0.5) * grid.cell_m + low
    near = middle.norm(dim=1) < NEAR_M
    number = (parts.coords[:, 1] * grid.width + parts.coords[:, 2]).numpy()
    cell = pillar_of(cloud, grid)
    tall = np.isin(number, cell[cloud[:, 2] - s.road_m >= TALL_M])
    bare = ~np.isin(number, cell[~flake])
    rows = near[parts.pillar]
    augmented = encoder.augment(parts)[rows]
    mean, variance = encoder.norm.running_mean, encoder.norm.running_var
    assert mean is not None
    assert variance is not None
    off = (augmented @ encoder.linear.weight.T - mean).abs() / variance.sqrt()
    feature = encoder.features(parts)[near]
    return Look(
        pillars=int(near.sum()),
        tall=float(tall[near.numpy()].mean()),
        bare=float(bare[near.numpy()].mean()),
        offset_m=float(augmented[:, 4:7].norm(dim=1).mean()),
        off=float(off.mean()),
        beyond=float((off > 3.0).float().mean()),
        feature=float(feature.norm(dim=1).mean()),
        strongest=float(feature.amax(1).mean()),
    )


@torch.inference_mode()
def differences(detector: Detector, scenes: Iterable[Scene]) -> Iterator[tuple[float, float, float, float]]:
    """Yield for each near object how much the encoder's and the fused map change, and its logit, clear and in snow."""
    for s in scenes:
        clear, snowy = (maps(detector, sample) for sample in (s.clear, s.snowy))
        for box in s.snowy.boxes[s.near].array:
            places = [at(box, detector.settings.grid, part) for part in clear]
            changes = [
                float((b[place] - a[place]).norm() / a[place].norm().clamp(min=1e-6))
                for a, b, place in zip(clear[:2], snowy[:2], places[:2], strict=True)
            ]
            yield changes[0], changes[1], float(clear[2][places[2]].max()), float(snowy[2][places[2]].max())


def maps(detector: Detector, sample: Sample) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the ego's map of the encoder, the fused one and the logits, each (C, h, w)."""
    batch = collate([sample], detector.settings, training=False)
    assert batch.student is not None
    output = detector(batch.student, batch.layout)
    return detector.encoder(batch.student)[0], output.fused[0], output.cls[0]


def at(box: NDArray[np.float64], grid: GridSpec, part: torch.Tensor) -> tuple[slice, slice, slice]:
    """Return the cells of a (C, h, w) map within a metre of a box's centre, in each direction."""
    cell = (grid.range_m[3] - grid.range_m[0]) / part.shape[2]
    column, row = ((box[axis] - grid.range_m[axis]) / cell for axis in (0, 1))
    around = [slice(max(int(v - 1.0 / cell), 0), int(v + 1.0 / cell) + 1) for v in (row, column)]
    return slice(None), *around


if __name__ == "__main__":
    main()
