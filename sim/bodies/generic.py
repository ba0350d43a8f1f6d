"""Generic cars and vans of closed solids, which need no files of other packages."""

from sim.mesh.solids import MeshPart, box, join, prism, tube


def saloon(paint: str) -> MeshPart:
    """Return a saloon of about 4.6 x 1.8 x 1.45 m in the body frame."""
    body = prism(
        [[-2.26, 0.22], [2.22, 0.22], [2.30, 0.45], [2.24, 0.66], [1.05, 0.88], [-1.65, 0.92], [-2.28, 0.88]],
        -0.90,
        0.90,
        paint,
    )
    cabin = prism([[-1.72, 0.86], [1.10, 0.84], [0.38, 1.43], [-0.95, 1.45]], -0.72, 0.72, paint)
    screens = [
        prism([[1.13, 0.86], [1.15, 0.88], [0.44, 1.41], [0.40, 1.41]], -0.62, 0.62, "glass"),
        prism([[-1.74, 0.90], [-1.70, 0.88], [-0.99, 1.41], [-1.03, 1.42]], -0.62, 0.62, "glass"),
    ]
    panes = [
        prism([[-1.32, 0.93], [0.82, 0.93], [0.30, 1.36], [-0.88, 1.36]], y, y + 0.02, "glass") for y in (-0.74, 0.72)
    ]
    return join([body, cabin, *screens, *panes, *_trim(2.30, 0.90, 0.66), *_wheels((1.36, -1.34), 0.90, 0.31)])


def hatchback(paint: str) -> MeshPart:
    """Return a hatchback of about 4.1 x 1.75 x 1.5 m in the body frame."""
    body = prism(
        [[-2.00, 0.24], [1.98, 0.24], [2.05, 0.46], [1.98, 0.68], [0.95, 0.92], [-1.98, 0.95], [-2.05, 0.60]],
        -0.87,
        0.87,
        paint,
    )
    cabin = prism([[-1.96, 0.90], [1.02, 0.88], [0.30, 1.48], [-1.40, 1.50]], -0.71, 0.71, paint)
    screens = [
        prism([[1.05, 0.90], [1.07, 0.92], [0.36, 1.46], [0.32, 1.46]], -0.61, 0.61, "glass"),
        prism([[-1.98, 0.98], [-1.93, 0.96], [-1.46, 1.44], [-1.50, 1.46]], -0.60, 0.60, "glass"),
    ]
    panes = [
        prism([[-1.60, 0.97], [0.72, 0.97], [0.22, 1.41], [-1.32, 1.41]], y, y + 0.02, "glass") for y in (-0.73, 0.71)
    ]
    return join([body, cabin, *screens, *panes, *_trim(2.05, 0.87, 0.68), *_wheels((1.25, -1.22), 0.87, 0.30)])


def panel_van(paint: str) -> MeshPart:
    """Return a van of about 5.3 x 2.0 x 2.1 m in the body frame."""
    body = prism(
        [[-2.62, 0.28], [2.58, 0.28], [2.66, 0.52], [2.60, 0.95], [-2.66, 0.95]],
        -0.98,
        0.98,
        paint,
    )
    load = prism([[-2.64, 0.92], [2.05, 0.92], [1.30, 1.95], [1.05, 2.06], [-2.50, 2.10]], -0.94, 0.94, paint)
    bonnet = prism([[1.95, 0.90], [2.58, 0.90], [2.52, 1.02], [1.98, 1.18]], -0.90, 0.90, paint)
    screen = prism([[2.04, 1.00], [2.08, 1.02], [1.37, 1.92], [1.32, 1.92]], -0.80, 0.80, "glass")
    rear = [box([-2.60, y, 1.25], [-2.57, y + 0.55, 1.80], "glass") for y in (-0.70, 0.15)]
    panes = [
        prism([[0.55, 1.12], [1.72, 1.12], [1.28, 1.76], [0.55, 1.76]], y, y + 0.02, "glass") for y in (-0.96, 0.94)
    ]
    return join(
        [body, load, bonnet, screen, *rear, *panes, *_trim(2.66, 0.98, 0.80), *_wheels((1.62, -1.58), 0.98, 0.33)]
    )


def _wheels(axles: tuple[float, ...], half_width: float, radius: float) -> list[MeshPart]:
    return [
        tube([x, y, radius], [x, y + 0.22, radius], (radius, radius), "tyre", 14)
        for x in axles
        for y in (half_width - 0.21, -half_width - 0.01)
    ]


def _trim(half_length: float, half_width: float, lamps_at: float) -> list[MeshPart]:
    """Return lamps, plates and mirrors; front lamps lie lower, as bonnets do."""
    parts = []
    for side in (-1.0, 1.0):
        outer, inner = side * (half_width - 0.08), side * (half_width - 0.42)
        low, high = min(outer, inner), max(outer, inner)
        parts.append(
            box([half_length - 0.16, low, lamps_at - 0.16], [half_length - 0.02, high, lamps_at - 0.04], "head_lamp")
        )
        parts.append(
            box([-half_length - 0.01, low, lamps_at], [-half_length + 0.06, high, lamps_at + 0.14], "tail_lamp")
        )
        mirror = side * half_width
        parts.append(
            box(
                [0.62, min(mirror, mirror + 0.1 * side), 0.90],
                [0.76, max(mirror, mirror + 0.1 * side), 1.04],
                "plastic",
            )
        )
    parts.append(box([half_length - 0.04, -0.26, 0.40], [half_length + 0.01, 0.26, 0.51], "plate"))
    parts.append(box([-half_length - 0.01, -0.26, 0.56], [-half_length + 0.03, 0.26, 0.67], "plate"))
    return parts
