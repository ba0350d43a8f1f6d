"""Small things beside the road: signs, delineators, poles, bins, cabinets, bollards, benches, bicycles, bus stops.

Each stands at the origin; x is the way along the road, the road lies on the right (-y).
"""

import numpy as np

from sim.mesh.solids import MeshPart, box, join, move, ring, tube


def sign(rng: np.random.Generator) -> MeshPart:
    """Return a road sign: plates of 600 mm across or 900 mm, 2.0 to 2.3 m above the ground (VwV-StVO to §39)."""
    low = float(rng.uniform(2.0, 2.3))
    wide, tall = [(0.6, 0.6), (0.9, 0.8), (0.6, 0.9), (0.42, 0.42)][int(rng.integers(4))]
    parts = [tube([0.0, 0.0, -0.2], [0.0, 0.0, low + tall], (0.038, 0.038), "metal", 6)]
    parts.append(box([-0.06, -0.5 * wide, low], [-0.045, 0.5 * wide, low + tall], "sign"))
    return join(parts)


def place_name(rng: np.random.Generator) -> MeshPart:
    """Return a large board on two posts, 1.0 to 2.5 m wide (StVO 310, 418)."""
    wide, tall = float(rng.uniform(1.0, 2.5)), float(rng.uniform(0.6, 1.2))
    low = float(rng.uniform(1.0, 1.8))
    feet = [
        tube([0.0, side * 0.4 * wide, -0.2], [0.0, side * 0.4 * wide, low + tall], (0.05, 0.05), "metal", 5)
        for side in (-1.0, 1.0)
    ]
    return join([*feet, box([-0.08, -0.5 * wide, low], [-0.06, 0.5 * wide, low + tall], "sign")])


def delineator(rng: np.random.Generator) -> MeshPart:
    """Return a delineator: 1.05 m high, 0.12 m wide, with a reflector of 0.04 x 0.18 m (RAL, RPS; StVO 620)."""
    body = box([-0.05, -0.06, -0.2], [0.05, 0.06, 1.05], "paint_white")
    return join([body, box([-0.06, -0.02, 0.72], [-0.05, 0.02, 0.90], "plate")])


def pole(rng: np.random.Generator) -> MeshPart:
    """Return a wooden pole of a line with its arm, 7 to 9 m high and 0.2 m thick (DIN EN 14229)."""
    top = float(rng.uniform(7.0, 9.0))
    post = tube([0.0, 0.0, -0.3], [0.0, 0.0, top], (0.13, 0.09), "bark", 7)
    return join([post, box([-0.06, -0.8, top - 0.5], [0.06, 0.8, top - 0.38], "bark")])


def bins(rng: np.random.Generator) -> MeshPart:
    """Return one to four wheeled bins of 120 to 240 l: 0.5 x 0.55 x 0.93 to 0.58 x 0.74 x 1.07 m (EN 840-1)."""
    parts, x = [], 0.0
    for _ in range(int(rng.integers(1, 5))):
        wide, deep, tall = [(0.50, 0.55, 0.93), (0.58, 0.74, 1.07)][int(rng.integers(2))]
        y = float(rng.uniform(-0.1, 0.1)) - 0.5 * deep
        material = ["dark_metal", "plastic", "paint_blue", "paint_yellow"][int(rng.integers(4))]
        parts.append(box([x, y, 0.0], [x + wide, y + deep, tall], material))
        x += wide + float(rng.uniform(0.03, 0.25))
    return move(join(parts), [-0.5 * x, 0.0, 0.0])


def litter_bin(rng: np.random.Generator) -> MeshPart:
    """Return a litter bin of 50 l: 0.4 m across, its rim 0.9 to 1.1 m above the ground."""
    top = float(rng.uniform(0.9, 1.1))
    return tube([0.0, 0.0, 0.1], [0.0, 0.0, top], (0.19, 0.21), "dark_metal", 8)


def cabinet(rng: np.random.Generator) -> MeshPart:
    """Return a cabinet of electricity or telephone, 0.6 to 1.6 m long and 0.8 to 1.6 m high (DIN 43629)."""
    half, tall = 0.5 * float(rng.uniform(0.6, 1.6)), float(rng.uniform(0.8, 1.6))
    return box([-half, -0.18, -0.1], [half, 0.18, tall], ["concrete", "metal"][int(rng.integers(2))])


