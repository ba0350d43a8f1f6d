"""People on foot: gaits, loads, and what they push."""

from dataclasses import dataclass
from typing import Literal

from sim.bodies.people import Point, head, limb
from sim.bodies.varied.hulls import hull, post
from sim.mesh.solids import MeshPart, box, ellipsoid, join, ring, tube

Load = Literal["", "backpack", "bag", "suitcase", "pram", "umbrella"]


@dataclass(frozen=True, slots=True)
class Gait:
    """Posture of a person of 1.75 m: knees and ankles (x, z) of the left and the right leg, x of the hands, lean.

    Attributes:
        left: knee x, knee z, ankle x, ankle z, m.
        right: likewise.
        hands: x of the left and the right hand, m.
        lean: x of the shoulders ahead of the hips, m.
        elbow: height of the hands, m.
    """

    left: tuple[float, float, float, float]
    right: tuple[float, float, float, float]
    hands: tuple[float, float]
    lean: float = 0.02
    elbow: float = 0.86


GAITS: dict[str, Gait] = {
    "standing": Gait((0.02, 0.50, 0.04, 0.09), (-0.01, 0.50, -0.05, 0.09), (0.02, 0.02), 0.0, 0.80),
    "strolling": Gait((0.10, 0.50, 0.15, 0.09), (0.00, 0.50, -0.16, 0.11), (-0.08, 0.12)),
    "walking": Gait((0.16, 0.51, 0.27, 0.09), (0.01, 0.49, -0.27, 0.14), (-0.18, 0.24), 0.03),
    "passing": Gait((0.02, 0.50, -0.02, 0.09), (0.14, 0.53, -0.08, 0.20), (-0.02, 0.05), 0.03),
    "running": Gait((0.28, 0.60, 0.26, 0.18), (0.02, 0.50, -0.36, 0.34), (-0.20, 0.26), 0.10, 1.10),
}
"""Gaits by name, phases of a step included."""


def person(gait: str, load: Load, top: str, trousers: str) -> MeshPart:
    """Return a person of about 1.75 m in a gait of `GAITS`, carrying or pushing a load."""
    pose = GAITS[gait]
    shoulder_x = pose.lean
    parts: list[MeshPart] = []
    for side, leg in ((1.0, pose.left), (-1.0, pose.right)):
        y, foot = side * 0.09, (leg[2], side * 0.10, leg[3])
        parts += limb([(0.0, y, 0.92), (leg[0], y * 1.05, leg[1]), foot], [0.085, 0.062, 0.045], trousers)
        parts.append(
            box(
                (foot[0] - 0.07, foot[1] - 0.045, foot[2] - 0.09), (foot[0] + 0.19, foot[1] + 0.045, foot[2]), "plastic"
            )
        )
    for side, hand in zip((1.0, -1.0), _hands(pose, load), strict=True):
        shoulder = (shoulder_x, side * 0.20, 1.42)
        elbow = (0.55 * (shoulder[0] + hand[0]) - 0.05, side * 0.25, 0.5 * (1.42 + hand[2]))
        parts += limb([shoulder, elbow, hand], [0.060, 0.046, 0.038], top)
        parts.append(ellipsoid((hand[0] + 0.01, hand[1], hand[2] - 0.04), (0.04, 0.03, 0.07), "skin", 0))
    parts += [
        ellipsoid((0.5 * shoulder_x, 0.0, 1.22), (0.125, 0.195, 0.33), top, 1),
        ellipsoid((0.0, 0.0, 0.95), (0.115, 0.165, 0.15), trousers),
        tube((shoulder_x, 0.0, 1.46), (shoulder_x + 0.02, 0.0, 1.60), (0.06, 0.05), "skin", 6),
        *head(shoulder_x + 0.025, 1.635),
        *_load(load, shoulder_x),
    ]
    return join(parts)


def _hands(pose: Gait, load: Load) -> tuple[Point, Point]:
    """Return where the left and the right hand are."""
    left, right = (pose.hands[0], 0.24, pose.elbow), (pose.hands[1], -0.24, pose.elbow)
    if load == "pram":
        return (0.42, 0.20, 1.02), (0.42, -0.20, 1.02)
    if load == "suitcase":
        return left, (-0.30, -0.24, 0.82)
    if load == "umbrella":
        return left, (0.20, -0.16, 1.25)
    return left, right


def _load(load: Load, x: float) -> list[MeshPart]:
    if load == "backpack":
        return [
            hull(
                [
                    (x - 0.36, 0.12, 1.04, 1.32, 1.46),
                    (x - 0.22, 0.17, 0.96, 1.40, 1.54),
                    (x - 0.06, 0.16, 0.98, 1.40, 1.50),
                ],
                "tarpaulin_blue",
                0.04,
            )
        ]
    if load == "bag":
        return [
            box((-0.20, 0.17, 0.72), (0.20, 0.31, 1.02), "plastic"),
            post((0.0, 0.22, 1.0), (x, -0.06, 1.52), "plastic", 0.02),
        ]
    if load == "suitcase":
        return [
            box((-0.66, -0.36, 0.06), (-0.40, -0.10, 0.66), "solid_grey"),
            post((-0.42, -0.23, 0.64), (-0.32, -0.24, 0.82), "metal", 0.014),
            *(box((a, y, 0.0), (a + 0.06, y + 0.04, 0.07), "tyre") for a in (-0.64, -0.48) for y in (-0.35, -0.15)),
        ]
    if load == "umbrella":
        return [
            post((0.20, -0.16, 1.2), (0.12, -0.06, 2.02), "metal", 0.012),
            tube((0.10, -0.04, 1.84), (0.12, -0.05, 2.05), (0.50, 0.05), "cloth_black", 10),
        ]
    if load == "pram":
        return [
            hull(
                [(0.62, 0.20, 0.52, 0.62, 0.80), (0.80, 0.24, 0.46, 0.70, 0.84), (1.34, 0.22, 0.50, 0.70, 0.78)],
                "cloth_denim",
                0.02,
            ),
            hull([(0.60, 0.20, 0.78, 0.96, 1.06), (0.92, 0.22, 0.80, 1.00, 1.10)], "cloth_denim", 0.06),
            *(ring((a, y, 0.15), 0.15, 0.04, "tyre", 10) for a in (0.70, 1.22) for y in (0.25, -0.25)),
            *(post((0.70, y, 0.15), (1.16, y, 0.56), "metal", 0.015) for y in (0.24, -0.24)),
            *(post((1.22, y, 0.15), (0.42, y, 1.02), "metal", 0.015) for y in (0.23, -0.23)),
            tube((0.42, -0.25, 1.02), (0.42, 0.25, 1.02), (0.018, 0.018), "dark_metal", 6),
        ]
    return []
