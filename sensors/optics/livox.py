"""Scan pattern of a Risley scanner (Livox): a beam through rotating wedges of glass.

Each face bends the beam by Snell's law, applied to vectors: with the unit direction d, the unit normal m of the face
against it, c = -d . m and the ratio r of the refractive indices before and behind the face, the beam continues along
r d + (r c - sqrt(1 - r^2 (1 - c^2))) m (Li, Liu and Sun, Opt. Express 25, 7677, 2017, for three wedges). Only
directions matter: the faces' distances shift the beam by millimetres.
"""

import numpy as np
from numpy.typing import NDArray

from sensors.spec import LidarSpec, Prism
from sim.errors import SettingsError, complaint


def rosette_axes(spec: LidarSpec, time_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (R, C) azimuth and elevation of the beams at (R, C) times, rad.

    The axis of rotation is x, straight ahead; at time 0 the thick ends of all wedges are up.

    Raises:
        SettingsError: a face reflects a beam totally.
    """
    azimuth = np.radians(np.array(spec.azimuth_offset_deg or (0.0,) * spec.rings))
    elevation = spec.elevation
    line = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    beam = np.broadcast_to(line[:, :, None], (3, *time_s.shape))
    for prism in spec.prisms:
        beam = _through(prism, beam, time_s)
    if np.isnan(beam).any():
        raise SettingsError(
            complaint(f"LidarSpec '{spec.name}'", "prisms", "wedges that let the beams through", "total reflection")
        )
    return np.arctan2(beam[1], beam[0]), np.arctan2(beam[2], np.hypot(beam[0], beam[1]))


def _through(prism: Prism, beam: NDArray[np.float64], time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (3, R, C) directions behind a wedge."""
    turn, wedge = 2.0 * np.pi * prism.rate_hz * time_s, np.radians(prism.wedge_deg)
    lean = np.sin(wedge) * (1.0 if prism.slanted_exit else -1.0)
    slanted = np.stack([np.full_like(turn, -np.cos(wedge)), lean * np.sin(turn), lean * np.cos(turn)])
    square = np.array([-1.0, 0.0, 0.0])[:, None, None]
    first, last = (square, slanted) if prism.slanted_exit else (slanted, square)
    return _refract(_refract(beam, first, 1.0 / prism.refraction), last, prism.refraction)


def _refract(beam: NDArray[np.float64], normal: NDArray[np.float64], ratio: float) -> NDArray[np.float64]:
    """Return the (3, R, C) directions behind a face; NaN where it reflects totally."""
    cosine = -(beam * normal).sum(axis=0)
    left = 1.0 - ratio**2 * (1.0 - cosine**2)
    return ratio * beam + (ratio * cosine - np.sqrt(np.where(left < 0.0, np.nan, left))) * normal