def bollard(rng: np.random.Generator) -> MeshPart:
    """Return a bollard, 0.9 to 1.0 m high (RASt 06)."""
    return tube([0.0, 0.0, -0.1], [0.0, 0.0, float(rng.uniform(0.9, 1.0))], (0.06, 0.06), "dark_metal", 6)


def bench(rng: np.random.Generator) -> MeshPart:
    """Return a bench that faces the road: 1.8 m long, seat at 0.45 m, back to 0.85 m (DIN 18034-1)."""
    seat = box([-0.9, -0.25, 0.40], [0.9, 0.15, 0.46], "bark")
    back = [box([-0.9, 0.18, z], [0.9, 0.22, z + 0.14], "bark") for z in (0.52, 0.72)]
    legs = [box([x - 0.04, -0.2, -0.1], [x + 0.04, 0.2, 0.40], "concrete") for x in (-0.7, 0.7)]
    return join([seat, *back, *legs])


def planter(rng: np.random.Generator) -> MeshPart:
    """Return the tub of a plant: 0.5 to 1.0 m across, 0.45 to 0.6 m high."""
    half, tall = 0.5 * float(rng.uniform(0.5, 1.0)), float(rng.uniform(0.45, 0.6))
    return box([-half, -half, -0.1], [half, half, tall], "concrete")


def bicycles(rng: np.random.Generator) -> MeshPart:
    """Return two to six bicycles at stands 0.7 to 1.0 m apart, across the way (ADFC, Hinweise zum Fahrradparken)."""
    parts, count = [], int(rng.integers(2, 7))
    every = float(rng.uniform(0.7, 1.0))
    for number in range(count):
        x = (number - 0.5 * (count - 1)) * every
        parts.append(move(_bicycle(rng), [x, 0.0, 0.0], 0.5 * np.pi + float(rng.normal(0.0, 0.12))))
        parts.append(tube([x + 0.25, -0.4, -0.1], [x + 0.25, -0.4, 0.8], (0.025, 0.025), "metal", 4))
    return join(parts)


def _bicycle(rng: np.random.Generator) -> MeshPart:
    """Return a bicycle along x: wheels of 0.7 m, 1.05 m apart, 1.0 m high (DIN 79000: at most 1.9 m long)."""
    wheels = [ring([x, 0.0, 0.34], 0.34, 0.045, "tyre", 8) for x in (-0.53, 0.53)]
    frame = [
        tube([-0.53, 0.0, 0.34], [-0.2, 0.0, 0.85], (0.02, 0.02), "paint_red", 3),
        tube([-0.1, 0.0, 0.3], [0.38, 0.0, 0.75], (0.025, 0.025), "paint_red", 3),
        tube([0.53, 0.0, 0.34], [0.36, 0.0, 1.0], (0.02, 0.02), "paint_red", 3),
        box([0.28, -0.28, 0.98], [0.34, 0.28, 1.02], "dark_metal"),
        box([-0.32, -0.07, 0.86], [-0.08, 0.07, 0.93], "plastic"),
    ]
    return join([*wheels, *frame])


def bus_stop(rng: np.random.Generator) -> MeshPart:
    """Return a shelter of 4.0 x 1.5 x 2.5 m with a bench and a flag, open to the road (VDV 4; EAOe 2013)."""
    posts = [
        tube([x, y, -0.2], [x, y, 2.4], (0.04, 0.04), "dark_metal", 4) for x in (-1.9, 0.0, 1.9) for y in (-0.65, 0.65)
    ]
    roof = box([-2.0, -0.8, 2.4], [2.0, 0.8, 2.5], "dark_metal")
    back = box([-1.9, 0.63, 0.3], [1.9, 0.66, 2.2], "glass")
    poster = box([1.87, -0.6, 0.4], [1.93, 0.6, 2.2], "plaster")
    seat = box([-1.2, 0.2, 0.42], [1.2, 0.55, 0.47], "bark")
    legs = [box([x - 0.05, 0.3, -0.1], [x + 0.05, 0.45, 0.42], "metal") for x in (-1.0, 1.0)]
    return join([*posts, roof, back, poster, seat, *legs])
