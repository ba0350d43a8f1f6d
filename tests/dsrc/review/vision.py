"""Colours in CIE L*a*b* as eyes without red or green cones see them (Machado, Oliveira and Fernandes 2009), and their
differences."""

import numpy as np
from numpy.typing import NDArray

_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.119192, 0.9503041]]
)
VISIONS = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
}
"""Matrices of linear RGB, full severity, table 1 of the paper."""


def seen_as(rgb: NDArray[np.integer], vision: str) -> NDArray[np.float64]:
    """(N, 3) L*a*b* coordinates under D65 of (N, 3) sRGB colours, 0 to 255, as a vision of `VISIONS` has them."""
    encoded = np.asarray(rgb, np.float64) / 255.0
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ VISIONS[vision].T, 0.0, 1.0)
    xyz = seen @ _XYZ.T / _XYZ.sum(axis=1)
    f = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116)
    return np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1)


def difference_1976(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of L*a*b* colours (..., 3)."""
    return np.linalg.norm(one - other, axis=-1)


def difference_2000(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """CIEDE2000 difference of L*a*b* colours (..., 3), with all three weights 1 (CIE 142-2001)."""
    lightness, chroma = (one[..., 0], other[..., 0]), [np.hypot(lab[..., 1], lab[..., 2]) for lab in (one, other)]
    mean_7 = (0.5 * (chroma[0] + chroma[1])) ** 7
    stretch = 1.0 + 0.5 * (1.0 - np.sqrt(mean_7 / (mean_7 + 25.0**7)))
    red = [stretch * lab[..., 1] for lab in (one, other)]
    chroma = [np.hypot(a, lab[..., 2]) for a, lab in zip(red, (one, other), strict=True)]
    hue = [np.degrees(np.arctan2(lab[..., 2], a)) % 360.0 for a, lab in zip(red, (one, other), strict=True)]
    grey = chroma[0] * chroma[1] == 0.0
    turn = np.where(grey, 0.0, (hue[1] - hue[0] + 180.0) % 360.0 - 180.0)
    step_l, step_c = lightness[1] - lightness[0], chroma[1] - chroma[0]
    step_h = 2.0 * np.sqrt(chroma[0] * chroma[1]) * np.sin(np.radians(0.5 * turn))
    mean_l, mean_c = 0.5 * (lightness[0] + lightness[1]), 0.5 * (chroma[0] + chroma[1])
    mean_h = np.where(grey, hue[0] + hue[1], hue[0] + 0.5 * turn)
    shape = (
        1.0
        - 0.17 * np.cos(np.radians(mean_h - 30.0))
        + 0.24 * np.cos(np.radians(2.0 * mean_h))
        + 0.32 * np.cos(np.radians(3.0 * mean_h + 6.0))
        - 0.20 * np.cos(np.radians(4.0 * mean_h - 63.0))
    )
    scale_l = 1.0 + 0.015 * (mean_l - 50.0) ** 2 / np.sqrt(20.0 + (mean_l - 50.0) ** 2)
    scale_c, scale_h = 1.0 + 0.045 * mean_c, 1.0 + 0.015 * mean_c * shape
    bend = 30.0 * np.exp(-((((mean_h % 360.0) - 275.0) / 25.0) ** 2))
    mixed = -2.0 * np.sqrt(mean_c**7 / (mean_c**7 + 25.0**7)) * np.sin(np.radians(2.0 * bend))
    parts_c, parts_h = step_c / scale_c, step_h / scale_h
    return np.sqrt((step_l / scale_l) ** 2 + parts_c**2 + parts_h**2 + mixed * parts_c * parts_h)
