"""Bicycles, cargo bikes, scooters and motorcycles with those who ride them."""

from sim.bodies.people import Point, head, rider
from sim.bodies.varied.hulls import hull, pair, post
from sim.mesh.solids import MeshPart, box, ellipsoid, join, prism, ring, tube


def city_bike(top: str, trousers: str, *, load: str = "") -> MeshPart:
    """Return an upright bicycle with its rider, about 1.8 x 0.6 x 1.75 m.

    Args:
        load: `panniers` on the carrier, a `box` of goods on the back, or a `child` seat behind.
    """
    parts = _frame(0.54, -0.52, 0.345)
    hip, shoulder = (-0.26, 0.0, 1.03), (-0.06, 0.0, 1.50)
    parts += rider(
        hip,
        shoulder,
        (0.28, 0.26, 1.10),
        ((0.16, 0.11, 0.82), (0.08, -0.11, 0.66)),
        ((0.04, 0.11, 0.44), (-0.20, -0.11, 0.22)),
        top,
        trousers,
    )
    parts += [tube((-0.06, 0.0, 1.5), (-0.02, 0.0, 1.62), (0.06, 0.05), "skin", 6), *head(-0.02, 1.66)]
    parts += [
        box((-0.82, -0.06, 0.70), (-0.40, 0.06, 0.74), "metal"),
        box((-0.86, -0.04, 0.66), (-0.82, 0.04, 0.73), "tail_lamp"),
    ]
    if load == "panniers":
        parts += pair((-0.80, 0.06, 0.36), (-0.44, 0.20, 0.72), "tarpaulin_blue")
    elif load == "box":
        parts.append(box((-0.62, -0.22, 1.12), (-0.24, 0.22, 1.56), "tarpaulin"))
    elif load == "child":
        parts += [
            box((-0.78, -0.16, 0.76), (-0.46, 0.16, 0.84), "plastic"),
            box((-0.80, -0.16, 0.80), (-0.74, 0.16, 1.25), "plastic"),
            ellipsoid((-0.62, 0.0, 1.02), (0.11, 0.14, 0.22), "cloth_red"),
            ellipsoid((-0.60, 0.0, 1.33), (0.11, 0.10, 0.12), "solid_blue"),
            *pair((-0.60, 0.08, 0.62), (-0.44, 0.16, 0.84), "cloth_denim"),
        ]
    return join(parts)


def racing_bike(top: str, trousers: str) -> MeshPart:
    """Return a racing bicycle with its rider bent low, about 1.7 x 0.5 x 1.5 m."""
    parts = _frame(0.52, -0.49, 0.335, bar=0.20)
    parts += rider(
        (-0.24, 0.0, 1.02),
        (0.22, 0.0, 1.30),
        (0.50, 0.20, 0.95),
        ((0.18, 0.11, 0.84), (0.06, -0.11, 0.62)),
        ((0.05, 0.11, 0.42), (-0.18, -0.11, 0.20)),
        top,
        trousers,
    )
    helmet = ellipsoid((0.40, 0.0, 1.43), (0.14, 0.09, 0.10), "solid_white")
    return join([*parts, *head(0.40, 1.38), helmet])


def cargo_bike(top: str, trousers: str, *, cover: bool = False) -> MeshPart:
    """Return a cargo bike with its box in front, empty or under a cover, about 2.55 x 0.7 x 1.7 m."""
    radius = 0.30
    parts = [ring((-0.98, 0.0, 0.335), 0.335, 0.05, "tyre"), ring((1.24, 0.0, 0.25), 0.25, 0.05, "tyre")]
    parts += [
        post(a, b, "metal", 0.028)
        for a, b in (
            ((-0.98, 0.0, 0.335), (-0.46, 0.0, 0.32)),
            ((-0.46, 0.0, 0.32), (-0.64, 0.0, 0.92)),
            ((-0.46, 0.0, 0.32), (-0.06, 0.0, 0.30)),
            ((-0.98, 0.0, 0.335), (-0.62, 0.0, 0.82)),
            ((-0.06, 0.0, radius), (-0.12, 0.0, 1.08)),
            ((-0.06, 0.0, radius), (1.24, 0.0, 0.25)),
        )
    ]
    low, high = 0.30, 0.74
    walls = [
        box((0.06, -0.31, low), (1.02, 0.31, low + 0.03), "wood"),
        *pair((0.06, 0.28, low), (1.02, 0.32, high), "wood"),
        box((0.03, -0.32, low), (0.06, 0.32, high + 0.1), "wood"),
        box((1.02, -0.32, low), (1.05, 0.32, high), "wood"),
    ]
    if cover:
        walls.append(
            hull(
                [
                    (0.05, 0.31, high - 0.02, high + 0.2, high + 0.48),
                    (0.75, 0.31, high - 0.02, high + 0.12, high + 0.40),
                    (1.04, 0.31, high - 0.02, high + 0.0, high + 0.04),
                ],
                "tarpaulin",
                0.08,
            )
        )
    parts += [*walls, box((-0.78, -0.08, 0.92), (-0.52, 0.08, 0.97), "plastic")]
    parts.append(tube((-0.14, -0.32, 1.10), (-0.14, 0.32, 1.10), (0.018, 0.018), "dark_metal", 6))
    parts += rider(
        (-0.66, 0.0, 1.04),
        (-0.46, 0.0, 1.50),
        (-0.14, 0.28, 1.12),
        ((-0.26, 0.11, 0.82), (-0.32, -0.11, 0.68)),
        ((-0.38, 0.11, 0.46), (-0.60, -0.11, 0.24)),
        top,
        trousers,
    )
    parts += [tube((-0.46, 0.0, 1.5), (-0.42, 0.0, 1.62), (0.06, 0.05), "skin", 6), *head(-0.42, 1.66)]
    parts.append(box((-0.84, -0.04, 0.84), (-0.78, 0.04, 0.92), "tail_lamp"))
    return join(parts)


