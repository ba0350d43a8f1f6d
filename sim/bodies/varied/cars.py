"""Cars and vans with a cabin behind open windows: rays that pass a pane meet seats, dashboard and the far wall."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sim.bodies.varied.hulls import both, hull, lamps, loft, pair, panel, post, seat, wheels
from sim.mesh.solids import MeshPart, box, join

Glazing = Literal["clear", "privacy", "coated"]


@dataclass(frozen=True, slots=True)
class CarForm:
    """Proportions of a car in m, x from the middle of its length, z from the road.

    Attributes:
        size: length, width over its mirrors, height.
        axles: x of the front and the rear axle.
        wheel: radius of its wheels.
        nose: height of the front edge of its bonnet.
        cowl: x and z of the foot of the windscreen.
        header: x of the front edge of the roof.
        tail: x and z of the rear edge of the roof.
        sill: x and z of the foot of the rear window.
        deck: height of the rear end.
        pillars: x of the pillars behind the front doors and behind the rear doors.
        clearance: height of its floor.
        roof: half width of the roof over that of the body.
        rows: rows of seats.
        closed: sheet metal in place of windows behind the front doors.
        bed: open load bed behind the cabin in place of a boot.
    """

    size: tuple[float, float, float]
    axles: tuple[float, float]
    wheel: float
    nose: float
    cowl: tuple[float, float]
    header: float
    tail: tuple[float, float]
    sill: tuple[float, float]
    deck: float
    pillars: tuple[float, float]
    clearance: float = 0.20
    roof: float = 0.70
    rows: int = 2
    closed: bool = False
    bed: bool = False


FORMS: dict[str, CarForm] = {
    "city_car": CarForm(
        (3.62, 1.74, 1.50), (1.20, -1.20), 0.28, 0.78, (0.98, 0.96), 0.20, (-1.35, 1.46), (-1.72, 0.98), 0.96,
        (-0.35, -1.15), roof=0.72,
    ),
    "hatchback": CarForm(
        (4.20, 1.91, 1.47), (1.26, -1.34), 0.31, 0.72, (0.98, 0.96), 0.18, (-1.50, 1.40), (-1.95, 0.99), 0.95,
        (-0.38, -1.20),
    ),
    "saloon": CarForm(
        (4.70, 1.96, 1.45), (1.48, -1.36), 0.32, 0.70, (1.05, 0.96), 0.28, (-1.12, 1.38), (-1.72, 1.02), 0.98,
        (-0.36, -1.25), 0.18,
    ),
    "estate": CarForm(
        (4.72, 1.96, 1.49), (1.48, -1.34), 0.32, 0.71, (1.06, 0.96), 0.28, (-1.92, 1.43), (-2.24, 1.00), 0.96,
        (-0.36, -1.20), 0.19,
    ),
    "coupe": CarForm(
        (4.45, 1.95, 1.34), (1.40, -1.26), 0.33, 0.66, (0.78, 0.90), -0.05, (-0.90, 1.27), (-1.70, 0.98), 0.94,
        (-0.62, -0.98), 0.15,
    ),
    "small_suv": CarForm(
        (4.22, 1.92, 1.60), (1.28, -1.32), 0.33, 0.86, (1.02, 1.06), 0.25, (-1.62, 1.52), (-1.95, 1.10), 1.06,
        (-0.36, -1.20), 0.24, 0.71,
    ),
    "suv": CarForm(
        (4.66, 2.03, 1.69), (1.40, -1.38), 0.36, 0.92, (1.08, 1.12), 0.32, (-1.80, 1.61), (-2.16, 1.15), 1.10,
        (-0.36, -1.25), 0.26, 0.73,
    ),
    "off_road": CarForm(
        (4.85, 2.08, 1.88), (1.45, -1.42), 0.40, 1.05, (1.02, 1.20), 0.62, (-2.20, 1.84), (-2.32, 1.20), 1.18,
        (-0.32, -1.25), 0.32, 0.86,
    ),
    "people_carrier": CarForm(
        (4.50, 1.97, 1.66), (1.42, -1.38), 0.32, 0.82, (1.25, 1.02), 0.38, (-1.85, 1.58), (-2.12, 1.06), 1.02,
        (-0.22, -1.20), 0.20, 0.76, 3,
    ),
    "pick_up": CarForm(
        (5.30, 2.06, 1.82), (1.72, -1.45), 0.38, 1.00, (1.22, 1.14), 0.62, (-0.80, 1.78), (-0.92, 1.14), 1.10,
        (0.02, -0.78), 0.30, 0.78, bed=True,
    ),
    "small_van": CarForm(
        (4.45, 1.97, 1.84), (1.42, -1.34), 0.31, 0.88, (1.32, 1.06), 0.62, (-2.12, 1.80), (-2.20, 1.08), 0.96,
        (-0.08, -1.25), 0.20, 0.86, 1, closed=True,
    ),
    "family_van": CarForm(
        (4.50, 1.97, 1.82), (1.42, -1.34), 0.31, 0.88, (1.34, 1.06), 0.62, (-2.10, 1.78), (-2.20, 1.08), 0.96,
        (-0.10, -1.20), 0.20, 0.86,
    ),
    "minibus": CarForm(
        (5.15, 2.12, 1.96), (1.62, -1.50), 0.34, 1.00, (1.62, 1.20), 0.90, (-2.42, 1.92), (-2.54, 1.20), 1.06,
        (0.22, -1.05), 0.22, 0.87, 3,
    ),
    "panel_van": CarForm(
        (5.20, 2.12, 2.00), (1.64, -1.52), 0.34, 1.02, (1.66, 1.22), 0.92, (-2.48, 1.95), (-2.57, 1.22), 1.10,
        (0.24, -1.05), 0.22, 0.90, 1, closed=True,
    ),
    "large_van": CarForm(
        (6.10, 2.26, 2.62), (2.08, -1.72), 0.36, 1.12, (2.12, 1.38), 1.30, (-2.96, 2.58), (-3.02, 1.40), 1.20,
        (0.62, -0.90), 0.26, 0.92, 1, closed=True,
    ),
}  # fmt: skip
"""Forms of cars and vans by shape, after common models of each segment."""

_MIRROR_M = 0.07
_ROOF_M, _CURVE_M, _PANE_M = 0.05, 0.05, 0.012


def car(shape: str, paint: str, glazing: Glazing = "clear") -> MeshPart:
    """Return a car or van of `FORMS` in the body frame.

    Windows are openings. Where `glazing` is `privacy`, panes behind the front doors mirror and return nothing
    elsewhere, as tinted ones do; where it is `coated`, the windscreen too, as those with a film against the sun's heat.
    """
    form = FORMS[shape]
    length, width, height = form.size
    half, end, low = 0.5 * width - _MIRROR_M, 0.5 * length, form.clearance
    (cowl_x, cowl_z), (sill_x, sill_z) = form.cowl, form.sill
    front, rear = form.axles
    back = sill_x if form.bed else max(sill_x + 0.05, rear - 0.05) if form.closed else _luggage(form)
    roof, belt, rise = form.roof * half, 0.97 * half, cowl_z - form.nose
    parts = [
        hull(
            [
                (cowl_x - 0.02, half, low, cowl_z - 0.16, cowl_z),
                (front, half, low, form.nose + 0.55 * rise - 0.14, form.nose + 0.75 * rise),
                (end - 0.32, 0.96 * half, low + 0.02, form.nose - 0.06, form.nose + 0.03),
                (end - 0.012, 0.74 * half, low + 0.06, form.nose - 0.22, form.nose - 0.10),
            ],
            paint,
        ),
        *_boot(form, half, back, paint),
        box((back, -half + 0.02, low), (cowl_x, half - 0.02, low + 0.10), "cabin"),
        # Doors, with an inside of trim.
        *both(
            [(back, half, low), (cowl_x, half, low), (cowl_x, belt, cowl_z - 0.03), (back, belt, sill_z - 0.03)],
            0.03,
            paint,
        ),
        *both(
            [
                (back, half - 0.04, low + 0.05),
                (cowl_x, half - 0.04, low + 0.05),
                (cowl_x, belt - 0.05, cowl_z - 0.06),
                (back, belt - 0.05, sill_z - 0.06),
            ],
            0.04,
            "cabin",
        ),
        _dashboard(form, half),
        *_roof(form, half, roof, height, paint),
        *_glass(form, belt, roof, height, glazing, paint),
        *_seats(form, half, back),
        *_mirrors(form, half, width),
        *wheels(form.axles, half + 0.005, form.wheel),
        *lamps(end - 0.012, -end + 0.012, 0.80 * half, (form.nose - 0.10, form.deck - 0.14)),
    ]
    return join(parts)


def _luggage(form: CarForm) -> float:
    """Return x of the back of the last row of seats."""
    return max(form.sill[0] + 0.25, form.axles[1] + 0.10)


def _boot(form: CarForm, half: float, back: float, paint: str) -> list[MeshPart]:
    """Return what closes the body behind the seats: boot, tailgate, or a load bed."""
    end, low, (sill_x, sill_z) = 0.5 * form.size[0], form.clearance, form.sill
    if form.bed:
        floor = low + 0.42
        walls = pair((-end + 0.05, half - 0.07, low), (back - 0.04, half, form.deck), paint)
        return [
            box((-end + 0.02, -half + 0.04, low + 0.1), (back, half - 0.04, floor), "plastic"),
            *walls,
            box((-end + 0.012, -half + 0.01, low + 0.10), (-end + 0.07, half - 0.01, form.deck - 0.01), paint),
            box((back - 0.05, -half, low), (back, half, sill_z), paint),
        ]
    return [
        hull(
            [
                (-end + 0.012, 0.80 * half, low + 0.12, form.deck - 0.16, form.deck - 0.03),
                (-end + 0.22, 0.96 * half, low + 0.04, form.deck - 0.10, form.deck),
                (min(sill_x, back - 0.05), half, low, sill_z - 0.12, sill_z - 0.01),
                (back, half, low, sill_z - 0.12, sill_z - 0.02),
            ],
            paint,
            crease=0.06,
        )
    ]


def _dashboard(form: CarForm, half: float) -> MeshPart:
    x, z = form.cowl
    section = [(x, z - 0.03), (x - 0.42, z - 0.06), (x - 0.46, z - 0.22), (x - 0.30, z - 0.45), (x, z - 0.45)]
    return loft([[(a, y, b) for a, b in section] for y in (-half + 0.1, half - 0.1)], "cabin")


def _roof(form: CarForm, half: float, roof: float, height: float, paint: str) -> list[MeshPart]:
    """Return the roof and its pillars."""
    (cowl_x, cowl_z), (sill_x, sill_z), (tail_x, tail_z) = form.cowl, form.sill, form.tail
    front_z = height - _CURVE_M
    middle = 0.4 * form.header + 0.6 * tail_x if form.closed else 0.6 * form.header + 0.4 * tail_x

    def across(x: float, z: float, wide: float) -> list[tuple[float, float, float]]:
        return [
            (x, -wide, z - _ROOF_M - 0.02),
            (x, wide, z - _ROOF_M - 0.02),
            (x, wide, z - 0.03),
            (x, 0.8 * wide, z),
            (x, -0.8 * wide, z),
            (x, -wide, z - 0.03),
        ]

    sheet = [across(tail_x, tail_z, roof), across(middle, height, roof), across(form.header, front_z, 0.96 * roof)]
    top_x, top_z = tail_x + 0.05, tail_z - 0.06
    parts = [
        loft(sheet, paint),
        # Lining, seen from below.
        loft(
            [
                [(x, -0.9 * roof, z), (x, 0.9 * roof, z), (x, 0.9 * roof, z - 0.01), (x, -0.9 * roof, z - 0.01)]
                for x, z in ((tail_x, tail_z - 0.08), (middle, height - 0.08), (form.header, front_z - 0.08))
            ],
            "cabin",
        ),
    ]
    belt = 0.97 * half
    for side in (1.0, -1.0):
        parts.append(
            post((cowl_x, side * belt * 0.97, cowl_z - 0.03), (form.header, side * roof * 0.94, front_z - 0.05), paint)
        )
        for x in form.pillars[:1] if form.closed else form.pillars:
            share = (x - sill_x) / (cowl_x - sill_x)
            foot = sill_z + share * (cowl_z - sill_z) - 0.04
            parts.append(
                post((x, side * (belt - 0.04), foot), (x, side * (roof - 0.02), _ceiling(form, x) - 0.04), paint)
            )
    # The rearmost pillar is a panel, as wide as the roof's tail leaves room for.
    wide = 0.10 + 0.18 * max(0.0, form.pillars[1] - tail_x - 0.3)
    parts += both(
        [
            (sill_x - 0.02, belt * 0.98, sill_z - 0.05),
            (sill_x + 0.05 + 0.18, belt * 0.98, sill_z - 0.05),
            (top_x + wide, roof, top_z),
            (top_x - 0.04, roof, top_z),
        ],
        0.05,
        paint,
    )
    return parts


def _ceiling(form: CarForm, x: float) -> float:
    """Return the height below the roof or the slope of the rear window, m."""
    ends = [form.sill[0], form.tail[0], form.header, form.cowl[0]]
    return float(np.interp(x, ends, [form.sill[1], form.tail[1], form.size[2] - _CURVE_M, form.cowl[1]])) - _ROOF_M


def _glass(form: CarForm, belt: float, roof: float, height: float, glazing: Glazing, paint: str) -> list[MeshPart]:
    """Return panes that nothing passes, and sheet metal where there are none."""
    (cowl_x, cowl_z), (sill_x, sill_z), (tail_x, tail_z) = form.cowl, form.sill, form.tail
    parts: list[MeshPart] = []
    x, top = form.pillars[0] - 0.03, height - 0.06
    foot = sill_z + (x - sill_x) / (cowl_x - sill_x) * (cowl_z - sill_z) - 0.03
    side = [
        (sill_x + 0.04, belt - 0.01, sill_z - 0.03),
        (x, belt - 0.01, foot),
        (x, roof - 0.01, top),
        (tail_x + 0.02, roof - 0.01, tail_z - 0.05),
    ]
    rear = [
        (sill_x, -belt + 0.08, sill_z - 0.02),
        (sill_x, belt - 0.08, sill_z - 0.02),
        (tail_x, roof - 0.06, tail_z - 0.04),
        (tail_x, -roof + 0.06, tail_z - 0.04),
    ]
    if form.closed:
        parts += both([(a, b + 0.01, c) for a, b, c in side], 0.04, paint)
        parts.append(panel(rear, 0.03, paint))
        # The wall between load and driver.
        parts.append(box((x - 0.06, -roof + 0.02, form.clearance + 0.1), (x - 0.03, roof - 0.02, top - 0.03), "cabin"))
    elif glazing != "clear":
        parts += both(side, _PANE_M, "glass")
        parts.append(panel(rear, _PANE_M, "glass"))
    if glazing == "coated":
        screen = [
            (cowl_x, -belt + 0.08, cowl_z),
            (cowl_x, belt - 0.08, cowl_z),
            (form.header, 0.88 * roof, height - 0.06),
            (form.header, -0.88 * roof, height - 0.06),
        ]
        parts.append(panel(screen, _PANE_M, "glass"))
    return parts


def _seats(form: CarForm, half: float, back: float) -> list[MeshPart]:
    floor = form.clearance + 0.10
    top = form.cowl[1] + 0.16
    width = min(0.52, 0.60 * half)
    first = form.pillars[0] + 0.16
    parts = [piece for side in (1.0, -1.0) for piece in seat(first, side * 0.45 * half, floor, top, width)]
    last = back + 0.22
    for row in range(1, form.rows):
        x = last if form.rows == 2 else first - row * (first - last) / (form.rows - 1)
        parts += seat(x, 0.0, floor, top - 0.04, 1.5 * half, head=False)
        if _ceiling(form, x - 0.22) > top + 0.13:
            parts += pair((x - 0.22, 0.30 * half, top - 0.02), (x - 0.12, 0.30 * half + 0.26, top + 0.13), "seat")
    return parts


def _mirrors(form: CarForm, half: float, width: float) -> list[MeshPart]:
    x, z = form.cowl
    return pair((x - 0.42, half - 0.05, z - 0.02), (x - 0.28, 0.5 * width, z + 0.12), "plastic")
