"""Wet ground: a film of water darkens the road and reflects grazing light away.

| severity                               | 1    | 2    | 3    | 4    | 5    |
|----------------------------------------|------|------|------|------|------|
| water, mm                              | 0.1  | 0.3  | 0.6  | 1.2  | 2.5  |
| share of the surface under the film    | 0.15 | 0.39 | 0.63 | 0.86 | 0.98 |

Under the film a ground of reflectivity rho returns, relative to when it was dry and seen at incidence theta,

    film(theta) = wet(rho) / rho * (T(theta) / T(0))^2 * exp(-2 k h / cos(theta_w))

wet(rho) is the film's darkening (Lekner and Dorf 1988, `sensors.optics.reflectance`), T Fresnel's transmission of
unpolarised light from air into water, once in and once out: 0.98 seen squarely, 0.65 at 80 degrees, 0.28 at 87; the
rest is mirrored away. k = 6.8 per metre is the absorption of water at 905 nm (Hale and Querry 1973), theta_w the angle
inside. Beads of lane paint do not work under water. The film covers 1 - exp(-h / 0.6 mm) of a road whose texture is 1.2
mm deep (assumed: exponentially distributed heights; Hahner 2022 takes h / 1.2 mm), and the return is

    i' = i (1 - share + share film(theta)),

never brighter. Returns below the sensor's detection threshold are lost; intensities already below it are lost with the
same probability (see `medium`). Ground points are those of a ground material, or for files without materials those of
the plane below the sensor (`ground`). Level 5 is the depth at which tyres aquaplane; Robo3D's three levels are 0.2, 1.0
and 1.2 mm.
"""

from dataclasses import replace
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.ground import Ground, find_ground
from sensors.corruptions.physics.levels import WeatherSettings
from sensors.corruptions.physics.receiver import DEFAULT_REFLECTIVITY, detection_threshold, target_power
from sensors.optics.reflectance import returned_power, wet_reflectivity
from sensors.sweep import ATTENUATED, KEPT, UNKNOWN_MATERIAL, Sweep
from sim.mesh.materials import MATERIALS

WATER_INDEX = 1.33 / 1.0003
"""Refractive index of water against air."""

_ABSORPTION_PER_MM = 0.0068
_TEXTURE_MM = 1.2
_BINS = 2048
_REFLECTIVITY = np.linspace(0.02, 1.0, 99)
_DARKENED = np.array([wet_reflectivity(rho) / rho for rho in _REFLECTIVITY.tolist()])


class WetGround(WeatherSettings, frozen=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        water_mm: height of the water, mm.
        texture_mm: depth of the road's texture, mm.
        range_10_m: see `LidarSpec`; None for what `receiver` takes, infinity for one that detects everything.
    """

    LEVELS: ClassVar = {"water_mm": (0.1, 0.3, 0.6, 1.2, 2.5)}
    STRENGTH: ClassVar = ("water_mm",)
    RANGES: ClassVar = {"water_mm": (0.0, 100.0), "texture_mm": (0.01, 100.0)}

    water_mm: float = 0.6
    texture_mm: float = _TEXTURE_MM
    range_10_m: float | None = None


def corrupt(sweep: Sweep, wet: WetGround, rng: np.random.Generator) -> Sweep:
    """Dim or remove the points on the ground; the others are unchanged, in order."""
    chance = rng.random(len(sweep))
    if wet.water_mm == 0.0 or len(sweep) == 0:
        return sweep
    ground = find_ground(sweep)
    rows = ground.rows
    if len(rows) == 0:
        return sweep
    on = sweep[rows]
    square = np.einsum("gi,gi->g", on.points, on.points).astype(np.float64)
    power = target_power(on, np.sqrt(square))
    share = 1.0 - np.exp(-wet.water_mm / (0.5 * wet.texture_mm))
    left = 1.0 - share * (1.0 - _under_film(on, ground, power * square, wet.water_mm))
    threshold = detection_threshold(sweep.spec, wet.range_10_m)
    seen = np.where(power < threshold, left > chance[rows], power * left >= threshold)

    intensity, fate = sweep.intensity.copy(), sweep.fate.copy()
    intensity[rows] *= left
    fate[rows[on.fate == KEPT]] = ATTENUATED
    wetted = replace(sweep, intensity=intensity, fate=fate)
    if seen.all():
        return wetted
    kept = np.ones(len(sweep), bool)
    kept[rows[~seen]] = False
    return wetted[kept]


def transmission(cosine: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the transmission of unpolarised light from air into water (Fresnel).

    Args:
        cosine: of the angle of incidence, in [0, 1].
    """
    inside = _cosine_inside(cosine)
    across = ((cosine - WATER_INDEX * inside) / (cosine + WATER_INDEX * inside)) ** 2
    along = ((WATER_INDEX * cosine - inside) / (WATER_INDEX * cosine + inside)) ** 2
    return np.asarray(1.0 - 0.5 * (across + along))


def _cosine_inside(cosine: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.sqrt(1.0 - (1.0 - cosine**2) / WATER_INDEX**2))


def _under_film(ground: Sweep, found: Ground, brightness: NDArray[np.float64], water_mm: float) -> NDArray[np.float64]:
    """Return (G,) reflectivity of ground under water, relative to dry ground.

    Args:
        brightness: (G,) returned light of dry ground, relative to a white surface at normal incidence.
        water_mm: height of the water, mm.
    """
    bins = np.minimum((found.cosine * _BINS).astype(np.intp), _BINS - 1)
    darkened = _darkening()[ground.material, bins]
    unknown = np.flatnonzero(ground.material == UNKNOWN_MATERIAL)
    # Inverse of the diffuse law: reflectivity from brightness and incidence.
    rho = np.clip(brightness[unknown] / np.sqrt(_cosines()[bins[unknown]]), _REFLECTIVITY[0], 1.0)
    rho[brightness[unknown] <= 0.0] = DEFAULT_REFLECTIVITY
    darkened[unknown] = np.interp(rho, _REFLECTIVITY, _DARKENED)
    cosine = _cosines()
    passed = (transmission(cosine) / transmission(np.ones(1))) ** 2
    passed *= np.exp(-2.0 * _ABSORPTION_PER_MM * water_mm / _cosine_inside(cosine))
    return np.asarray(darkened * passed[bins])


def _cosines() -> NDArray[np.float64]:
    """Return (_BINS,) cosines of incidence in the middle of the tables' bins."""
    return (np.arange(_BINS) + 0.5) / _BINS


@lru_cache(maxsize=1)
def _darkening() -> NDArray[np.float64]:
    """Return (256, _BINS) reflectivity of each material under water, relative to dry; 1 where unknown."""
    table = np.ones((UNKNOWN_MATERIAL + 1, _BINS))
    for index, material in enumerate(MATERIALS):
        if material.wets:
            table[index] = returned_power(material, _cosines(), 1.0) / returned_power(material, _cosines())
    return table
