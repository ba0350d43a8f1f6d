"""Colours of different meaning are told apart, also without red or green cones."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pytest

from dsrc.review.palette import AGENT_COLORS, BRIGHTNESS, FATE_COLORS, FN, FP, LOST, METHOD_COLORS, SENSOR, TP, linear
from sensors.sweep import MOVED, SCATTERED
from tests.dsrc.review.vision import VISIONS, difference_1976, difference_2000, seen_as

VERDICTS = {"TP": TP, "FP": FP, "FN": FN}
MARKS = {
    **VERDICTS, "added": FATE_COLORS[SCATTERED], "moved": FATE_COLORS[MOVED],
    **{f"agent {row}": rgb for row, rgb in enumerate(AGENT_COLORS)},
}  # fmt: skip
POINTS = {**MARKS, "lost": LOST, "sensor": SENSOR}
METHODS = {**{f"method {row}": rgb for row, rgb in enumerate(METHOD_COLORS)}, **VERDICTS}


def least(
    named: Mapping[str, Sequence[int]], vision: str, difference: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> tuple[float, str]:
    """Least difference of two colours, and which they are."""
    lab = seen_as(np.array(list(named.values())), vision)
    apart = difference(lab[:, None], lab[None]) + 1e3 * np.eye(len(lab))
    first, second = np.unravel_index(apart.argmin(), apart.shape)
    names = list(named)
    return apart.min(), f"{names[first]} and {names[second]} are {apart.min():.1f} apart"


# CIEDE2000 counts differences of saturated colours less: its bars are what the palette reaches.
@pytest.mark.parametrize("vision", VISIONS)
@pytest.mark.parametrize(
    ("named", "by_1976", "by_2000"),
    [(MARKS, 20.0, 16.5), (POINTS, 20.0, 9.5), (METHODS, 20.0, 14.0)],
    ids=["marks", "points", "methods"],
)
def test_colours_of_different_meaning_differ(
    vision: str, named: Mapping[str, Sequence[int]], by_1976: float, by_2000: float
) -> None:
    for difference, bar in ((difference_1976, by_1976), (difference_2000, by_2000)):
        apart, which = least(named, vision, difference)
        assert apart >= bar, which


@pytest.mark.parametrize("brightness", BRIGHTNESS.values(), ids=BRIGHTNESS)
def test_bodies_keep_their_colours_in_the_light_of_a_theme(brightness: float) -> None:
    agents = np.array(AGENT_COLORS, np.uint8)
    light = linear(agents, brightness) * brightness / 255.0
    shown = 255.0 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.minimum(light, 1.0) ** (1 / 2.4) - 0.055)
    assert np.abs(shown - agents).max() < 5.0


# Pairs of the test data of Sharma, Wu and Dalal (2005), table 1.
@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
        ((50.0, 2.49, -0.001), (50.0, -2.49, 0.0011), 7.2195),
        ((50.0, 2.5, 0.0), (73.0, 25.0, -18.0), 27.1492),
        ((22.7233, 20.0904, -46.694), (23.0331, 14.973, -42.5619), 2.0373),
        ((2.0776, 0.0795, -1.135), (0.9033, -0.0636, -0.5514), 0.9082),
    ],
)
def test_ciede2000_is_that_of_the_published_pairs(
    one: tuple[float, float, float], other: tuple[float, float, float], expected: float
) -> None:
    assert difference_2000(np.array(one), np.array(other)) == pytest.approx(expected, abs=1e-4)