def road_motorcycle(paint: str, top: str, *, cases: bool = False) -> MeshPart:
    """Return a motorcycle with its rider, about 2.15 x 0.85 x 1.6 m; with cases and a windshield it is a tourer."""
    radius, front, rear = 0.32, 0.74, -0.72
    engine = hull([(-0.30, 0.15, 0.24, 0.40, 0.56), (0.28, 0.17, 0.22, 0.40, 0.54)], "dark_metal", 0.03)
    tank = hull(
        [(-0.24, 0.09, 0.62, 0.74, 0.82), (0.08, 0.16, 0.58, 0.80, 0.95), (0.38, 0.12, 0.62, 0.76, 0.84)], paint, 0.05
    )
    parts = [
        *(tube((x, -0.07, radius), (x, 0.07, radius), (radius, radius), "tyre", 14) for x in (front, rear)),
        *(tube((x, -0.09, radius), (x, 0.09, radius), (0.17, 0.17), "metal", 8) for x in (front, rear)),
        engine,
        tank,
        prism([[-0.95, 0.80], [-0.20, 0.68], [-0.16, 0.80], [-0.42, 0.84], [-0.98, 0.94]], -0.13, 0.13, "plastic"),
        *(post((front, y, radius), (0.42, y, 1.0), "metal", 0.03) for y in (-0.11, 0.11)),
        *(post((rear, y, radius), (-0.16, y, 0.42), "metal", 0.03) for y in (-0.11, 0.11)),
        tube((-0.92, -0.20, 0.44), (0.02, -0.20, 0.26), (0.06, 0.04), "metal", 8),
        tube((0.36, -0.40, 1.03), (0.36, 0.40, 1.03), (0.02, 0.02), "dark_metal", 6),
        *pair((0.30, 0.36, 1.12), (0.34, 0.46, 1.22), "plastic"),
        box((0.44, -0.09, 0.82), (0.56, 0.09, 1.0), "head_lamp"),
        box((-1.02, -0.07, 0.84), (-0.97, 0.07, 0.91), "tail_lamp"),
        box((-1.01, -0.10, 0.58), (-0.99, 0.10, 0.76), "plate"),
        post((-0.72, 0.0, 0.72), (-1.0, 0.0, 0.66), "plastic", 0.03),
    ]
    if cases:
        parts += pair((-0.98, 0.16, 0.50), (-0.46, 0.42, 0.88), "metal")
        parts += [
            box((-1.06, -0.24, 0.92), (-0.62, 0.24, 1.24), "plastic"),
            prism([[0.50, 0.98], [0.66, 0.98], [0.40, 1.36], [0.36, 1.36]], -0.22, 0.22, "glass"),
            hull([(0.40, 0.22, 0.66, 0.84, 1.0), (0.70, 0.12, 0.74, 0.86, 0.98)], paint, 0.05),
        ]
    parts += _seated(
        (-0.30, 0.0, 0.95), (-0.06, 0.0, 1.38), (0.34, 0.34, 1.05), (0.14, 0.22, 0.76), (-0.16, 0.21, 0.36), top
    )
    return join(parts + _helmet(-0.0, 1.53, paint))


