"""Lorries with bodies and trailers, and buses, behind whose open windows there are seats and the far wall."""

from sim.bodies.varied.hulls import both, hull, loft, pair, panel, post, seat, wheels
from sim.mesh.solids import MeshPart, box, join, prism, tube


def light_lorry(paint: str) -> MeshPart:
    """Return a lorry of up to 7.5 t with a box body, about 7.0 x 2.4 x 3.0 m."""
    return join(
        [
            *_cab(3.50, 1.02, 2.15, 0.42, paint),
            *_chassis(-3.42, 2.3, 0.36, (2.55, -2.0), 1.06),
            *_box_body(-3.5, 1.85, 1.16, 0.80, 3.0, "solid_white"),
            *_rear(-3.5, 1.10, 0.62),
        ]
    )


def box_lorry(paint: str) -> MeshPart:
    """Return a lorry with a box body, about 9.6 x 2.55 x 3.8 m."""
    return join(
        [
            *_cab(4.80, 1.16, 2.85, 0.50, paint, deflector=3.6),
            *_chassis(-4.7, 3.6, 0.50, (3.45, -2.3, -3.6), 1.20),
            *_box_body(-4.8, 3.05, 1.245, 1.05, 3.8, "solid_white"),
            *_rear(-4.8, 1.20, 0.75),
        ]
    )


def tipper(paint: str) -> MeshPart:
    """Return a lorry with an open body of steel, about 8.2 x 2.55 x 3.1 m."""
    low, high = 1.15, 2.45
    walls = pair((-4.0, 1.13, low), (1.9, 1.22, high), "dark_metal")
    ribs = [
        piece for x in (-3.2, -1.6, 0.0, 1.4) for piece in pair((x, 1.21, low), (x + 0.1, 1.26, high), "dark_metal")
    ]
    return join(
        [
            *_cab(4.10, 1.16, 3.05, 0.50, paint),
            *_chassis(-4.0, 2.9, 0.52, (2.75, -1.6, -2.95), 1.20),
            box((-4.05, -1.2, low - 0.08), (1.95, 1.2, low + 0.04), "dark_metal"),
            *walls,
            *ribs,
            box((1.85, -1.2, low), (1.95, 1.2, high + 0.35), "dark_metal"),
            box((-4.08, -1.2, low), (-4.0, 1.2, high - 0.1), "dark_metal"),
            hull(
                [
                    (-3.4, 0.6, low, low + 0.1, low + 0.2),
                    (-1.2, 1.1, low, low + 0.7, low + 1.1),
                    (1.3, 0.7, low, low + 0.3, low + 0.5),
                ],
                "gravel",
                0.4,
            ),
            *_rear(-4.1, 1.20, 0.75),
        ]
    )


def flatbed(paint: str) -> MeshPart:
    """Return a lorry with an open load of timber between low boards, about 7.6 x 2.5 x 2.9 m."""
    floor = 1.05
    return join(
        [
            *_cab(3.80, 1.14, 2.9, 0.48, paint),
            *_chassis(-3.7, 2.6, 0.46, (2.5, -2.2), 1.18),
            box((-3.75, -1.2, floor - 0.1), (1.95, 1.2, floor + 0.02), "wood"),
            *pair((-3.75, 1.2, floor), (1.95, 1.25, floor + 0.42), "metal"),
            box((-3.8, -1.25, floor), (-3.75, 1.25, floor + 0.42), "metal"),
            box((1.9, -1.2, floor), (1.98, 1.2, floor + 1.2), "dark_metal"),
            box((-2.9, -0.95, floor + 0.05), (0.6, 0.25, floor + 0.8), "wood"),
            box((-1.5, 0.35, floor + 0.05), (1.2, 1.05, floor + 0.55), "wood"),
            *_rear(-3.8, 1.18, 0.70),
        ]
    )


