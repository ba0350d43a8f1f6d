"""Colours of the review page, one meaning each, for all kinds of colour vision."""

import numpy as np
from numpy.typing import NDArray

from sensors.sweep import ATTENUATED, KEPT, MOVED, SCATTERED

Rgb = tuple[int, int, int]

# Neighbours differ in lightness as well as hue (after Okabe and Ito 2008), and none is the green, red or amber
# of TP, FP and FN.
AGENT_COLORS: tuple[Rgb, ...] = (
    (56, 189, 255),
    (255, 98, 205),
    (250, 236, 110),
    (158, 120, 255),
    (94, 234, 212),
    (255, 255, 255),
    (176, 158, 130),
)
"""Colours of the agents in the order of their frame; an eighth agent starts again."""

TRUTH: Rgb = (226, 232, 240)
OTHER: Rgb = (112, 122, 140)
SELECTED: Rgb = (255, 255, 255)
TP: Rgb = (70, 208, 60)
FP: Rgb = (250, 58, 64)
FN: Rgb = (242, 166, 34)
BACKGROUND: Rgb = (10, 12, 17)

FATE_COLORS: dict[int, Rgb] = {
    KEPT: (96, 110, 132),
    ATTENUATED: (86, 156, 255),
    MOVED: (214, 112, 255),
    SCATTERED: (255, 140, 40),
}
"""Colours of points by `Sweep.fate`."""
FATE_NAMES = {KEPT: "untouched", ATTENUATED: "dimmer", MOVED: "moved", SCATTERED: "made by the corruption"}
"""Names of the same."""

# Nine stops of each map, dark to bright; interpolated to 256 colours below.
_VIRIDIS = "46085c 472d7b 3b528b 2c728e 21918c 28ae80 5ec962 addc30 fde725"
_TURBO = "4040a2 4076f5 28bbec 31f199 9cfb40 e1dd37 fe9b2d e4460a b21002"


def _ramp(stops: str) -> NDArray[np.uint8]:
    rgb = np.array([[int(stop[i : i + 2], 16) for i in (0, 2, 4)] for stop in stops.split()], np.float64)
    at = np.linspace(0.0, len(rgb) - 1.0, 256)
    return np.stack([np.interp(at, np.arange(len(rgb)), rgb[:, c]) for c in range(3)], axis=1).round().astype(np.uint8)


VIRIDIS = _ramp(_VIRIDIS)
TURBO = _ramp(_TURBO)


# The ACES curve as three.js has it (S. Hill's fit, after an exposure of 1 / 0.6): linear colours in and out.
_ACES_IN = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
_ACES_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
_FIT = (0.0245786, 0.000090537, 0.983729, 0.4329510, 0.238081)
_EXPOSURE = 1.0 / 0.6


def inverse_tone_mapping(rgb: Rgb) -> Rgb:
    """Colour that the viewer's tone mapping turns into `rgb`, as nearly as it can.

    The viewer maps lines and meshes but not points; unmapped, saturated colours turn pale.
    """
    shown = np.array(rgb, np.float64) / 255.0
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    fitted = np.clip(np.linalg.solve(_ACES_OUT, linear), 0.0, 0.99)
    a, b, c, d, e = _FIT
    # fitted = (v^2 + a v - b) / (c v^2 + d v + e), solved for v.
    square, slope, rest = 1.0 - c * fitted, a - d * fitted, -(b + e * fitted)
    v = (-slope + np.sqrt(slope**2 - 4.0 * square * rest)) / (2.0 * square)
    sent = np.clip(np.linalg.solve(_ACES_IN, v) / _EXPOSURE, 0.0, 1.0)
    encoded = np.where(sent <= 0.0031308, 12.92 * sent, 1.055 * sent ** (1.0 / 2.4) - 0.055)
    red, green, blue = np.round(255.0 * encoded).astype(int).tolist()
    return red, green, blue


def agent_color(row: int) -> Rgb:
    """Colour of the agent in a row of its frame."""
    return AGENT_COLORS[row % len(AGENT_COLORS)]


def ramp(values: NDArray[np.floating], low: float, high: float, table: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Map (P,) values from [low, high], clipped, to (P, 3) colours of a (256, 3) table."""
    scaled = (np.asarray(values, np.float64) - low) / max(high - low, 1e-9)
    return table[np.clip(np.nan_to_num(scaled) * 255.0, 0, 255).astype(np.intp)]
