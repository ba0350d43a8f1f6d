"""Reflectance: power, detection and intensity of returns, as tables for all engines.

Symbols: rho reflectivity, theta incidence, R range, alpha extinction of clear air. The power that comes back from a
surface that fills the beam, relative to a white surface hit squarely at the same range:

    diffuse  rho * cos(theta)^0.5           rough road and render fall off slower towards grazing incidence than
                                            Lambert's exponent 1 (Oren and Nayar 1994)
    beads    rho * cos(theta)^0.25          lane paint: half-sunk glass beads send part of the light back
    retro    8 * rho * cos(theta)^0.1       plates, signs and rear reflectors
    glass    max(0, 1 - 256 (1 - cos(theta)))   a mirror: 1 - (theta / 5.1 deg)^2, and nothing beyond, as the light
                                            leaves for elsewhere; dust and what lies behind a pane return nothing
    lacquer rho * cos(theta)                smooth paint below a clear coat: Lambert's law
    flakes  rho * (cos(theta)^0.5 + 16 cos(theta)^27)   metallic lacquer: flakes that lie nearly flat send light back
                                            squarely, aslant little. Chosen after what multi-angle meters (ASTM E2194)
                                            typically read of silver: L* of about 120, 60 and 35 at 15, 45 and 110
                                            degrees from the mirror's direction, twice a sensor's angle of incidence

Where `spec.lacquer` gives a share, vehicles' paint sends back 0.01 * cos(theta), the dust on its clear coat, and this
share of its own power: the coat mirrors the rest away.

A film of water darkens what takes it up, because light is reflected back into the film on its way out (Lekner and
Dorf 1988): rho_wet = (1 - 0.02) * rho * (1 - p) / (1 - p * rho) with p = 0.47; wet beads reflect like the paint below.

A return is detected while power * exp(-2 alpha R) / R^2 is at least that of a target of reflectivity 0.1 at
`spec.range_10_m`.

`spec.intensity_curve` is the scale of a real sensor: what it reports over the intensity of the law, which is
rho_apparent = power * R^2 here. It is applied to points, after the engines, by `reported`.
"""

from dataclasses import dataclass
from functools import lru_cache

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.spec import LidarSpec
from sim.mesh.materials import MATERIALS, Material

CLEAR_AIR_EXTINCTION = 2e-4
"""Extinction of clear air, 1/m: a meteorological range of 15 km."""

COSINE_BINS = 1024
RANGE_BINS = 4096

LIGHT_SPEED = 299_792_458.0

_RETRO_GAIN = 8.0
_FLAKE_GAIN, _FLAKE_POWER = 16.0, 27.0
_MIRROR = COSINE_BINS / 4.0
"""The mirror of a pane ends where a bin does, so that reading the table widens it by nothing."""
_DUST = 0.01
"""Reflectivity of the dust on a clear coat."""
_FILM_REFLECTED, _FILM_KEPT = 0.02, 0.47
_POWER_LAW_M = 10.0
_LEAST_NEED = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Optics:
    """Tables of one sensor, read with linear interpolation.

    Attributes:
        power: (M, COSINE_BINS + 1) float32 returned power of each material over the cosine of incidence in [0, 1].
        need: (RANGE_BINS + 1,) float32 least power that is detected, over the range in [0, reach_m]; positive.
        scale: (RANGE_BINS + 1,) float32: intensity is min(1, power * scale), or scale alone without `of_material`;
            with `spec.intensity_curve` in units of its last knot.
        of_material: whether intensity depends on the surface.
        reach_m: range at the end of the tables.
        gate_m: largest distance between hits of one echo, m.
    """

    power: NDArray[np.float32]
    need: NDArray[np.float32]
    scale: NDArray[np.float32]
    of_material: bool
    reach_m: float
    gate_m: float


