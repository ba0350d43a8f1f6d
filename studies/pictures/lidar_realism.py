"""Realism of sweeps of real streets beside published figures: range, returns, points per car.

Usage:
    python -m studies.pictures.lidar_realism --out docs/pictures/lidar
    python -m studies.pictures.lidar_realism --out /tmp/pictures --frames 4 --scenarios braunschweig
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sensors.frame import AgentFrame, Frame
from sensors.presets import get_lidar
from sensors.recording.record import record
from sensors.recording.rig import Rig
from sensors.scan.lidar import scan
from sensors.scan.scene import RayScene
from sensors.spec import LidarSpec
from sensors.sweep import STATIC
from sim.bodies.choice import models_for
from sim.boxes import CLASSES, Boxes
from sim.catalog.load import load_scenario
from sim.geometry import pose_matrix
from sim.mesh.materials import material_index
from sim.traffic.base import Actors
from sim.traffic.sumo.traffic import SumoTraffic
from sim.world.build import build_world
from studies.look import COLORS, FAINT, INK, new_figure, save, style

Array = NDArray[np.float64]

BINS_M = np.array([0.0, 10.0, 20.0, 40.0, 80.0, 120.0])
CAR_M = np.array([10.0, 20.0, 30.0, 40.0, 60.0, 80.0])
CAR_WITHIN = 0.15
"""Relative tolerance of a car's distance."""
GROUND = ("asphalt", "marking", "pavement", "kerb", "gravel", "ground")

KITTI_POINTS = np.array([62_100, 31_964, 21_876, 4_328, 0])
KITTI_GROUND = np.array([53_857, 17_874, 7_463, 1_255, 0])
"""Points of one real sweep in `BINS_M`, all and those on the road plane: frame 000001 of KITTI's object benchmark
(Geiger et al. 2012), HDL-64E S2, counted on the file itself."""
KITTI_FIRED = 133_333
"""1.333 million firings per second at 10 Hz (HDL-64E S2 manual)."""

