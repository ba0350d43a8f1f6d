"""Pedestrians, cyclists and motorcyclists of closed solids."""

from sim.mesh.solids import MeshPart, box, ellipsoid, join, prism, ring, tube

Point = tuple[float, float, float]


def limb(points: list[Point], radii: list[float], material: str) -> list[MeshPart]:
    """Return a limb along its joints, with a ball at each inner joint."""
    parts = [
        tube(a, b, (ra, rb), material, 6)
        for a, b, ra, rb in zip(points[:-1], points[1:], radii[:-1], radii[1:], strict=True)
    ]
    balls = [ellipsoid(p, (r, r, r), material, 0) for p, r in zip(points[1:-1], radii[1:-1], strict=True)]
    return parts + balls


def head(x: float, z: float) -> list[MeshPart]:
    """Return a head with hair, its middle at x and z."""
    return [
        ellipsoid((x + 0.012, 0.0, z - 0.015), (0.095, 0.078, 0.120), "skin"),
        ellipsoid((x - 0.018, 0.0, z + 0.020), (0.092, 0.084, 0.110), "hair"),
    ]


def pedestrian(cloth: str, *, walking: bool) -> MeshPart:
    """Return a person of about 1.75 m in the body frame, in stride or at rest."""
    other = "cloth_dark" if cloth == "cloth_light" else "cloth_light"
    step = 1.0 if walking else 0.0
    # At rest one hand holds a telephone and one foot is in front of the other.
    legs = [
        [(0.0, 0.09, 0.92), (0.14 * step + 0.01, 0.095, 0.50), (0.21 * step + 0.05, 0.10, 0.09)],
        [
            (0.0, -0.09, 0.92),
            (0.02 - 0.02 * step, -0.095, 0.50),
            (-0.25 * step - 0.05, -0.10, 0.13 * step + 0.09 * (1 - step)),
        ],
    ]
    arms = [
        [(0.0, 0.20, 1.42), (-0.10 * step, 0.25, 1.14), (0.22 - 0.30 * step, 0.22, 1.12 - 0.26 * step)],
        [(0.0, -0.20, 1.42), (0.08 * step, -0.25, 1.14), (0.24 * step, -0.24, 0.86 + 0.06 * step)],
    ]
    parts: list[MeshPart] = []
    for leg in legs:
        foot = leg[-1]
        parts += limb(leg, [0.085, 0.062, 0.045], other)
        parts.append(
            box(
                (foot[0] - 0.07, foot[1] - 0.045, foot[2] - 0.09), (foot[0] + 0.19, foot[1] + 0.045, foot[2]), "plastic"
            )
        )
    for arm in arms:
        parts += limb(arm, [0.060, 0.046, 0.038], cloth)
        parts.append(ellipsoid((arm[-1][0] + 0.01, arm[-1][1], arm[-1][2] - 0.05), (0.04, 0.03, 0.07), "skin", 0))
    torso = [
        ellipsoid((0.0, 0.0, 1.22), (0.125, 0.195, 0.33), cloth, 2),
        ellipsoid((0.0, 0.0, 0.95), (0.115, 0.165, 0.15), other),
        tube((0.0, 0.0, 1.46), (0.01, 0.0, 1.60), (0.06, 0.05), "skin", 6),
    ]
    return join([*parts, *torso, *head(0.015, 1.635)])


def rider(
    hip: Point,
    shoulder: Point,
    hand: Point,
    knees: tuple[Point, Point],
    feet: tuple[Point, Point],
    top: str,
    trousers: str,
) -> list[MeshPart]:
    """Return a seated rider: torso from hip to shoulder, both hands on a bar, knees and feet on each side."""
    parts = [
        tube(hip, shoulder, (0.15, 0.19), top, 8),
        ellipsoid(hip, (0.16, 0.17, 0.13), trousers),
        ellipsoid(shoulder, (0.13, 0.20, 0.11), top),
    ]
    for side, knee, foot in zip((1.0, -1.0), knees, feet, strict=True):
        thigh, arm = (hip[0], side * 0.09, hip[2]), (shoulder[0], side * 0.19, shoulder[2])
        parts += limb([thigh, knee, foot], [0.085, 0.062, 0.045], trousers)
        parts.append(
            box(
                (foot[0] - 0.07, foot[1] - 0.045, foot[2] - 0.08), (foot[0] + 0.18, foot[1] + 0.045, foot[2]), "plastic"
            )
        )
        elbow = (0.5 * (arm[0] + hand[0]) - 0.02, side * (abs(hand[1]) + 0.06), 0.5 * (arm[2] + hand[2]) - 0.05)
        parts += limb([arm, elbow, (hand[0], side * abs(hand[1]), hand[2])], [0.055, 0.045, 0.038], top)
        parts.append(ellipsoid((hand[0] + 0.02, side * abs(hand[1]), hand[2]), (0.05, 0.04, 0.04), "skin", 0))
    return parts


