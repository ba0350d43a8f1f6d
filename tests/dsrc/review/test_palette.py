"""Colours of different meaning are told apart, also without red or green cones."""

import numpy as np
import pytest

from dsrc.review.palette import AGENT_COLORS, FATE_COLORS, FN, FP, LOST, METHOD_COLORS, SENSOR, TP
from sensors.sweep import MOVED, SCATTERED
from tests.dsrc.review.vision import VISIONS, seen_as

NAMED = {
    "TP": TP, "FP": FP, "FN": FN, "added": FATE_COLORS[SCATTERED], "moved": FATE_COLORS[MOVED],
    "lost": LOST, "sensor": SENSOR,
    **{f"agent {row}": rgb for row, rgb in enumerate(AGENT_COLORS)},
}  # fmt: skip

METHODS = {**{f"method {row}": rgb for row, rgb in enumerate(METHOD_COLORS)}, "TP": TP, "FP": FP, "FN": FN}


@pytest.mark.parametrize("vision", VISIONS)
def test_colours_of_methods_differ_from_each_other_and_from_verdicts(vision):
    lab = seen_as(np.array(list(METHODS.values())), vision)
    apart = np.linalg.norm(lab[:, None] - lab[None], axis=-1) + 1e3 * np.eye(len(lab))
    assert apart.min() >= 20.0


@pytest.mark.parametrize("vision", VISIONS)
def test_colours_of_different_meaning_differ_by_twenty(vision):
    lab = seen_as(np.array(list(NAMED.values())), vision)
    apart = np.linalg.norm(lab[:, None] - lab[None], axis=-1) + 1e3 * np.eye(len(lab))
    first, second = np.unravel_index(apart.argmin(), apart.shape)
    names = list(NAMED)
    assert apart.min() >= 20.0, f"{names[first]} and {names[second]} are {apart.min():.1f} apart"
