"""Colours of the review page: one meaning per colour, readable with a colour vision deficiency."""

import numpy as np
from numpy.typing import NDArray

from sensors.sweep import ATTENUATED, KEPT, MOVED, SCATTERED

Rgb = tuple[int, int, int]

# Neighbours differ in lightness as well as hue (after Okabe and Ito 2008), and none is the green, red or amber
# that judges a detection.
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
RIGHT: Rgb = (38, 232, 96)
WRONG: Rgb = (255, 59, 64)
MISSED: Rgb = (255, 170, 0)
BACKGROUND: Rgb = (10, 12, 17)

FATE_COLORS: dict[int, Rgb] = {
    KEPT: (96, 110, 132),
    ATTENUATED: (86, 156, 255),
    MOVED: (214, 112, 255),
    SCATTERED: (255, 140, 40),
}
"""Colours of what a corruption did to a point."""

# Nine stops of each map, dark to bright; interpolated to 256 colours below.
_VIRIDIS = "46085c 472d7b 3b528b 2c728e 21918c 28ae80 5ec962 addc30 fde725"
_TURBO = "4040a2 4076f5 28bbec 31f199 9cfb40 e1dd37 fe9b2d e4460a b21002"


def _ramp(stops: str) -> NDArray[np.uint8]:
    rgb = np.array([[int(stop[i : i + 2], 16) for i in (0, 2, 4)] for stop in stops.split()], np.float64)
    at = np.linspace(0.0, len(rgb) - 1.0, 256)
    return np.stack([np.interp(at, np.arange(len(rgb)), rgb[:, c]) for c in range(3)], axis=1).round().astype(np.uint8)


VIRIDIS = _ramp(_VIRIDIS)
TURBO = _ramp(_TURBO)


def agent_color(row: int) -> Rgb:
    """Return the colour of the agent in this row of its frame."""
    return AGENT_COLORS[row % len(AGENT_COLORS)]


def ramp(values: NDArray[np.floating], low: float, high: float, table: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Map (P,) values from [low, high], clipped, to (P, 3) colours of a (256, 3) table."""
    scaled = (np.asarray(values, np.float64) - low) / max(high - low, 1e-9)
    return table[np.clip(np.nan_to_num(scaled) * 255.0, 0, 255).astype(np.intp)]