def scooter(paint: str, top: str, *, load: str = "") -> MeshPart:
    """Return a scooter with its rider, about 1.85 x 0.75 x 1.6 m.

    Args:
        load: `box` for goods behind, or `pillion` for a second person.
    """
    radius, front, rear = 0.25, 0.64, -0.62
    parts = [
        *(tube((x, -0.06, radius), (x, 0.06, radius), (radius, radius), "tyre", 12) for x in (front, rear)),
        # Seat and engine behind, a step for the feet, a shield in front.
        hull(
            [(-0.90, 0.10, 0.50, 0.62, 0.74), (-0.55, 0.19, 0.30, 0.55, 0.78), (-0.12, 0.16, 0.28, 0.50, 0.74)],
            paint,
            0.04,
        ),
        box((-0.80, -0.14, 0.74), (-0.10, 0.14, 0.84), "plastic"),
        box((-0.14, -0.16, 0.24), (0.36, 0.16, 0.32), "plastic"),
        hull([(0.34, 0.20, 0.26, 0.60, 0.92), (0.46, 0.12, 0.30, 0.60, 0.98)], paint, 0.08),
        hull([(0.50, 0.07, 0.42, 0.50, 0.56), (0.80, 0.07, 0.38, 0.46, 0.52)], paint, 0.02),
        post((front, 0.0, radius), (0.38, 0.0, 1.02), "dark_metal", 0.04),
        tube((0.34, -0.34, 1.04), (0.34, 0.34, 1.04), (0.018, 0.018), "dark_metal", 6),
        *pair((0.28, 0.28, 1.14), (0.31, 0.37, 1.24), "plastic"),
        box((0.40, -0.09, 0.94), (0.48, 0.09, 1.06), "head_lamp"),
        box((-0.93, -0.08, 0.60), (-0.88, 0.08, 0.68), "tail_lamp"),
        box((-0.94, -0.09, 0.40), (-0.92, 0.09, 0.56), "plate"),
    ]
    hip = -0.22 if load == "pillion" else -0.34
    parts += _seated(
        (hip, 0.0, 0.95), (hip + 0.06, 0.0, 1.42), (0.30, 0.30, 1.06), (0.12, 0.15, 0.80), (0.12, 0.13, 0.42), top
    )
    parts += _helmet(hip + 0.10, 1.56, "solid_white")
    if load == "box":
        parts.append(box((-1.0, -0.23, 0.86), (-0.54, 0.23, 1.30), "solid_red"))
    elif load == "pillion":
        parts += _seated(
            (-0.60, 0.0, 0.98),
            (-0.56, 0.0, 1.42),
            (-0.24, 0.18, 1.06),
            (-0.26, 0.20, 0.82),
            (-0.36, 0.19, 0.42),
            "cloth_white",
        )
        parts.append(_helmet(-0.52, 1.56, "solid_blue")[0])
    return join(parts)


def _frame(front: float, rear: float, radius: float, bar: float = 0.29) -> list[MeshPart]:
    """Return wheels, frame, saddle and handlebar of a bicycle."""
    crank = (-0.08, 0.0, 0.30)
    spokes = [((x - 0.92 * radius, 0.0, radius), (x + 0.92 * radius, 0.0, radius)) for x in (front, rear)]
    spokes += [((x, 0.0, 0.08 * radius), (x, 0.0, 1.92 * radius)) for x in (front, rear)]
    bars = [
        (crank, (-0.25, 0.0, 0.92)),
        (crank, (0.40, 0.0, 0.88)),
        ((-0.22, 0.0, 0.84), (0.39, 0.0, 0.84)),
        ((rear, 0.0, radius), crank),
        ((rear, 0.0, radius), (-0.22, 0.0, 0.82)),
        ((front, 0.0, radius), (0.36, 0.0, 1.04)),
    ]
    return [
        *(ring((x, 0.0, radius), radius, 0.045, "tyre") for x in (front, rear)),
        *(tube(a, b, (0.006, 0.006), "metal", 4) for a, b in spokes),
        *(post(a, b, "metal", 0.02) for a, b in bars),
        tube((0.36, -bar, 1.05), (0.36, bar, 1.05), (0.018, 0.018), "dark_metal", 6),
        box((-0.37, -0.07, 0.92), (-0.13, 0.07, 0.97), "plastic"),
    ]


def _seated(hip: Point, shoulder: Point, hand: Point, knee: Point, foot: Point, top: str) -> list[MeshPart]:
    """Return a rider, the same on both sides."""
    mirrored = [(x, -y, z) for x, y, z in (knee, foot)]
    return rider(hip, shoulder, hand, (knee, mirrored[0]), (foot, mirrored[1]), top, "cloth_black")


def _helmet(x: float, z: float, paint: str) -> list[MeshPart]:
    return [
        ellipsoid((x, 0.0, z), (0.15, 0.13, 0.14), paint),
        ellipsoid((x + 0.05, 0.0, z - 0.01), (0.115, 0.105, 0.07), "glass"),
    ]
