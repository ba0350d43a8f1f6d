"""Snowflakes as discs in a plane around the sensor, sampled as by Hahner et al. (CVPR 2022).

Snow of s mm/h that falls at v m/s fills the share O = s / (3.6e6 rho v) of the air, rho = 0.1 g/cm^3 relative to water,
and has the flakes of rain at R = (s / (487 rho 0.003 v))^1.5 mm/h, whose diameters are exponential with a rate of
25.5 R^-0.48 per cm (Gunn and Marshall) or 22.9 R^-0.45 (Sekhon and Srivastava). A plane of radius 80 m is filled up to
the share O: centre at sqrt(U(0, R^2)) and pi U(0, 2), diameter d drawn until it is at most 20 mm, height of the cut
h = U(-d/2, d/2), radius of the disc sqrt(d^2 / 4 - h^2); discs over the sensor or over another disc are discarded.

More snow means fewer, larger discs: 40 000 at 0.5 mm/h and 2 m/s, 17 950 at 2.5 mm/h and 1.6 m/s. The samples that the
authors hand out were made otherwise than by their sampler: those of heavy snow have discs of up to 10.4 mm radius.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.published.cloud import RandomSource
from sim.geometry import Array

Law = Literal["gunn", "sekhon"]

RADIUS_M = 80.0
DISCS = 64
"""Number of samples of one snow; each channel of a frame gets its own."""

_DENSITY, _DIAMETER_M = 0.1, 0.003
_LARGEST_M = 0.02
_SEED = 2022

Sampler = Callable[[float, float, float, RandomSource], Array]
"""Sampler of discs: `sampler(goal, rate, radius_m, rng)`, see `draw_discs`."""


def occupancy(snowfall_mm_h: float, fall_speed_mps: float) -> float:
    """Return O, the share of the air, and of the plane, that is snow."""
    return snowfall_mm_h / (3.6e6 * _DENSITY * fall_speed_mps)


def rain_rate(snowfall_mm_h: float, fall_speed_mps: float) -> float:
    """Return the equivalent rain rate R, mm/h."""
    return (snowfall_mm_h / (487.0 * _DENSITY * _DIAMETER_M * fall_speed_mps)) ** 1.5


def size_rate(rain_mm_h: float, law: Law = "gunn") -> float:
    """Return the rate of the exponential law of diameters, 1/m."""
    return 2550.0 * rain_mm_h**-0.48 if law == "gunn" else 2290.0 * rain_mm_h**-0.45


@lru_cache(maxsize=DISCS)
def disc_sample(snowfall_mm_h: float, fall_speed_mps: float, law: Law, index: int) -> Array:
    """Return one sample of a snow, the same in every process; see `sample_discs`."""
    rng = np.random.default_rng(np.random.SeedSequence(_SEED, spawn_key=(index,)))
    rate = size_rate(rain_rate(snowfall_mm_h, fall_speed_mps), law)
    return sample_discs(occupancy(snowfall_mm_h, fall_speed_mps), rate, RADIUS_M, rng)


def sample_discs(
    filled: float, rate: float, radius_m: float, rng: RandomSource, *, draw: Sampler | None = None
) -> Array:
    """Sample discs until they fill their share of the plane.

    Args:
        filled: share of the plane.
        rate: of the exponential law of diameters, 1/m.
        draw: sampler of the discs instead of `draw_discs`.

    Returns:
        (F, 3) x, y and radius, m, in the order of drawing.
    """
    goal = filled * np.pi * radius_m**2
    darts = discs = np.zeros((0, 3))
    area = np.zeros(0)
    while not len(area) or area[-1] < goal:
        darts = np.concatenate(
            [darts, (draw or draw_discs)(goal - (area[-1] if len(area) else 0.0), rate, radius_m, rng)]
        )
        discs = darts[_apart(darts)]
        area = np.cumsum(np.pi * discs[:, 2] ** 2)
    return discs[: int(np.searchsorted(area, goal)) + 1]


def draw_discs(goal: float, rate: float, radius_m: float, rng: RandomSource) -> Array:
    """Draw about as many discs as fill an area: all centres, all diameters, all heights.

    Args:
        goal: area, m^2; the mean area of a disc is pi / (3 rate^2).
        rate: of the exponential law of diameters, 1/m.
    """
    number = int(goal * 3.0 * rate**2 / np.pi) + 16
    reach = np.sqrt(rng.uniform(0.0, radius_m**2, number))
    angle = np.pi * rng.uniform(0.0, 2.0, number)
    diameter = rng.exponential(1.0 / rate, number)
    while (large := diameter > _LARGEST_M).any():
        diameter[large] = rng.exponential(1.0 / rate, int(large.sum()))
    height = rng.uniform(-0.5, 0.5, number) * diameter
    return np.column_stack([reach * np.cos(angle), reach * np.sin(angle), np.sqrt(diameter**2 / 4.0 - height**2)])


def _apart(darts: Array) -> NDArray[np.bool_]:
    """Return (N,) mask of discs that cover neither the sensor nor an earlier disc that stays."""
    reach = np.hypot(darts[:, 0], darts[:, 1])
    stays = reach > darts[:, 2]
    for first, second in _collisions(darts, reach).tolist():
        if stays[first]:
            stays[second] = False
    return stays


def _collisions(darts: Array, reach: Array) -> NDArray[np.int64]:
    """Return (K, 2) rows of discs that overlap, the earlier one first, by the later one."""
    order = np.argsort(reach)
    place, radius = reach[order], darts[order, 2]
    widest = 2.0 * radius.max(initial=0.0)
    found = [np.zeros((0, 2), np.int64)]
    for step in range(1, len(darts)):
        apart = place[step:] - place[:-step]
        if apart.min() >= widest:
            break
        near = np.flatnonzero(apart < radius[step:] + radius[:-step])
        one, other = order[near], order[near + step]
        gap = np.hypot(*(darts[one, :2] - darts[other, :2]).T) - darts[one, 2] - darts[other, 2]
        found.append(np.sort(np.column_stack([one, other])[gap < 0.0], axis=1))
    pairs = np.concatenate(found)
    return pairs[np.argsort(pairs[:, 1], kind="stable")]
