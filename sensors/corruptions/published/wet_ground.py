"""Wet ground of Hahner et al. (CVPR 2022), as Robo3D uses it too.

A film of water on the road sends most of a pulse away from the sensor. For ground points (see `ground`) at incidence
theta and intensity i, with A(r) 15 times the line of i / cos(theta) over range and N(r) the noise line times a factor:

    rho = i / (cos(theta) A)                  reflectivity, clipped to [0.05, 1] for t only
    t   = max over s, p of T_aw rho T_wa / (1 - rho R_wa)   through the film, off the diffuse ground, and out (Fresnel)
    f   = water / 1.2 mm, in [0, 1]           how much of the pavement's texture is filled
    i'  = A cos(theta) ((1 - f) rho + f t / theta), clipped to [0, i]          lost where i' <= N cos(theta)

with refractive indices 1.0003 and 1.33, and T_wa = T_aw, R_wa = R_aw as at an interface. Intensities are of 0 to 255.

| severity      | 1   | 2   | 3 (Hahner, Robo3D moderate) | 4 (Robo3D heavy) | 5   |
|---------------|-----|-----|-----------------------------|------------------|-----|
| water, mm     | 0.2 | 0.5 | 1.0                         | 1.2              | 1.2 |
| noise factor  | 0.7 | 0.7 | 0.7                         | 0.7              | 1.0 |

1.2 mm fill the pavement, and more water changes nothing here: so CoopDiff's "water" of 1.5 mm, with a noise factor of
0.25, intensities of 0 to 1 and bins from 0 instead of 5, is this kind at 1.2 mm. Robo3D has 0.2, 1.0 and 1.2 mm with
noise factors of 0.2 (KITTI), 0.3, 0.3, 0.7 (SemanticKITTI) and 0.2, 0.3, 0.7 (nuScenes), and takes the ground from
labels for the latter two (`labelled`; here from the points' materials, or the plane below the sensor where they have
none). Both KITTIs have intensities of 0 to 1 (`scale`), of which hardly any reach the noise line's bins, so that its
level is far above all the rest: most ground is lost.

Quirks: the plane is sought in a strip 6 m wide straight ahead (`ground`), so behind a lorry there is none, and nothing
gets wet; t is divided by the angle in radians, not its cosine; thickness and absorption of the film do not matter; with
fewer than 1000 ground points nothing happens. The release puts the ground behind all other points, which is not kept.
"""

from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.corruptions.physics.ground import find_ground
from sensors.corruptions.physics.levels import SeveritySettings
from sensors.corruptions.published.cloud import Cloud, RandomSource, cloud_of, with_cloud
from sensors.corruptions.published.ground import (
    FittedGround,
    fit_plane,
    ground_of,
    intensity_line,
    labelled_ground,
    noise_line,
)
from sensors.sweep import ATTENUATED, KEPT, Sweep
from sim.geometry import Array

PAVEMENT_MM = 1.2
AIR, WATER = 1.0003, 1.33
"""Refractive indices."""

_POWER_FACTOR = 15.0
_REFLECTIVITIES = (0.05, 1.0)
_LEAST_GROUND = 1000


class PaperWetGround(SeveritySettings, frozen=True, kw_only=True):
    """Settings of `corrupt`.

    Attributes:
        water_mm: height of the water.
        noise_factor: of the noise line.
        scale: model intensity of 1 in a sweep.
        labelled: known ground, taken for level (Robo3D), instead of a fitted plane.
    """

    LEVELS: ClassVar = {"water_mm": (0.2, 0.5, 1.0, 1.2, 1.2), "noise_factor": (0.7, 0.7, 0.7, 0.7, 1.0)}
    RANGES: ClassVar = {
        "water_mm": (0.0, 100.0),
        "noise_factor": (0.0, 10.0),
        "scale": (1e-3, 1e6),
    }

    water_mm: float = 1.0
    noise_factor: float = 0.7
    scale: float = 255.0
    labelled: bool = False


PUBLISHED: dict[str, PaperWetGround] = {
    "hahner": PaperWetGround(),
    "robo3d_kitti_light": PaperWetGround(water_mm=0.2, noise_factor=0.2, scale=1.0),
    "robo3d_kitti_moderate": PaperWetGround(water_mm=1.0, noise_factor=0.2, scale=1.0),
    "robo3d_kitti_heavy": PaperWetGround(water_mm=1.2, noise_factor=0.2, scale=1.0),
    "robo3d_semantickitti_light": PaperWetGround(water_mm=0.2, noise_factor=0.3, scale=1.0, labelled=True),
    "robo3d_semantickitti_moderate": PaperWetGround(water_mm=1.0, noise_factor=0.3, scale=1.0, labelled=True),
    "robo3d_semantickitti_heavy": PaperWetGround(water_mm=1.2, noise_factor=0.7, scale=1.0, labelled=True),
    "robo3d_nuscenes_light": PaperWetGround(water_mm=0.2, noise_factor=0.2, labelled=True),
    "robo3d_nuscenes_moderate": PaperWetGround(water_mm=1.0, noise_factor=0.3, labelled=True),
    "robo3d_nuscenes_heavy": PaperWetGround(water_mm=1.2, noise_factor=0.7, labelled=True),
    "coopdiff_water": PaperWetGround(water_mm=1.5, noise_factor=0.25, scale=1.0),
}


