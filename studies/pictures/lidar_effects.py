"""Pictures of the sensor model: shear of passing cars, echoes at an edge, intensity and detection.

Usage:
    python -m studies.pictures.lidar_effects --out docs/pictures/lidar
    python -m studies.pictures.lidar_effects --out /tmp/pictures --only edge
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from sensors.deskew import deskew_objects
from sensors.optics.beams import beams_of
from sensors.optics.reflectance import optics_of, returned_power
from sensors.presets import get_lidar
from sensors.scan.lidar import scan
from sensors.scan.scene import RayScene
from sensors.spec import LidarSpec
from sensors.sweep import STATIC, Sweep
from sim.bodies.choice import models_for
from sim.boxes import Boxes
from sim.geometry import pose_matrix
from sim.mesh.materials import MATERIALS, material_index
from sim.traffic.base import Actors
from studies.look import COLORS, FAINT, GRID, HIGHLIGHT, INK, colorbar, new_figure, save, style


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the pictures")
    parser.add_argument("--only", nargs="+", choices=PICTURES, default=list(PICTURES), help="all when left out")
    options = parser.parse_args()
    for name in options.only:
        path = options.out / f"{name}.png"
        with style():
            save(PICTURES[name](), path)
        print(f"{path}  {path.stat().st_size / 1024:.0f} kB")


# ── shear ────────────────────────────────────────────────────────────────────────────────────────────────────────────

SPEED = 30.0
CARS = np.array([[13.0, 3.5, 0.0], [0.0, 7.0, np.pi], [1.0, -7.0, 0.0], [-14.0, 0.0, 0.0]])
"""Rows of x, y and yaw around a sensor at the origin."""


def shear() -> Figure:
    """Four cars at 30 m/s around a sensor at rest: as measured, and deskewed."""
    spec = msgspec.structs.replace(get_lidar("opv2v-64"), dropoff_rate=0.0, dropoff_zero_intensity=0.0)
    actors = _cars()
    scene = RayScene(_sheet(60.0, "asphalt", height=0.0)).with_bodies(actors)
    pose = pose_matrix([0.0, 0.0, 1.9])
    sweep = scan(scene, spec, pose, pose, 0.0, np.random.default_rng(0))
    cars = sweep[sweep.object_id != STATIC]
    whole = deskew_objects(cars, actors.boxes.object_id, scene.bodies.path)
    figure = new_figure(
        11.0,
        3.9,
        "Rolling shutter: a car is sheared by its speed times the time of firing",
        "opv2v-64 at the triangle; its turn of 0.1 s starts and ends behind it; cars at 30 m/s and their true boxes at"
        " the reference time",
    )
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, points, title in (
        (panels[0], cars, "As measured"),
        (panels[1], whole, "Put together by deskew_objects"),
    ):
        _cars_from_above(axes, actors, points)
        axes.set_title(title)
    panels[0].set_ylabel("y, m")
    texts = ("0 ms: in its box", "+25 ms: 0.75 m on", "−25 ms: 0.75 m back", "−50 and +50 ms: torn by 3 m")
    for (x, y, _), text in zip(CARS, texts, strict=True):
        panels[0].annotate(text, (max(x, -12.2), y + 1.7), ha="center", fontsize=8, color=INK)
    colorbar(panels[1], Normalize(-50.0, 50.0), "coolwarm", "time offset, ms", (-50, -25, 0, 25, 50))
    return figure


def _cars() -> Actors:
    size = np.array([4.5, 1.8, 1.5])
    n = len(CARS)
    table = np.column_stack([CARS[:, :2], np.full(n, 0.5 * size[2]), np.tile(size, (n, 1)), CARS[:, 2]])
    velocity = SPEED * np.stack([np.cos(CARS[:, 2]), np.sin(CARS[:, 2])], axis=1)
    boxes = Boxes.from_array(table, object_id=1000 + np.arange(n))
    model = (models_for("car")[0],) * n
    return Actors(
        time_s=0.0,
        boxes=boxes,
        pitch=np.zeros(n),
        velocity=velocity,
        acceleration=np.zeros((n, 2)),
        model=model,
        name=("car",) * n,
        signals=np.zeros(n, np.int32),
        lane=("",) * n,
    )


def _cars_from_above(axes: Axes, actors: Actors, cars: Sweep) -> None:
    look = {"cmap": "coolwarm", "vmin": -50.0, "vmax": 50.0, "s": 2.2, "linewidths": 0}
    axes.scatter(cars.points[:, 0], cars.points[:, 1], c=1000.0 * cars.time_offset, **look)
    for outline in actors.boxes.bev_polygons():
        axes.fill(*outline.T, fill=False, edgecolor=INK, linewidth=0.9)
    for (x, y, _), v in zip(CARS, actors.velocity, strict=True):
        ahead = 2.9 * np.sign(v[0])
        axes.annotate(
            "", (x + 1.8 * ahead, y), (x + ahead, y), arrowprops={"arrowstyle": "->", "color": FAINT, "linewidth": 1.0}
        )
    axes.scatter([0.0], [0.0], marker=">", s=40, c=HIGHLIGHT, linewidths=0)
    axes.set(aspect="equal", xlim=(-20.0, 20.0), ylim=(-10.0, 11.0), xlabel="x, m")
    axes.grid(visible=True)


# ── edge ─────────────────────────────────────────────────────────────────────────────────────────────────────────────

LEAF_M = 10.0
COLUMNS_SHOWN = range(6, 11)
BEHIND_M = (14.0, 10.9)
"""Walls behind the leaf: farther than the pulse resolves, and nearer."""


def edge() -> Figure:
    """Edge of a leaf before a wall: sub-rays on it, and the returns."""
    spec = _edge_spec()
    figure = new_figure(
        11.0,
        5.0,
        "Sub-rays at the edge of a leaf: two returns, or one in between",
        "leaf at 10 m, plaster wall behind it; 8 sub-rays, divergence 3 mrad, dual returns; pulse 10 ns: echoes within"
        " 1.5 m are one. Colour: surface reported; area and number: intensity",
    )
    grid = figure.add_gridspec(2, 2, width_ratios=(1.0, 2.3))
    _footprints(figure.add_subplot(grid[:, 0]), spec)
    for place, behind in enumerate(BEHIND_M):
        _echoes(figure.add_subplot(grid[place, 1]), spec, behind)
    return figure


def _edge_spec() -> LidarSpec:
    return LidarSpec(
        name="edge",
        elevation_deg=(0.0,),
        columns=16,
        azimuth_start_deg=-0.44,
        azimuth_end_deg=0.44,
        clockwise=True,  # columns from left to right
        range_noise_m=0.0,
        subrays=8,
        returns="dual",
        intensity_law="reflectivity",
    )


def _footprints(axes: Axes, spec: LidarSpec) -> None:
    """Draw the beams around the edge where they pass the leaf, one above the other."""
    beams = beams_of(spec, 0.0)
    width, apart = 1000.0 * LEAF_M * spec.divergence_rad, 36.0
    axes.axvspan(-40.0, 0.0, color="#547F3E", alpha=0.35, linewidth=0)
    for place, column in enumerate(COLUMNS_SHOWN):
        rays = LEAF_M * beams.subray[:, :, 0, column] / beams.subray[:, :1, 0, column]
        across, up = -1000.0 * rays[:, 1], 1000.0 * rays[:, 2] - place * apart
        axes.add_patch(
            Ellipse((across.mean(), -place * apart), width, width, fill=False, edgecolor=FAINT, linewidth=0.8)
        )
        axes.scatter(across, up, s=14, c=np.where(across < 0.0, COLORS[2], COLORS[1]), linewidths=0)
    axes.annotate("leaf", (-38.0, 22.0), fontsize=9, color=COLORS[2])
    axes.annotate("past it", (38.0, 22.0), fontsize=9, color=COLORS[1], ha="right")
    axes.set_yticks([-place * apart for place in range(len(COLUMNS_SHOWN))], [str(c) for c in COLUMNS_SHOWN])
    axes.set(xlim=(-40.0, 40.0), ylim=(-(len(COLUMNS_SHOWN) - 0.45) * apart, 34.0), aspect="equal")
    axes.set(xlabel="to the right at 10 m, mm", ylabel="column")
    axes.set_title("Sub-rays and 1/e² circles")


def _echoes(axes: Axes, spec: LidarSpec, behind: float) -> None:
    """Draw the returns over the columns; their area is their intensity."""
    leaf = _panel(LEAF_M, (0.0, 1.0), "leaves")
    wall = _panel(behind, (-3.0, 3.0), "plaster")
    pose = pose_matrix([0.0, 0.0, 0.0])
    sweep = scan(RayScene(_joined([leaf, wall])), spec, pose, pose, 0.0, np.random.default_rng(0))
    on_leaf = sweep.material == material_index("leaves")
    for rows, color, label in ((on_leaf, COLORS[2], "leaf"), (~on_leaf, COLORS[1], "wall")):
        axes.scatter(
            sweep.column[rows], sweep.range[rows], s=260.0 * sweep.intensity[rows], c=color, label=label, linewidths=0
        )
        for column, distance, intensity in zip(
            sweep.column[rows], sweep.range[rows], sweep.intensity[rows], strict=True
        ):
            axes.annotate(
                f"{intensity:.2f}".lstrip("0"), (column, distance), (0, 10), textcoords="offset points", ha="center",
                fontsize=6.5, color=INK,
            )  # fmt: skip
    apart = behind - LEAF_M
    axes.set(xlim=(-0.7, spec.columns - 0.3), ylim=(LEAF_M - 0.18 * apart, behind + 0.3 * apart))
    axes.set(xlabel="column", ylabel="range, m")
    axes.set_title(f"Wall {apart:.1f} m behind the leaf: {'two returns' if apart > 1.5 else 'one return in between'}")
    axes.grid(visible=True)


# ── intensity ────────────────────────────────────────────────────────────────────────────────────────────────────────

SHOWN = ("plate", "marking", "plaster", "brick", "asphalt", "paint_black", "glass")


def intensity() -> Figure:
    """Returned power over incidence, margin over range, and the three laws of intensity."""
    spec = get_lidar("hdl-64e-s2")
    figure = new_figure(
        11.0,
        4.6,
        "Intensity and detection",
        "power relative to a white surface hit squarely; a return is detected while its margin is at least 1;"
        " dashed: under a film of water",
    )
    panels = figure.subplots(1, 3)
    _over_incidence(panels[0])
    _over_range(panels[1], spec)
    _laws(panels[2], spec)
    for axes in panels:
        axes.grid(visible=True)
        axes.tick_params(color=GRID)
    return figure


def _over_incidence(axes: Axes) -> None:
    angle = np.linspace(0.0, 89.5, 600)
    cosine = np.cos(np.radians(angle))
    for name, color in zip(SHOWN, COLORS, strict=True):
        material = MATERIALS[material_index(name)]
        axes.plot(angle, returned_power(material, cosine), color=color, label=name)
        if material.wets:
            axes.plot(angle, returned_power(material, cosine, wetness=1.0), color=color, dashes=(3, 2), linewidth=1.0)
    axes.set(yscale="log", xlim=(0, 90), ylim=(1e-3, 10), xlabel="angle of incidence, degrees", ylabel="power")
    axes.set_title("Over incidence")
    axes.legend(loc="lower left", ncols=2, columnspacing=1.0, handlelength=1.2)


def _over_range(axes: Axes, spec: LidarSpec) -> None:
    optics = optics_of(spec)
    distance = np.linspace(2.0, spec.range_max_m, 500)
    need = np.interp(distance, np.linspace(0.0, optics.reach_m, len(optics.need)), optics.need)
    squarely = np.ones_like(distance)
    for name, color in zip(SHOWN, COLORS, strict=True):
        if name != "asphalt":
            power = returned_power(MATERIALS[material_index(name)], squarely)
            axes.plot(distance, power / need, color=color)
    above = spec.mount_xyz_m[2]
    road = np.minimum(1.0, above / distance)
    asphalt = MATERIALS[material_index("asphalt")]
    color = COLORS[SHOWN.index("asphalt")]
    axes.plot(distance, returned_power(asphalt, road) / need, color=color)
    axes.plot(distance, returned_power(asphalt, road, wetness=1.0) / need, color=color, dashes=(3, 2), linewidth=1.0)
    axes.axhspan(1e-3, 1.0, color="black", alpha=0.45, linewidth=0)
    axes.annotate("not detected", (0.97, 0.03), xycoords="axes fraction", ha="right", fontsize=8, color=FAINT)
    axes.set(yscale="log", xlim=(0, spec.range_max_m), ylim=(0.1, 1e4), xlabel="range, m", ylabel="margin")
    axes.set_title(f"Margin of {spec.name}: hit squarely,\nasphalt from {above:g} m above it")


def _laws(axes: Axes, spec: LidarSpec) -> None:
    distance = np.linspace(1.0, spec.range_max_m, 500)
    plaster = returned_power(MATERIALS[material_index("plaster")], np.ones(1))[0]
    for law, dashes in (("reflectivity", ()), ("power", (3, 2)), ("distance", (1, 1))):
        optics = optics_of(msgspec.structs.replace(spec, intensity_law=law))
        scale = np.interp(distance, np.linspace(0.0, optics.reach_m, len(optics.scale)), optics.scale)
        value = np.minimum(1.0, (plaster if optics.of_material else 1.0) * scale)
        axes.plot(distance, value, color=COLORS[SHOWN.index("plaster")], dashes=dashes or (None, None), label=law)
    axes.set(xlim=(0, spec.range_max_m), ylim=(0, 1.05), xlabel="range, m", ylabel="intensity")
    axes.set_title("The three laws, plaster hit squarely")
    axes.legend(loc="upper right", bbox_to_anchor=(1.0, 0.48), handlelength=2.4)


# ── triangles ────────────────────────────────────────────────────────────────────────────────────────────────────────


def _sheet(half: float, material: str, height: float) -> trimesh.Trimesh:
    corners = [[-half, -half, height], [half, -half, height], [half, half, height], [-half, half, height]]
    return _painted(corners, material)


def _panel(x: float, y: tuple[float, float], material: str) -> trimesh.Trimesh:
    """Return an upright panel across the x axis."""
    return _painted([[x, y[0], -1.0], [x, y[1], -1.0], [x, y[1], 1.0], [x, y[0], 1.0]], material)


def _painted(corners: list[list[float]], material: str) -> trimesh.Trimesh:
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    mesh.face_attributes["material"] = np.full(2, material_index(material), np.uint8)
    return mesh


def _joined(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    whole = trimesh.util.concatenate(meshes)
    whole.face_attributes["material"] = np.concatenate([mesh.face_attributes["material"] for mesh in meshes])
    return whole


PICTURES: dict[str, Callable[[], Figure]] = {"shear": shear, "edge": edge, "intensity": intensity}


if __name__ == "__main__":
    main()
