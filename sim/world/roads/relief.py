"""Relief: seeded smooth heights of the land, no steeper and no more curved than the streets of real places.

Bounds, as these sources are commonly quoted; their texts were not at hand: RASt 06 (FGSV, Richtlinien für die Anlage
von Stadtstraßen) allows streets of a town 8 %, 12 % where the land asks for it, and crests of 250 m radius; RAA (FGSV,
Richtlinien für die Anlage von Autobahnen) motorways 4 to 6 % and 3,000 m. A Policy on Geometric Design of Highways and
Streets (AASHTO) has like values: up to 15 % on local streets, 3 to 6 % on freeways.
"""

from dataclasses import dataclass

import numpy as np

from sim.geometry import Array
from sim.streams import Stream, random_generator

_WAVES = 8
"""Few: all crests together are rarely met, and their sum is the bound that holds everywhere."""


@dataclass(frozen=True, slots=True)
class ReliefBounds:
    """What bounds the land of a kind of roads.

    Attributes:
        steepest: range that the largest possible slope of a place is drawn from.
        sharpest: largest possible curvature, 1/m.
        wavelength_m: shortest and longest wave, m.
    """

    steepest: tuple[float, float]
    sharpest: float
    wavelength_m: tuple[float, float]


TOWN = ReliefBounds((0.05, 0.12), 1.0 / 250.0, (100.0, 900.0))
PLOTS = ReliefBounds((0.15, 0.30), 1.0 / 12.0, (25.0, 80.0))
"""Of plots and verges beside the street, some decimetres above and below it: no source but looking at streets."""
MOTORWAY = ReliefBounds((0.03, 0.06), 1.0 / 3000.0, (500.0, 4000.0))


@dataclass(frozen=True, slots=True, eq=False)
class Relief:
    """Sum of W plane waves.

    Attributes:
        wave: (W, 2) wave vectors, rad/m.
        amplitude: (W,) m.
        phase: (W,) rad.
    """

    wave: Array
    amplitude: Array
    phase: Array

    @property
    def steepest(self) -> float:
        """Bound of the slope everywhere."""
        return float((self.amplitude * np.hypot(*self.wave.T)).sum())

    @property
    def sharpest(self) -> float:
        """Bound of the curvature everywhere, 1/m."""
        return float((self.amplitude * (self.wave**2).sum(axis=1)).sum())

    def height(self, xy: Array) -> Array:
        """Return (N,) heights at (N, 2) positions, m."""
        return np.sin(xy @ self.wave.T + self.phase) @ self.amplitude

    def gradient(self, xy: Array) -> Array:
        """Return (N, 2) slopes along x and y at (N, 2) positions."""
        return (np.cos(xy @ self.wave.T + self.phase) * self.amplitude) @ self.wave


def draw_relief(seed: int, bounds: ReliefBounds, *purpose: str) -> Relief:
    """Draw the relief of a place; all its waves are equally steep."""
    rng = random_generator(seed, Stream.RELIEF, *purpose)
    shortest, longest = bounds.wavelength_m
    length = shortest * (longest / shortest) ** rng.uniform(size=_WAVES)
    turn = rng.uniform(0.0, 2.0 * np.pi, _WAVES)
    number = 2.0 * np.pi / length
    slope = float(rng.uniform(*bounds.steepest)) / _WAVES
    slope *= min(1.0, bounds.sharpest / float((slope * number).sum()))
    wave = number[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    return Relief(wave, slope / number, rng.uniform(0.0, 2.0 * np.pi, _WAVES))