def bicycle(cloth: str) -> MeshPart:
    """Return a bicycle with its rider of about 1.75 x 0.6 x 1.75 m in the body frame."""
    radius, front, rear = 0.34, 0.54, -0.52
    crank, seat, steer = (-0.08, 0.0, 0.30), (-0.25, 0.0, 0.92), (0.40, 0.0, 0.88)
    wheels = [ring((x, 0.0, radius), radius, 0.045, "tyre") for x in (front, rear)]
    spokes = [
        tube((x, 0.0, radius - 0.31), (x, 0.0, radius + 0.31), (0.006, 0.006), "metal", 4) for x in (front, rear)
    ] + [tube((x - 0.31, 0.0, radius), (x + 0.31, 0.0, radius), (0.006, 0.006), "metal", 4) for x in (front, rear)]
    bars = [
        (crank, seat), (crank, steer), ((-0.22, 0.0, 0.84), (0.39, 0.0, 0.84)), ((rear, 0.0, radius), crank),
        ((rear, 0.0, radius), (-0.22, 0.0, 0.82)), ((front, 0.0, radius), (0.38, 0.0, 1.02)),
    ]  # fmt: skip
    frame = [tube(a, b, (0.02, 0.02), "metal", 6) for a, b in bars]
    handle = tube((0.36, -0.29, 1.04), (0.36, 0.29, 1.04), (0.018, 0.018), "dark_metal", 6)
    saddle = box((-0.37, -0.07, 0.92), (-0.13, 0.07, 0.97), "plastic")
    trousers = "cloth_dark" if cloth == "cloth_light" else "cloth_light"
    person = rider(
        (-0.24, 0.0, 1.03), (0.02, 0.0, 1.45), (0.34, 0.27, 1.07),
        ((0.16, 0.11, 0.82), (0.10, -0.11, 0.66)), ((0.04, 0.11, 0.46), (-0.20, -0.11, 0.24)), cloth, trousers,
    )  # fmt: skip
    neck = tube((0.02, 0.0, 1.45), (0.08, 0.0, 1.58), (0.06, 0.05), "skin", 6)
    return join([*wheels, *spokes, *frame, handle, saddle, *person, neck, *head(0.08, 1.63)])


def motorcycle(paint: str) -> MeshPart:
    """Return a motorcycle with its rider of about 2.1 x 0.8 x 1.6 m in the body frame."""
    radius, front, rear = 0.32, 0.74, -0.70
    wheels = [tube((x, -0.07, radius), (x, 0.07, radius), (radius, radius), "tyre", 14) for x in (front, rear)]
    hubs = [tube((x, -0.09, radius), (x, 0.09, radius), (0.17, 0.17), "metal", 8) for x in (front, rear)]
    engine = prism([[-0.30, 0.22], [0.28, 0.22], [0.34, 0.52], [-0.34, 0.56]], -0.17, 0.17, "dark_metal")
    tank = prism([[-0.22, 0.60], [0.30, 0.56], [0.40, 0.80], [0.12, 0.96], [-0.16, 0.84]], -0.15, 0.15, paint)
    seat = prism([[-0.92, 0.78], [-0.20, 0.66], [-0.12, 0.80], [-0.40, 0.82], [-0.95, 0.92]], -0.13, 0.13, "plastic")
    fairing = prism([[0.40, 0.70], [0.66, 0.74], [0.62, 0.98], [0.46, 1.14], [0.38, 0.98]], -0.19, 0.19, paint)
    forks = [tube((front, y, radius), (0.46, y, 0.98), (0.03, 0.03), "metal", 6) for y in (-0.11, 0.11)]
    swing = [tube((rear, y, radius), (-0.18, y, 0.42), (0.03, 0.03), "metal", 6) for y in (-0.11, 0.11)]
    exhaust = tube((-0.85, -0.20, 0.42), (0.05, -0.20, 0.26), (0.06, 0.04), "metal", 8)
    handle = tube((0.40, -0.39, 1.02), (0.40, 0.39, 1.02), (0.02, 0.02), "dark_metal", 6)
    lamps = [
        box((0.63, -0.08, 0.80), (0.68, 0.08, 0.92), "head_lamp"),
        box((-0.98, -0.07, 0.82), (-0.94, 0.07, 0.88), "tail_lamp"),
    ]
    plate = box((-0.98, -0.10, 0.60), (-0.965, 0.10, 0.76), "plate")
    person = rider(
        (-0.28, 0.0, 0.93), (-0.02, 0.0, 1.33), (0.38, 0.32, 1.04),
        ((0.12, 0.22, 0.78), (0.12, -0.22, 0.78)), ((-0.18, 0.21, 0.36), (-0.18, -0.21, 0.36)),
        "cloth_dark", "cloth_dark",
    )  # fmt: skip
    helmet = ellipsoid((0.08, 0.0, 1.51), (0.15, 0.13, 0.14), paint)
    visor = ellipsoid((0.13, 0.0, 1.50), (0.115, 0.105, 0.07), "glass")
    parts = [engine, tank, seat, fairing, exhaust, handle, plate, helmet, visor]
    return join([*wheels, *hubs, *forks, *swing, *lamps, *parts, *person])