def tanker(paint: str) -> MeshPart:
    """Return a lorry with a tank, about 9.4 x 2.5 x 3.3 m."""
    barrel = tube((-4.55, 0.0, 2.0), (2.75, 0.0, 2.0), (1.02, 1.02), "metal", 14)
    return join(
        [
            *_cab(4.70, 1.16, 3.0, 0.50, paint),
            *_chassis(-4.6, 3.5, 0.50, (3.35, -2.2, -3.5), 1.20),
            barrel,
            tube((-4.62, 0.0, 2.0), (-4.5, 0.0, 2.0), (0.7, 1.0), "metal", 14),
            *pair((-4.2, 0.75, 0.95), (2.5, 1.22, 1.08), "dark_metal"),
            *(box((x, -0.3, 3.0), (x + 0.5, 0.3, 3.14), "dark_metal") for x in (-3.2, -1.0, 1.2)),
            *_rear(-4.7, 1.20, 0.75),
        ]
    )


def semi_trailer(paint: str, *, curtain: str = "tarpaulin") -> MeshPart:
    """Return a tractor with a semi-trailer behind it in a straight line, about 16.5 x 2.55 x 4.0 m."""
    front, tail = 8.25, -8.25
    body = box((tail, -1.265, 1.15), (5.4, 1.265, 4.0), curtain)
    rails = pair((tail + 0.02, 1.255, 1.02), (5.38, 1.275, 1.18), "metal")
    guard = pair((-3.2, 1.16, 0.45), (1.9, 1.22, 0.95), "metal")
    legs = pair((2.6, 0.85, 0.25), (2.8, 1.0, 1.1), "dark_metal")
    return join(
        [
            *_cab(front, 1.17, 3.15, 0.50, paint, deflector=3.85, sleeper=2.25),
            box((3.0, -0.45, 0.62), (7.2, 0.45, 0.98), "dark_metal"),
            box((tail + 0.1, -0.55, 0.85), (5.0, 0.55, 1.15), "dark_metal"),
            body,
            *rails,
            *guard,
            *legs,
            box((tail - 0.01, -0.05, 1.2), (tail + 0.02, 0.05, 3.95), "metal"),
            *wheels((6.85, 3.35), 1.20, 0.50, 0.34),
            *wheels((-3.6, -4.91, -6.22), 1.20, 0.48, 0.40),
            *_rear(tail, 1.22, 0.78),
        ]
    )


def midi_bus(paint: str, glazing: str = "clear") -> MeshPart:
    """Return a small city bus of about 9.6 x 2.45 x 3.0 m over its mirrors."""
    return _bus(9.6, 1.16, 3.0, (3.2, -1.9), 0.35, paint, glazing, doors=(3.95, 0.3))


def city_bus(paint: str, glazing: str = "clear") -> MeshPart:
    """Return a low-floor city bus of about 12 x 2.8 x 3.1 m over its mirrors."""
    return _bus(12.0, 1.265, 3.1, (3.3, -2.6), 0.35, paint, glazing, doors=(4.95, 0.4, -4.1))


def coach(paint: str, glazing: str = "clear") -> MeshPart:
    """Return a coach with a high floor, about 12.8 x 2.8 x 3.65 m over its mirrors."""
    return _bus(12.8, 1.265, 3.65, (3.7, -2.3, -3.6), 1.25, paint, glazing, doors=(5.3,))


