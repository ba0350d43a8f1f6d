"""Protocols: each counts what its publication says, in the order it says."""

import json
import re

import numpy as np
import pytest

from dsrc.data.sample import OPENCOOD_RANGE_M
from dsrc.evaluation.metrics.protocols import PROTOCOLS, Protocol, get_protocols
from dsrc.evaluation.scoring.score import score
from dsrc.options import detection
from sim.boxes import Boxes
from sim.errors import SettingsError
from tests.dsrc.evaluation.metrics.test_ap import GOLDENS, golden_frames

UNRATED = [name for name, protocol in PROTOCOLS.items() if protocol.level is None]
"""Protocols that need no boxes in an image."""


@pytest.mark.parametrize(("name", "order"), [("opencood", "ap_local"), ("opencood-global", "ap_global")])
def test_opencood_is_equalled_to_twelve_digits(name: str, order: str) -> None:
    expected = json.loads((GOLDENS / "ap.json").read_text())["results"]
    _, frames = golden_frames()
    (found,) = score([frame.detections for frame in frames], [frame.truth for frame in frames], name)
    assert found.frames == len(frames)
    for digit in (3, 5, 7):
        want = expected[str(digit / 10)]
        assert found.ap["bev", digit / 10] == pytest.approx(want[order], rel=1e-12)
        assert (found.truth, found.detections) == (want["gt"], want["n_det"])


def test_one_set_of_boxes_has_as_many_averages_as_protocols() -> None:
    _, frames = golden_frames()
    found = score([frame.detections for frame in frames], [frame.truth for frame in frames], "all")
    assert [one.protocol.name for one in found] == UNRATED
    bev = {one.protocol.name: one.ap["bev", 0.7] for one in found}
    assert bev["opencood-global"] - bev["opencood"] > 0.09  # by the order alone
    assert bev["kitti-r40"] != bev["kitti-r11"] != bev["opencood-global"]
    three_d = {one.protocol.name for one in found if ("3d", 0.7) in one.ap}
    assert three_d == {"dair-vic", "kitti-r11", "kitti-r40", "testbed", "testbed-per-frame"}


def test_names_are_those_of_the_help_and_cards_tell_protocols_apart() -> None:
    assert tuple(PROTOCOLS) == detection.PROTOCOLS
    cards = [protocol.card for protocol in PROTOCOLS.values()]
    assert len(set(cards)) == len(cards) and not any("\n" in card for card in cards)
    assert PROTOCOLS["opencood"].range_m == OPENCOOD_RANGE_M
    assert all(re.search(r"20\d\d|OpenCOOD|dsrc", protocol.source) for protocol in PROTOCOLS.values())


def test_a_box_counts_by_its_corners_in_the_range() -> None:
    half_in = Boxes.from_array([[100.0, 0, -1, 4, 2, 1.5, 0], [50.0, 0, -1, 4, 2, 1.5, 0], [-1, 0, -1, 4, 2, 1.5, 0]])
    assert PROTOCOLS["dair-vic"].counts(half_in).tolist() == [True, True, True]
    assert PROTOCOLS["v2v4real"].counts(half_in).tolist() == [False, True, True]
    assert PROTOCOLS["dair-vic"].counts(Boxes.from_array([[-9.0, 0, -1, 4, 2, 1.5, 0]])).tolist() == [False]
    assert PROTOCOLS["kitti-r40"].counts(half_in).all()
    wide = Boxes.from_array([[0, 39.0, -1, 4, 1.9, 1.5, 0]])
    assert PROTOCOLS["coalign"].counts(wide).all() and not PROTOCOLS["coalign-v2x-vit"].counts(wide).any()


def test_protocols_are_found_by_name_or_are_ones_own() -> None:
    own = Protocol(name="mine", source="here", range_m=(0.0, -10.0, -3.0, 20.0, 10.0, 1.0))
    assert get_protocols("all") == tuple(PROTOCOLS.values())
    assert [one.name for one in get_protocols("all", levels=False)] == UNRATED
    with pytest.raises(
        SettingsError, match="score: protocol kitti-hard-r40: expected KITTI's label files with boxes in"
    ):
        get_protocols(["opencood", "kitti-hard-r40"], levels=False)
    assert get_protocols(["kitti-r11", own, "kitti-r11"]) == (PROTOCOLS["kitti-r11"], own)
    with pytest.raises(
        SettingsError, match="score: protocol: expected the name of a protocol, found kiti-r40; did you"
    ):
        get_protocols("kiti-r40")
    with pytest.raises(SettingsError, match="score: protocol: expected at least one of opencood"):
        get_protocols([])
    assert np.isnan(score([], [], "opencood")[0].ap["bev", 0.5])
