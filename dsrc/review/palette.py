"""Colours of the review page, one meaning each, for all kinds of colour vision."""

import numpy as np
from numpy.typing import NDArray

from sensors.sweep import ATTENUATED, KEPT, MOVED, SCATTERED

Rgb = tuple[int, int, int]

# Searched at random for the largest least difference by CIEDE2000 in normal vision, protanopia and deuteranopia, with
# TP in greens, FP in reds and FN in ambers; tests hold the difference, and that a browser shows these very colours.
AGENT_COLORS: tuple[Rgb, ...] = (
    (52, 159, 255),
    (251, 254, 54),
    (186, 255, 246),
    (88, 70, 255),
    (165, 155, 168),
    (162, 146, 121),
    (120, 93, 91),
)
"""Colours of the agents in the order of their frame; an eighth agent starts again."""

METHOD_COLORS: tuple[Rgb, ...] = ((255, 255, 255), (255, 198, 255), (76, 91, 243), (119, 122, 140))
"""Colours of the methods in the order in which they are shown: curves, and boxes over those of the judged one."""

TRUTH: Rgb = (226, 232, 240)
OTHER: Rgb = (112, 122, 140)
SELECTED: Rgb = (255, 255, 255)
TP: Rgb = (27, 254, 182)
FP: Rgb = (219, 1, 23)
FN: Rgb = (218, 159, 6)
BODY: Rgb = (84, 92, 108)
BACKGROUNDS: dict[str, Rgb] = {"dark": (10, 12, 17), "light": (148, 156, 168)}
"""Colour of the sky of each theme."""
BRIGHTNESS: dict[str, float] = {"dark": 1.0, "light": 5.0}
"""Light of each theme: that of the ground, roads and buildings, in multiples of their colours."""
GRID: tuple[Rgb, Rgb] = ((52, 58, 70), (76, 84, 100))
"""Colours of the grid's cells and sections."""

FATE_COLORS: dict[int, Rgb] = {
    KEPT: (96, 110, 132),
    ATTENUATED: (112, 142, 186),
    MOVED: (100, 220, 255),
    SCATTERED: (186, 14, 135),
}
"""Colours of points by `Sweep.fate`."""
LOST: Rgb = (164, 204, 117)
"""Colour of points that a corruption removed."""
SENSOR: Rgb = (3, 124, 25)
"""Colour of the points of a sensor that the recording lacks."""
FATE_NAMES = {KEPT: "untouched", ATTENUATED: "dimmer", MOVED: "moved", SCATTERED: "made by the corruption"}
"""Names of the same."""
LOST_NAME = "lost to the corruption"

# Nine stops of each map, dark to bright; interpolated to 256 colours below.
_VIRIDIS = "46085c 472d7b 3b528b 2c728e 21918c 28ae80 5ec962 addc30 fde725"
_TURBO = "4040a2 4076f5 28bbec 31f199 9cfb40 e1dd37 fe9b2d e4460a b21002"


def _ramp(stops: str) -> NDArray[np.uint8]:
    rgb = np.array([[int(stop[i : i + 2], 16) for i in (0, 2, 4)] for stop in stops.split()], np.float64)
    at = np.linspace(0.0, len(rgb) - 1.0, 256)
    return np.stack([np.interp(at, np.arange(len(rgb)), rgb[:, c]) for c in range(3)], axis=1).round().astype(np.uint8)


VIRIDIS = _ramp(_VIRIDIS)
TURBO = _ramp(_TURBO)


def linear(rgb: NDArray[np.uint8], brightness: float = 1.0) -> NDArray[np.uint8]:
    """Reflectance of (N, 3) sRGB colours in a light, 0 to 255: the viewer takes colours of instances as linear."""
    encoded = np.asarray(rgb, np.float64) / 255.0
    light = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return np.round(255.0 * light / brightness).astype(np.uint8)


def agent_color(row: int) -> Rgb:
    """Colour of the agent in a row of its frame."""
    return AGENT_COLORS[row % len(AGENT_COLORS)]


def method_color(row: int) -> Rgb:
    """Colour of a method in the row of those shown: white for the judged one."""
    return METHOD_COLORS[row % len(METHOD_COLORS)]


def curve_color(row: int, theme: str) -> Rgb:
    """Colour of a method's curve on a panel of a theme: dark where that of its boxes is white on white."""
    color = method_color(row)
    return (40, 46, 58) if theme == "light" and color == METHOD_COLORS[0] else color


def css(rgb: Rgb) -> str:
    """Colour as a style sheet has it."""
    return "rgb({},{},{})".format(*rgb)


def ramp(values: NDArray[np.floating], low: float, high: float, table: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Map (P,) values from [low, high], clipped, to (P, 3) colours of a (256, 3) table."""
    scaled = (np.asarray(values, np.float64) - low) / max(high - low, 1e-9)
    return table[np.clip(np.nan_to_num(scaled) * 255.0, 0, 255).astype(np.intp)]