def _cab(
    front: float, half: float, top: float, wheel: float, paint: str, *, deflector: float = 0.0, sleeper: float = 1.75
) -> list[MeshPart]:
    """Return a cab over its engine from x = `front` back over `sleeper` m, with open windows and two seats."""
    low, belt, rear = 0.38 * wheel + 0.25, 0.35 * wheel + 0.5 * top, front - sleeper
    header = front - 0.16 - 0.06 * top
    roof = [(rear, top - 0.02), (rear, top - 0.14), (header, top - 0.12), (header - 0.05, top - 0.04)]
    parts = [
        # Lower part, from the bumper to the foot of the windscreen.
        prism(
            [
                (front - 0.55, low),
                (front - 0.02, low),
                (front - 0.008, low + 0.3),
                (front - 0.02, belt),
                (front - 0.4, belt),
            ],
            -half,
            half,
            paint,
        ),
        box((rear + 0.06, -half + 0.05, max(low, 0.85)), (front - 0.5, half - 0.05, max(low, 0.85) + 0.12), "cabin"),
        *both(
            [(rear, half, low + 0.35), (front - 0.4, half, low + 0.35), (front - 0.3, half, belt), (rear, half, belt)],
            0.05,
            paint,
        ),
        box((rear, -half, low + 0.35), (rear + 0.06, half, top - 0.1), paint),
        loft([[(x, y, z) for x, z in roof] for y in (-half + 0.03, half - 0.03)], paint),
        *both(
            [
                (rear, half, belt - 0.02),
                (front - 1.15, half, belt - 0.02),
                (front - 1.15, half - 0.04, top - 0.1),
                (rear, half - 0.04, top - 0.1),
            ],
            0.04,
            paint,
        ),
        *(
            post((front - 0.06, y, belt - 0.03), (header - 0.04, y, top - 0.1), paint, 0.06)
            for y in (half - 0.07, -half + 0.07)
        ),
        box((front - 0.75, -half + 0.08, belt - 0.35), (front - 0.15, half - 0.08, belt - 0.06), "cabin"),
        *(p for y in (0.55 * half, -0.55 * half) for p in seat(front - 1.2, y, max(low, 0.9), belt + 0.42, 0.5)),
        *pair((front - 0.45, half, belt + 0.05), (front - 0.30, half + 0.12, belt + 0.62), "plastic"),
        *pair((front - 0.10, half - 0.45, low + 0.12), (front, half - 0.06, low + 0.30), "head_lamp"),
        box((front - 0.03, -0.26, low + 0.02), (front + 0.004, 0.26, low + 0.12), "plate"),
    ]
    if deflector:
        parts.append(
            prism(
                [
                    (rear + 0.1, top - 0.03),
                    (header - 0.2, top - 0.03),
                    (rear + 0.3, deflector),
                    (rear + 0.1, deflector),
                ],
                -half + 0.12,
                half - 0.12,
                paint,
            )
        )
    return parts


def _chassis(rear: float, front: float, wheel: float, axles: tuple[float, ...], half: float) -> list[MeshPart]:
    """Return a frame, its wheels, a tank beside it and a bar under its end."""
    return [
        box((rear + 0.1, -0.45, 1.1 * wheel), (front, 0.45, 1.1 * wheel + 0.30), "dark_metal"),
        box((rear, -half + 0.05, 0.45), (rear + 0.10, half - 0.05, 0.60), "metal"),
        *pair((-0.6, 0.55, 0.50), (0.9, half - 0.02, 1.0), "metal"),
        *wheels(axles, half, wheel, 0.32),
    ]


def _box_body(rear: float, front: float, half: float, low: float, high: float, material: str) -> list[MeshPart]:
    return [
        box((rear + 0.02, -half, low), (front, half, high), material),
        *pair((rear + 0.01, half - 0.01, low - 0.05), (front + 0.005, half + 0.012, low + 0.08), "metal"),
        box((rear + 0.005, -0.03, low), (rear + 0.03, 0.03, high - 0.05), "metal"),
    ]


def _rear(x: float, half: float, z: float) -> list[MeshPart]:
    """Return tail lamps and a plate at the rear end, x."""
    return [
        *pair((x, half - 0.32, z - 0.08), (x + 0.06, half - 0.02, z + 0.08), "tail_lamp"),
        box((x, -0.26, z - 0.06), (x + 0.03, 0.26, z + 0.05), "plate"),
    ]


