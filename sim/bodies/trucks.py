"""Trucks and buses of closed solids."""

from sim.mesh.solids import MeshPart, box, join, prism, tube


def _wheels(axles: tuple[float, ...], half_width: float, radius: float) -> list[MeshPart]:
    """Return a wheel on each side of each axle, standing on the road."""
    return [
        tube([x, y, radius], [x, y + side * 0.32, radius], (radius, radius), "tyre", 14)
        for x in axles
        for side, y in ((1, half_width - 0.34), (-1, -half_width + 0.34))
    ]


def truck(paint: str) -> MeshPart:
    """Return a box truck of about 8.6 x 2.5 x 3.5 m in the body frame."""
    cab = prism(
        [[2.55, 0.45], [4.28, 0.45], [4.30, 1.20], [3.95, 2.45], [3.75, 2.62], [2.55, 2.62]], -1.15, 1.15, paint
    )
    screen = prism([[4.285, 1.30], [4.31, 1.30], [4.01, 2.36], [3.985, 2.36]], -1.0, 1.0, "glass")
    windows = [box([3.05, y, 1.35], [3.85, y + 0.02, 2.20], "glass") for y in (-1.17, 1.15)]
    mirrors = [box([3.95, y, 1.55], [4.07, y + 0.11, 2.10], "plastic") for y in (-1.26, 1.15)]
    deflector = prism([[2.55, 2.62], [3.65, 2.62], [2.60, 3.30], [2.55, 3.30]], -1.05, 1.05, paint)
    load = box([-4.30, -1.25, 0.95], [2.40, 1.25, 3.50], "paint_white" if paint != "paint_white" else "paint_silver")
    frame = box([-4.10, -0.45, 0.60], [2.60, 0.45, 0.95], "dark_metal")
    skirts = [box([-1.6, y, 0.40], [1.4, y + 0.05, 0.95], "metal") for y in (-1.20, 1.15)]
    bumper = box([-4.28, -1.15, 0.42], [-4.16, 1.15, 0.58], "metal")
    lamps = [box([-4.29, y, 0.62], [-4.24, y + 0.30, 0.76], "tail_lamp") for y in (-1.10, 0.80)]
    front = [box([4.27, y, 0.62], [4.32, y + 0.34, 0.82], "head_lamp") for y in (-1.08, 0.74)]
    plates = [
        box([-4.295, -0.26, 0.64], [-4.275, 0.26, 0.75], "plate"),
        box([4.30, -0.26, 0.52], [4.32, 0.26, 0.60], "plate"),
    ]
    wheels = _wheels((3.15, -2.15, -3.35), 1.22, 0.48)
    return join(
        [cab, screen, *windows, *mirrors, deflector, load, frame, *skirts, bumper, *lamps, *front, *plates, *wheels]
    )


def bus(paint: str) -> MeshPart:
    """Return a city bus of about 12 x 2.55 x 3.1 m in the body frame."""
    outline = [
        [-5.95, 0.32],
        [5.85, 0.32],
        [5.98, 0.75],
        [5.98, 1.15],
        [5.78, 2.70],
        [5.60, 2.86],
        [-5.80, 2.86],
        [-5.95, 2.70],
    ]
    body = prism(outline, -1.25, 1.25, paint)
    screen = prism([[5.97, 1.20], [6.00, 1.20], [5.81, 2.60], [5.78, 2.60]], -1.12, 1.12, "glass")
    rear = box([-5.97, -1.0, 1.60], [-5.94, 1.0, 2.45], "glass")
    panes = [
        box([x, y, 1.20], [x + 1.42, y + 0.015, 2.40], "glass")
        for x in (-5.5, -3.98, -2.46, -0.94, 0.58, 2.10, 3.62)
        for y in (-1.262, 1.247)
    ]
    doors = [box([x, -1.265, 0.42], [x + 1.25, -1.248, 2.42], "glass") for x in (-0.85, 4.20)]
    mirrors = [box([5.60, y, 2.05], [5.85, y + 0.06, 2.50], "plastic") for y in (-1.275, 1.215)]
    top = box([-3.8, -0.85, 2.86], [1.6, 0.85, 3.10], "paint_white")
    lamps = [box([-5.98, y, 0.80], [-5.94, y + 0.28, 1.20], "tail_lamp") for y in (-1.18, 0.90)]
    front = [box([5.95, y, 0.55], [6.0, y + 0.36, 0.75], "head_lamp") for y in (-1.12, 0.76)]
    plates = [
        box([-5.985, -0.26, 0.60], [-5.945, 0.26, 0.71], "plate"),
        box([5.97, -0.26, 0.40], [6.0, 0.26, 0.51], "plate"),
    ]
    wheels = _wheels((3.55, -2.70), 1.28, 0.48)
    return join([body, screen, rear, *panes, *doors, *mirrors, top, *lamps, *front, *plates, *wheels])