KITTI_CARS = {
    "000003": [(13.51, -0.98, 4.15, 1.73, 1.57, -3.19, 674)],
    "000007": [
        (25.28, 0.69, 3.20, 1.66, 1.61, 0.02, 182),
        (47.82, 7.43, 3.70, 1.51, 1.40, 3.16, 20),
        (60.79, 4.71, 4.05, 1.66, 1.46, 3.15, 5),
    ],
    "000009": [(24.15, -0.70, 3.20, 1.66, 1.61, -0.09, 215), (68.52, 2.19, 3.37, 1.53, 1.41, 2.96, 1)],
}
"""Unoccluded cars of real frames by number, with the points that MMDetection3D counts in KITTI's boxes: x and
y from the sensor, length, width, height, yaw (m, rad), points."""
KITTI_SENSOR_M = 1.73
"""Height of KITTI's LiDAR above the road, from its page on the set-up."""
HDL = "hdl-64e-s2"


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Counts of S sweeps of one sensor in one scene.

    Attributes:
        label: scene and sensor.
        spec: the sensor.
        points: (S,) points of each sweep.
        answered: (S,) beams of each sweep with at least one point.
        histogram: (S, len(BINS_M) - 1) points over the range, and those of them on the ground.
        ground: likewise.
        fine: (F,) points per sweep over every metre of range.
        car_distance: (N,) distance of each car from each sensor that is near it, horizontal, m.
        car_points: (N,) points that the sensor has on it.
    """

    label: str
    spec: LidarSpec
    points: NDArray[np.int64]
    answered: NDArray[np.int64]
    histogram: NDArray[np.int64]
    ground: NDArray[np.int64]
    fine: Array
    car_distance: Array
    car_points: NDArray[np.int64]

    @property
    def fired(self) -> int:
        """Beams of one sweep."""
        return self.spec.rings * self.spec.columns

    @property
    def returned(self) -> float:
        """Share of the beams with a return."""
        return float(self.answered.mean()) / self.fired


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the picture")
    parser.add_argument("--scenarios", nargs="+", default=["braunschweig", "ingolstadt"], help="scenes")
    parser.add_argument("--sensors", nargs="+", default=["opv2v-64", HDL], help="presets")
    parser.add_argument("--frames", type=int, default=20, help="frames per scene, one a second")
    parser.add_argument("--seed", type=int, default=1, help="of traffic and noise")
    options = parser.parse_args()
    all_measured = [
        measure(frames_of(scenario, spec, options.frames, options.seed), spec, f"{scenario}, {spec.name}")
        for scenario in options.scenarios
        for spec in map(get_lidar, options.sensors)
    ]
    twins = [twin(car) for cars in KITTI_CARS.values() for car in cars]
    print("\n".join([*tables(all_measured), "", *twin_table(twins)]))
    with style():
        path = save(draw(all_measured, twins), options.out / "realism.png")
    print(f"\n{path}  {path.stat().st_size / 1024:.0f} kB")


def frames_of(scenario_name: str, spec: LidarSpec, frames: int, seed: int) -> Iterator[Frame]:
    """Yield the frames of a drive whose vehicles all carry `spec`; roadside units are left out."""
    scenario = load_scenario(scenario_name)
    scenario = msgspec.structs.replace(scenario, agents=msgspec.structs.replace(scenario.agents, roadside=()))
    with SumoTraffic(scenario, seed) as traffic:
        drive = record(traffic, build_world(scenario, seed), scenario, seed, frames, interval_s=1.0)
    yield from replace(drive, rig=Rig(scenario, drive.rig.scene, seed, vehicle_spec=spec))


def measure(frames: Iterator[Frame], spec: LidarSpec, label: str) -> Measured:
    """Count points of all sweeps of some frames; see `Measured`."""
    points, answered, histogram, ground, fine, cars = [], [], [], [], [], []
    road = [material_index(name) for name in GROUND]
    for frame in frames:
        for agent, points_on in zip(frame.agents, frame.points_on, strict=True):
            sweep = agent.sweep
            on_ground = (sweep.object_id == STATIC) & np.isin(sweep.material, road)
            points.append(len(sweep))
            answered.append(len(np.unique(np.stack([sweep.ring, sweep.column]), axis=1).T))
            histogram.append(np.histogram(sweep.range, BINS_M)[0])
            ground.append(np.histogram(sweep.range[on_ground], BINS_M)[0])
            fine.append(np.histogram(sweep.range, np.arange(0.0, BINS_M[-1] + 0.5))[0])
            cars.append(_cars(frame, agent, points_on))
    distance, on_them = np.concatenate(cars).T
    return Measured(
        label=label,
        spec=spec,
        points=np.array(points),
        answered=np.array(answered),
        histogram=np.stack(histogram),
        ground=np.stack(ground),
        fine=np.stack(fine).mean(axis=0),
        car_distance=distance,
        car_points=on_them.astype(np.int64),
    )


def _cars(frame: Frame, agent: AgentFrame, points_on: NDArray[np.int32]) -> Array:
    """Return (N, 2) distance and points of the cars around an agent, its own one left out."""
    truth = frame.truth
    others = (truth.label == CLASSES.index("car")) & (truth.object_id != agent.agent_id)
    offset = truth.center[others, :2] - agent.sweep.world_from_lidar[:2, 3]
    return np.column_stack([np.hypot(*offset.T), points_on[others]])


@dataclass(frozen=True, slots=True)
class Twin:
    """Real car and the same car simulated.

    Attributes:
        distance: from the sensor, horizontal, m.
        real: points that KITTI's sensor has on it.
        simulated: points that ours has on it, by paint.
    """

    distance: float
    real: int
    simulated: dict[str, int]


def twin(car: tuple[float, ...]) -> Twin:
    """Return the points on a car of a real one's box, alone on a flat road, in each paint."""
    x, y, length, width, height, yaw, points = car
    corners = 100.0 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    road = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    scene = RayScene(road)  # asphalt, as it does not say
    pose = pose_matrix([0.0, 0.0, KITTI_SENSOR_M])
    boxes = Boxes.from_array([[x, y, 0.5 * height, length, width, height, yaw]], object_id=[1000])
    still = np.zeros(1)
    simulated = {}
    for model in models_for("car"):
        actors = Actors(
            time_s=0.0,
            boxes=boxes,
            pitch=still,
            velocity=np.zeros((1, 2)),
            acceleration=np.zeros((1, 2)),
            model=(model,),
            name=("car",),
            signals=np.zeros(1, np.int32),
            lane=("",),
        )
        sweep = scan(scene.with_bodies(actors), get_lidar(HDL), pose, pose, 0.0, np.random.default_rng(0))
        simulated[model.partition(":")[2]] = int((sweep.object_id == 1000).sum())
    return Twin(float(np.hypot(x, y)), int(points), simulated)