class WetCloud(NamedTuple):
    """A cloud on wet ground.

    Attributes:
        intensity: (P,) of all points of the input.
        ground: (P,) mask of ground points.
        kept: (P,) mask of points that are not lost.
    """

    intensity: Array
    ground: NDArray[np.bool_]
    kept: NDArray[np.bool_]


def corrupt(sweep: Sweep, settings: PaperWetGround, rng: RandomSource) -> Sweep:
    """Dim or remove the points on the ground; the others are unchanged."""
    if settings.water_mm == 0.0 or len(sweep) == 0:
        return sweep
    cloud = cloud_of(sweep)
    cloud[:, 3] *= settings.scale
    wet = apply_wet_ground(cloud, settings, _ground(sweep, cloud, settings, rng))
    cloud[:, 3] = wet.intensity / settings.scale
    return with_cloud(sweep, cloud, np.where(wet.ground, ATTENUATED, KEPT))[wet.kept]


def _ground(sweep: Sweep, cloud: Cloud, settings: PaperWetGround, rng: RandomSource) -> FittedGround:
    if not settings.labelled:
        return ground_of(cloud, fit_plane(cloud, rng))
    rows = np.zeros(len(sweep), bool)
    rows[find_ground(sweep).rows] = True
    return labelled_ground(cloud, rows)


def apply_wet_ground(
    cloud: Cloud,
    settings: PaperWetGround,
    ground: FittedGround,
    *,
    intensity_fit: Array | None = None,
    noise_fit: Array | None = None,
) -> WetCloud:
    """Return a cloud on wet ground.

    Args:
        cloud: (P, 4), intensity as the model expects it (0 to 255).
        settings: of the water; the caller applies `scale`.
        ground: ground points, by `ground_of` a plane or by `labelled_ground`.
        intensity_fit: (2,) slope and offset of i / cos(theta) over range, instead of the cloud's own.
        noise_fit: (2,) slope and offset of the noise line before its factor, instead of the cloud's own.
    """
    intensity = cloud[:, 3].astype(np.float64)
    kept = np.ones(len(cloud), bool)
    before = intensity[ground.rows]
    if len(before) < _LEAST_GROUND:
        return WetCloud(intensity, np.zeros(len(cloud), bool), kept)
    if intensity_fit is None:
        intensity_fit = intensity_line(ground, before)
    if noise_fit is None:
        noise_fit = noise_line(ground, before)
    after = _dimmed(ground, before, _POWER_FACTOR * np.polyval(intensity_fit, ground.range_m), settings)
    intensity[ground.rows] = after
    if noise_fit is not None:
        level = settings.noise_factor * np.polyval(noise_fit, ground.range_m) * ground.cosine
        kept[ground.rows] = after > level
    return WetCloud(intensity, ground.rows, kept)


def fresnel(angle: Array, before: float, behind: float) -> tuple[Array, Array]:
    """Return the amplitudes that a flat interface reflects, s and p, shaped as the angle.

    Args:
        angle: of incidence, rad.
        before: refractive index on the side of the light.
        behind: refractive index on the other side.
    """
    inward = np.cos(angle)
    onward = np.cos(np.arcsin(np.clip(before / behind * np.sin(angle), -1.0, 1.0)))
    s, p = before * inward + behind * onward, behind * inward + before * onward
    return (before * inward - behind * onward) / s, (behind * inward - before * onward) / p


def film(angle: Array, reflectivity: Array) -> tuple[Array, Array]:
    """Return the power that diffuse ground under water scatters, s and p, shaped as `angle * reflectivity`.

    Args:
        angle: of incidence, rad.
    """
    mirrored_s, mirrored_p = (amplitude**2 for amplitude in fresnel(angle, AIR, WATER))
    return _through(mirrored_s, reflectivity), _through(mirrored_p, reflectivity)


def _through(mirrored: Array, reflectivity: Array) -> Array:
    return (1.0 - mirrored) ** 2 * reflectivity / (1.0 - reflectivity * mirrored)


def _dimmed(ground: FittedGround, intensity: Array, emitted: NDArray[np.floating], settings: PaperWetGround) -> Array:
    """Return (G,) the intensities of ground points under water; `emitted` is A."""
    angle = np.arccos(ground.cosine)
    level = emitted * ground.cosine
    reflectivity = np.divide(intensity, level, out=np.zeros(len(level)), where=level != 0)
    filled = min(settings.water_mm / PAVEMENT_MM, 1.0)
    through = np.maximum(*film(angle, np.clip(reflectivity, *_REFLECTIVITIES))) / np.maximum(angle, 1e-9)
    return np.clip(level * ((1.0 - filled) * reflectivity + filled * through), 0.0, intensity)