@lru_cache(maxsize=32)
def optics_of(spec: LidarSpec, wetness: float = 0.0) -> Optics:
    """Return the tables of a sensor over dry (0) to wet (1) surfaces."""
    cosine = np.linspace(0.0, 1.0, COSINE_BINS + 1)
    distance = np.linspace(0.0, spec.range_max_m, RANGE_BINS + 1)
    clear = np.exp(-2.0 * CLEAR_AIR_EXTINCTION * distance)
    weakest = 0.1 * np.exp(-2.0 * CLEAR_AIR_EXTINCTION * spec.range_10_m) / spec.range_10_m**2
    need = weakest * distance**2 / clear
    scales = {
        "reflectivity": clear,
        "distance": np.exp(-spec.attenuation * distance),
        "power": clear * (_POWER_LAW_M / np.maximum(distance, 1e-3)) ** 2,
    }
    power = [_power_of(material, spec, cosine, wetness) for material in MATERIALS]
    scale = np.minimum(scales[spec.intensity_law], 1e6)
    if spec.intensity_curve is not msgspec.UNSET:
        scale = scale / spec.intensity_curve[-1][0]
    return Optics(
        power=np.stack(power).astype(np.float32),
        need=np.maximum(need, _LEAST_NEED).astype(np.float32),
        scale=scale.astype(np.float32),
        of_material=spec.intensity_law != "distance",
        reach_m=spec.range_max_m,
        gate_m=0.5 * LIGHT_SPEED * spec.pulse_s,
    )


def returned_power(material: Material, cosine: NDArray[np.float64], wetness: float = 0.0) -> NDArray[np.float64]:
    """Return (N,) power from a surface that fills the beam, at (N,) cosines of incidence; see the module."""
    dry = _power(material.finish, material.reflectivity, cosine)
    if wetness == 0.0 or not material.wets:
        return dry
    wet = _power("diffuse", wet_reflectivity(material.reflectivity), cosine)
    return (1.0 - wetness) * dry + wetness * wet


def reported(spec: LidarSpec, intensity: NDArray[np.floating], distance: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return (P,) intensities as the sensor reports them, of (P,) intensities by its law at (P,) ranges, m."""
    if spec.intensity_curve is not msgspec.UNSET:
        law, scale = np.array(spec.intensity_curve).T
        intensity = np.interp(intensity, law, scale).astype(intensity.dtype)
    if spec.intensity_fade_m is not msgspec.UNSET:
        near, far = spec.intensity_fade_m
        intensity = (intensity * np.clip((far - distance) / (far - near), 0.0, 1.0)).astype(intensity.dtype)
    return intensity


def drop_chance(intensity: NDArray[np.float32], spec: LidarSpec) -> NDArray[np.float32]:
    """Return the chance of CARLA's drop-off: linear from zero intensity up to the limit, 0 beyond."""
    if spec.dropoff_intensity_limit <= 0.0:
        return np.zeros_like(intensity)
    share = 1.0 - intensity / np.float32(spec.dropoff_intensity_limit)
    return np.float32(spec.dropoff_zero_intensity) * np.clip(share, 0.0, 1.0)


def wet_reflectivity(reflectivity: float) -> float:
    """Return the reflectivity of a rough surface below a film of water."""
    return (1.0 - _FILM_REFLECTED) * reflectivity * (1.0 - _FILM_KEPT) / (1.0 - _FILM_KEPT * reflectivity)


def _power_of(material: Material, spec: LidarSpec, cosine: NDArray[np.float64], wetness: float) -> NDArray[np.float64]:
    finish = "lacquer" if material.name.startswith("paint_") else material.finish
    if spec.lacquer is msgspec.UNSET or finish not in ("lacquer", "flakes"):
        return returned_power(material, cosine, wetness)
    return _DUST * cosine + spec.lacquer * _power(finish, material.reflectivity, cosine)


def _power(finish: str, reflectivity: float, cosine: NDArray[np.float64]) -> NDArray[np.float64]:
    if finish == "retro":
        return _RETRO_GAIN * reflectivity * cosine**0.1
    if finish == "beads":
        return reflectivity * cosine**0.25
    if finish == "lacquer":
        return reflectivity * cosine
    if finish == "flakes":
        return reflectivity * (cosine**0.5 + _FLAKE_GAIN * cosine**_FLAKE_POWER)
    if finish == "glass":
        return np.maximum(0.0, 1.0 - _MIRROR * (1.0 - cosine))
    return reflectivity * cosine**0.5