def twin_table(twins: list[Twin]) -> list[str]:
    """Return the lines of a table in Markdown."""
    twins = sorted(twins, key=lambda pair: pair.distance)
    paints = list(twins[0].simulated)
    lines = [
        f"Points on cars of KITTI, and of {HDL} on a car of the same box alone on a flat road, by paint:",
        "",
        f"| distance | {' | '.join(f'{pair.distance:.1f} m' for pair in twins)} |",
        "|---|" + "---|" * len(twins),
        f"| KITTI, real | {' | '.join(str(pair.real) for pair in twins)} |",
    ]
    lines += [f"| {paint} | {' | '.join(str(pair.simulated[paint]) for pair in twins)} |" for paint in paints]
    return lines


def tables(all_measured: list[Measured]) -> list[str]:
    """Return the lines of three tables in Markdown."""
    names = [f"{low:g}-{high:g} m" for low, high in pairwise(BINS_M)]
    lines = [
        "Points per sweep, share of fired beams that return, share of the points over the range:",
        "",
        f"| scene, sensor | sweeps | points | fired | returns | {' | '.join(names)} |",
        "|---|---|---|---|---|" + "---|" * len(names),
    ]
    for m in all_measured:
        share = m.histogram.sum(axis=0) / m.points.sum()
        lines.append(_row(m.label, len(m.points), f"{m.points.mean():,.0f}", f"{m.fired:,}", m.returned, share))
    kitti = KITTI_POINTS / KITTI_POINTS.sum()
    row = ("1", f"{KITTI_POINTS.sum():,}", f"{KITTI_FIRED:,}", KITTI_POINTS.sum() / KITTI_FIRED)
    lines += [_row("KITTI 000001, real HDL-64E", *row, kitti), ""]

    lines += ["Share of the points that lie on the ground, over the range:", ""]
    lines += [f"| scene, sensor | all | {' | '.join(names)} |", "|---|---|" + "---|" * len(names)]
    with np.errstate(invalid="ignore"):
        for m in all_measured:
            share = m.ground.sum(axis=0) / m.histogram.sum(axis=0)
            lines.append(_row(m.label, m.ground.sum() / m.histogram.sum(), share))
        share = KITTI_GROUND / KITTI_POINTS
    lines += [_row("KITTI 000001, real HDL-64E", KITTI_GROUND.sum() / KITTI_POINTS.sum(), share), ""]

    lines += ["Points per car: median and 90th percentile of those that are hit; share that are hit at all; cars:", ""]
    lines += [f"| scene, sensor | {' | '.join(f'{d:g} m' for d in CAR_M)} |", "|---|" + "---|" * len(CAR_M)]
    for m in all_measured:
        lines.append(f"| {m.label} | {' | '.join(_car_cell(m, distance) for distance in CAR_M)} |")
    for spec in {m.spec.name: m.spec for m in all_measured}.values():
        cells = [f"{in_full_view(spec, distance):,.0f}" for distance in CAR_M]
        lines.append(f"| {spec.name}, geometry of a car in full view | {' | '.join(cells)} |")
    return lines