def _bus(
    length: float,
    half: float,
    height: float,
    axles: tuple[float, ...],
    floor: float,
    paint: str,
    glazing: str,
    *,
    doors: tuple[float, ...],
) -> MeshPart:
    """Return a bus: walls below and above open windows, pillars, rows of seats, doors on its right."""
    end, belt, low = 0.5 * length, floor + 0.85, 0.32
    screen = min(belt - 0.1, 1.25)
    top, edge = height - 0.02, height - 0.55
    wall = half - 0.03
    parts = [
        box((-end + 0.06, -half + 0.03, floor - 0.06), (end - 0.06, half - 0.03, floor), "cabin"),
        # The engine behind and the front below the windscreen.
        prism([(-end + 0.02, 0.42), (-end + 1.1, 0.42), (-end + 1.1, belt), (-end + 0.015, belt)], -half, half, paint),
        prism(
            [
                (end - 0.25, low),
                (end - 0.05, low),
                (end - 0.008, low + 0.4),
                (end - 0.06, screen),
                (end - 0.25, screen),
            ],
            -half + 0.02,
            half - 0.02,
            paint,
        ),
        prism(
            [
                (-end + 0.05, edge),
                (end - 0.28, edge),
                (end - 0.32, top - 0.08),
                (end - 0.45, top - 0.02),
                (-end + 0.15, top),
                (-end + 0.05, top - 0.12),
            ],
            -half + 0.01,
            half - 0.01,
            paint,
        ),
        box((-0.45 * end, -0.7 * half, top - 0.02), (0.15 * end, 0.7 * half, height + 0.12), "solid_white"),
        box((-end + 1.1, -half + 0.1, floor), (-end + 1.2, half - 0.1, belt + 0.15), "cabin"),
        *pair((end - 0.55, half - 0.02, edge - 0.62), (end - 0.40, half + 0.11, edge - 0.05), "plastic"),
        *pair((end - 0.12, half - 0.50, low + 0.15), (end, half - 0.10, low + 0.34), "head_lamp"),
        box((end - 0.03, -0.26, low + 0.02), (end + 0.002, 0.26, low + 0.12), "plate"),
        *pair((-end + 0.006, half - 0.30, 0.75), (-end + 0.08, half - 0.06, 1.15), "tail_lamp"),
        box((-end, -0.26, 0.58), (-end + 0.04, 0.26, 0.69), "plate"),
        *wheels(axles, half + 0.004, 0.48, 0.30),
        *(piece for x in axles for piece in pair((x - 0.52, half - 0.36, 0.5), (x + 0.52, half - 0.05, 1.0), "cabin")),
    ]
    ends = [-end + 0.05, end - 0.06]
    for side in (1.0, -1.0):
        # Doors of glass interrupt the wall on the right.
        gaps = sorted((x - 0.62, x + 0.62) for x in doors) if side < 0.0 else []
        borders = [ends[0], *(x for gap in gaps for x in gap), ends[1]]
        for start, stop in zip(borders[::2], borders[1::2], strict=True):
            y = sorted((side * wall, side * half))
            parts.append(box((start, y[0], 0.34), (stop, y[1], belt), paint))
    count = max(4, round(length / 1.7))
    for k in range(count + 1):
        x = ends[0] + 0.06 + k * (ends[1] - ends[0] - 0.36) / count
        parts += pair((x - 0.04, wall, belt - 0.02), (x + 0.04, half - 0.005, edge + 0.02), "dark_metal")
    for row in range(round((length - 4.2) / 1.15)):
        x = -end + 1.75 + 1.15 * row
        for side in (1.0, -1.0):
            if side > 0.0 or all(abs(x + 0.2 - door) > 0.95 for door in doors):
                parts += seat(x, side * 0.58 * half, floor, floor + 1.12, 0.55 * half, head=False)
    parts += seat(end - 1.5, 0.5 * half, floor, floor + 1.2, 0.5)
    if glazing == "coated":
        parts += [
            box((x, -half + 0.005, belt), (x + 0.5 * (ends[1] - ends[0]) - 0.2, -half + 0.02, edge), "glass")
            for x in (ends[0] + 0.05, ends[0] + 0.5 * (ends[1] - ends[0]))
        ]
        parts += [
            box((x, half - 0.02, belt), (x + 0.5 * (ends[1] - ends[0]) - 0.2, half - 0.005, edge), "glass")
            for x in (ends[0] + 0.05, ends[0] + 0.5 * (ends[1] - ends[0]))
        ]
        parts.append(
            panel(
                [
                    (end - 0.06, -half + 0.1, screen),
                    (end - 0.06, half - 0.1, screen),
                    (end - 0.26, half - 0.1, edge),
                    (end - 0.26, -half + 0.1, edge),
                ],
                0.012,
                "glass",
            )
        )
    return join(parts)
