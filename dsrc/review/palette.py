"""Colours of the review page, one meaning each, for all kinds of colour vision."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dsrc.review.state import Theme
from sensors.sweep import ATTENUATED, KEPT, MOVED, SCATTERED

Rgb = tuple[int, int, int]

# Searched at random for the largest least difference by CIEDE2000 in normal vision, protanopia and deuteranopia of
# those that are shown together, from each other and from the ground of both themes, with TP in greens, FP in reds and
# FN in ambers; tests hold the difference, and that a browser shows these very colours.
AGENT_COLORS: tuple[Rgb, ...] = (
    (6, 142, 231),
    (175, 97, 153),
    (243, 147, 150),
    (2, 1, 244),
    (206, 180, 234),
    (90, 38, 131),
    (150, 80, 89),
)
"""Colours of the agents in the order of their frame; an eighth agent starts again."""

METHOD_COLORS: tuple[Rgb, ...] = ((96, 102, 112), (206, 180, 234), (87, 44, 122), (183, 114, 223))
"""Colours of the methods in the order in which they are shown: curves, and boxes over those of the judged one."""

OTHER: Rgb = (128, 134, 142)
TP: Rgb = (44, 165, 129)
FP: Rgb = (172, 45, 32)
FN: Rgb = (253, 176, 17)
UNSEEN = (36, 40, 60, 82)
"""Shade, with its opacity, over the road that nobody sees."""


@dataclass(frozen=True, slots=True)
class Look:
    """Colours of a theme that mean nothing, near neutral: those that do are the same in all.

    Attributes:
        sky: behind all.
        ink: boxes that are not told apart by colour, and points on road users where colour is the boxes'.
        faded: what points of the ground fade towards.
        body: road users that are no agents.
        world: parts of the static world, by the names of `dsrc.review.static`.
        grid: cells and sections of the ground of a drive without a world.
    """

    sky: Rgb
    ink: Rgb
    faded: Rgb
    body: Rgb
    world: dict[str, Rgb]
    grid: tuple[Rgb, Rgb]


LOOKS: dict[Theme, Look] = {
    "light": Look(
        sky=(238, 242, 246),
        ink=(40, 46, 58),
        faded=(205, 208, 211),
        body=(168, 173, 180),
        world={
            "roads": (208, 210, 213),
            "markings": (247, 248, 249),
            "pavements": (220, 221, 222),
            "ground": (226, 228, 225),
            "plants": (196, 206, 197),
            "buildings": (232, 233, 236),
            "furniture": (188, 192, 197),
        },
        grid=((206, 209, 213), (184, 189, 195)),
    ),
    "dark": Look(
        sky=(14, 17, 22),
        ink=(228, 233, 240),
        faded=(36, 39, 44),
        body=(92, 98, 110),
        world={
            "roads": (38, 41, 46),
            "markings": (112, 117, 125),
            "pavements": (44, 47, 52),
            "ground": (28, 31, 34),
            "plants": (58, 68, 61),
            "buildings": (46, 50, 58),
            "furniture": (92, 97, 106),
        },
        grid=((44, 48, 56), (62, 68, 78)),
    ),
}
"""Looks of the themes; daylight is the usual one."""

FATE_COLORS: dict[int, Rgb] = {
    KEPT: (150, 156, 164),
    ATTENUATED: (89, 154, 209),
    MOVED: (172, 30, 102),
    SCATTERED: (30, 58, 216),
}
"""Colours of points by `Sweep.fate`."""
LOST: Rgb = (205, 194, 128)
"""Colour of points that a corruption removed."""
SENSOR: Rgb = (214, 97, 8)
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


def linear(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Reflectance of (N, 3) sRGB colours, 0 to 255: the viewer takes colours of instances as linear."""
    encoded = np.asarray(rgb, np.float64) / 255.0
    light = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return np.round(255.0 * light).astype(np.uint8)


def agent_color(row: int) -> Rgb:
    """Colour of the agent in a row of its frame."""
    return AGENT_COLORS[row % len(AGENT_COLORS)]


def method_color(row: int) -> Rgb:
    """Colour of a method in the row of those shown."""
    return METHOD_COLORS[row % len(METHOD_COLORS)]


def css(rgb: Rgb) -> str:
    """Colour as a style sheet has it."""
    return "rgb({},{},{})".format(*rgb)


def ramp(values: NDArray[np.floating], low: float, high: float, table: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Map (P,) values from [low, high], clipped, to (P, 3) colours of a (256, 3) table."""
    scaled = (np.asarray(values, np.float64) - low) / max(high - low, 1e-9)
    return table[np.clip(np.nan_to_num(scaled) * 255.0, 0, 255).astype(np.intp)]