def in_full_view(spec: LidarSpec, distance: float | Array) -> float | Array:
    """Return the beams on an unoccluded car, averaged over its heading, before any loss.

    Its silhouette is height * (length |sin| + width |cos|), on average 2 / pi * height * (length + width); a beam of
    the densest rings covers one step in azimuth by one in elevation.
    """
    area = 2.0 / np.pi * 1.5 * (4.5 + 1.8)
    step_up = np.median(-np.diff(spec.elevation[spec.elevation > np.radians(-8.0)]))
    step_across = np.radians(spec.azimuth_end_deg - spec.azimuth_start_deg) / spec.columns
    return area / (np.asarray(distance) ** 2 * step_up * step_across)


def _near(m: Measured, distance: float) -> NDArray[np.int64]:
    return m.car_points[np.abs(m.car_distance - distance) <= CAR_WITHIN * distance]


def _car_cell(m: Measured, distance: float) -> str:
    cars = _near(m, distance)
    hit = cars[cars > 0]
    if len(hit) == 0:
        return "-"
    return f"{np.median(hit):.0f}, {np.percentile(hit, 90):.0f} ({len(hit) / len(cars):.0%} of {len(cars)})"


def _row(label: str, *cells: object) -> str:
    texts = []
    for cell in cells:
        values = cell if isinstance(cell, np.ndarray) else [cell]
        texts += [("-" if np.isnan(v) else f"{v:.1%}") if isinstance(v, float) else str(v) for v in values]
    return f"| {label} | {' | '.join(texts)} |"


def draw(all_measured: list[Measured], twins: list[Twin]) -> Figure:
    """Return the picture: points over the range, and points per car over its distance."""
    figure = new_figure(
        11.0,
        4.6,
        "Simulated sweeps of real streets beside a real HDL-64E",
        "KITTI's object benchmark: range of frame 000001 in bins; unhidden cars of frames 000003, 000007 and 000009;"
        " dotted: beams on a car in full view",
    )
    left, right = figure.subplots(1, 2)
    for m, color in zip(all_measured, COLORS, strict=False):
        dashes = (None, None) if m.spec.name == all_measured[0].spec.name else (3, 1.5)
        left.plot(np.arange(len(m.fine)) + 0.5, m.fine / m.points.mean(), color=color, dashes=dashes, label=m.label)
        _car_curve(right, m, color, dashes)
    shares = KITTI_POINTS / KITTI_POINTS.sum() / np.diff(BINS_M)
    left.stairs(shares[:4], BINS_M[:5], color=INK, linewidth=1.6, label="KITTI 000001 (real)")
    left.set(
        yscale="log", ylim=(1e-5, 0.3), xlim=(0, BINS_M[-1]), xlabel="range, m", ylabel="share of the points per m"
    )
    left.set_title("Histogram of range")
    real = [(pair.distance, pair.real) for pair in twins]
    right.scatter(*zip(*real, strict=True), marker="*", s=70, c=INK, linewidths=0, label="KITTI, real cars", zorder=3)
    distance = np.geomspace(6.0, 100.0, 50)
    for spec in {m.spec.name: m.spec for m in all_measured}.values():
        right.plot(distance, in_full_view(spec, distance), color=FAINT, linewidth=0.8, dashes=(1, 1.5))
    right.set(
        xscale="log", yscale="log", xlim=(8, 100), ylim=(0.7, 5000), xlabel="distance of the car, m", ylabel="points"
    )
    right.set_xticks(CAR_M, [f"{d:g}" for d in CAR_M], minor=False)
    right.set_xticks([], minor=True)
    right.set_title("Points per car that is hit: median, and 90th percentile as dots")
    for axes in (left, right):
        axes.grid(visible=True)
        axes.legend(loc="upper right")
    return figure


def _car_curve(axes: Axes, m: Measured, color: str, dashes: tuple) -> None:
    hit = [cars[cars > 0] for cars in (_near(m, distance) for distance in CAR_M)]
    middle = [np.median(cars) if len(cars) else np.nan for cars in hit]
    many = [np.percentile(cars, 90) if len(cars) else np.nan for cars in hit]
    axes.plot(CAR_M, middle, color=color, dashes=dashes, label=m.label)
    axes.scatter(CAR_M, many, color=color, s=14, linewidths=0)


if __name__ == "__main__":
    main()
