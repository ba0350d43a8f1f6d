"""Colours of different meaning are told apart, also without red or green cones."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pytest

from dsrc.review.palette import AGENT_COLORS, FATE_COLORS, FN, FP, LOOKS, LOST, METHOD_COLORS, SENSOR, TP, Look, linear
from sensors.sweep import ATTENUATED, MOVED, SCATTERED
from tests.dsrc.review.vision import VISIONS, difference_1976, difference_2000, seen_as

VERDICTS = {"TP": TP, "FP": FP, "FN": FN}
AGENTS = {f"agent {row}": rgb for row, rgb in enumerate(AGENT_COLORS)}
TOGETHER = {
    "who saw it": {**AGENTS, "sensor": SENSOR},
    "who helped": {**AGENTS, "FP": FP, "FN": FN},
    "right and wrong": {
        **VERDICTS, **{f"method {row}": rgb for row, rgb in enumerate(METHOD_COLORS) if row}, "sensor": SENSOR,
    },
    "curves": {f"method {row}": rgb for row, rgb in enumerate(METHOD_COLORS)},
    "fates": {
        "dimmer": FATE_COLORS[ATTENUATED], "moved": FATE_COLORS[MOVED], "added": FATE_COLORS[SCATTERED],
        "lost": LOST, "sensor": SENSOR,
    },
    "episode": {
        **VERDICTS, "plan": AGENT_COLORS[0], "track": METHOD_COLORS[1], "claim": FATE_COLORS[SCATTERED],
    },
}  # fmt: skip
"""Colours that one picture may show: colour tells one thing at a time."""
GROUNDS = {
    f"{part}, {theme}": rgb
    for theme, look in LOOKS.items()
    for part, rgb in [("faded points", look.faded), *look.world.items()]
    if part in ("faded points", "roads", "pavements", "ground")
}


def least(
    named: Mapping[str, Sequence[int]], vision: str, difference: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> tuple[float, str]:
    """Least difference of two colours, and which they are."""
    lab = seen_as(np.array(list(named.values())), vision)
    apart = difference(lab[:, None], lab[None]) + 1e3 * np.eye(len(lab))
    first, second = np.unravel_index(apart.argmin(), apart.shape)
    names = list(named)
    return apart.min(), f"{names[first]} and {names[second]} are {apart.min():.1f} apart"


@pytest.mark.parametrize("vision", VISIONS)
@pytest.mark.parametrize("named", TOGETHER.values(), ids=TOGETHER)
def test_colours_that_are_shown_together_differ(vision: str, named: Mapping[str, Sequence[int]]) -> None:
    for difference, bar in ((difference_1976, 20.0), (difference_2000, 14.0)):
        apart, which = least(named, vision, difference)
        assert apart >= bar, which


@pytest.mark.parametrize("vision", VISIONS)
@pytest.mark.parametrize("named", [named for name, named in TOGETHER.items() if name != "curves"])
def test_colours_with_a_meaning_differ_from_the_ground_of_both_themes(
    vision: str, named: Mapping[str, Sequence[int]]
) -> None:
    shown, ground = (seen_as(np.array(list(of.values())), vision) for of in (named, GROUNDS))
    apart = difference_2000(shown[:, None], ground[None])
    row, column = np.unravel_index(apart.argmin(), apart.shape)
    assert apart.min() >= 12.0, f"{list(named)[row]} on {list(GROUNDS)[column]}: {apart.min():.1f}"


@pytest.mark.parametrize("look", LOOKS.values(), ids=LOOKS)
def test_ground_roads_and_walls_are_near_neutral_and_the_ink_stands_out_of_them(look: Look) -> None:
    lab = seen_as(np.array(list(look.world.values())), "normal")
    assert np.hypot(lab[:, 1], lab[:, 2]).max() < 8.0
    ink = seen_as(np.array([look.ink]), "normal")
    assert difference_2000(ink, lab)[[name != "markings" for name in look.world]].min() > 30.0


def test_bodies_keep_their_colours_in_linear_light() -> None:
    agents = np.array(AGENT_COLORS, np.uint8)
    light = linear(agents) / 255.0
    shown = 255.0 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.minimum(light, 1.0) ** (1 / 2.4) - 0.055)
    assert np.abs(shown - agents).max() < 7.0


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
