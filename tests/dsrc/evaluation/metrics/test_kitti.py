"""KITTI's average precision: worked out by hand, and equal to another evaluator's."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dsrc.data.formats.kitti_labels import InImage
from dsrc.evaluation.metrics.kitti import LEVELS, Rated, RatedFrame
from dsrc.evaluation.metrics.protocols import PROTOCOLS
from dsrc.evaluation.scoring.score import score
from dsrc.ops.detections import Detections
from sim.boxes import CLASSES, Boxes
from tests.dsrc.data.goldens import unpack
from tests.paths import GOLDENS

CARS = 80
"""Two for each of the 40 recalls."""


def row_of(count: int, kind: str = "car", y: float = 0.0) -> Boxes:
    """Boxes 10 m from each other."""
    array = np.tile([0.0, y, 0.0, 4.0, 2.0, 1.5, 0.0], (count, 1))
    array[:, 0] = 10.0 * np.arange(count)
    return Boxes.from_array(array, np.full(count, CLASSES.index(kind)))


def image(count: int, height_px: float = 60.0, occluded: float = 0.0, truncated: float = 0.0) -> InImage:
    return InImage(*(np.full(count, value) for value in (height_px, occluded, truncated)))


def joined(*parts: tuple) -> tuple:
    """Parts of (boxes, image), or of (boxes, score, image), as one."""
    boxes = Boxes.from_array(
        np.concatenate([part[0].array for part in parts]), np.concatenate([part[0].label for part in parts])
    )
    pictured = InImage(*(np.concatenate(columns) for columns in zip(*(part[-1] for part in parts), strict=True)))
    scores = [np.broadcast_to(part[1], len(part[0])) for part in parts if len(part) == 3]
    return (boxes, np.concatenate(scores).astype(np.float32), pictured) if scores else (boxes, pictured)


def counted(found: Sequence[tuple], true: Sequence[tuple], level: str = "hard") -> Any:
    boxes, scores, pictured = joined(*found)
    truth, true_image = joined(*true)
    return Rated([RatedFrame(Detections(boxes, scores), pictured, truth, true_image)]).count(level, "bev", 0.7)


FALLING = np.linspace(0.9, 0.5, CARS)
CARS_FOUND = (row_of(CARS), FALLING, image(CARS))
TRUE_CARS = (row_of(CARS), image(CARS))


def test_precision_is_taken_at_every_fortieth_of_the_cars() -> None:
    assert counted([CARS_FOUND], [TRUE_CARS]).precision.tolist() == [1.0] * 41
    # 40 false detections after the first 40 cars: from there on precision rises to 80 / 120 at the last one.
    false = (row_of(40, y=50.0), 0.5 * (FALLING[39] + FALLING[40]), image(40))
    found = counted([CARS_FOUND, false], [TRUE_CARS])
    assert (found.truth, found.detections) == (80, 120)
    assert found.precision == pytest.approx([1.0] * 21 + [2 / 3] * 20)
    assert found.ap("40") == pytest.approx((20 + 20 * 2 / 3) / 40)
    assert found.ap("11") == pytest.approx((6 + 5 * 2 / 3) / 11)


def test_fewer_cars_than_recalls_get_less_as_in_the_kit() -> None:
    found = counted([(row_of(4), FALLING[:4], image(4))], [(row_of(4), image(4))])
    assert found.precision.tolist() == [1.0] * 4 + [0.0] * 37
    assert np.isnan(counted([CARS_FOUND], [(row_of(4), image(4, occluded=3))]).ap("40"))


@pytest.mark.parametrize(
    ("false", "true", "precision"),
    [
        # Other vehicles: a van found as a car is neither right nor wrong, a truck is wrong, a truck named so not asked.
        ((row_of(40, y=50.0), 0.95, image(40)), (row_of(40, "van", y=50.0), image(40)), 1.0),
        ((row_of(40, y=50.0), 0.95, image(40)), (row_of(40, "truck", y=50.0), image(40)), 2 / 3),
        ((row_of(40, "truck", y=50.0), 0.95, image(40)), (row_of(1, y=90.0), image(1, occluded=3)), 1.0),
        # Detections too low in the image.
        ((row_of(40, y=50.0), 0.95, image(40, height_px=24.9)), None, 1.0),
        ((row_of(40, y=50.0), 0.95, image(40, height_px=25.0)), None, 2 / 3),
        # Cars that do not count: found or not, too low, too occluded or too truncated.
        ((row_of(40, y=50.0), 0.95, image(40)), (row_of(40, y=50.0), image(40, height_px=25.0)), 1.0),
        ((row_of(40, y=50.0), 0.95, image(40)), (row_of(80, y=50.0), image(80, occluded=3)), 1.0),
        ((row_of(40, y=50.0), 0.95, image(40)), (row_of(80, y=50.0), image(80, truncated=0.51)), 1.0),
        # The second detection of a car.
        ((row_of(40), 0.95, image(40)), None, 2 / 3),
    ],
)
def test_what_counts_neither_way(false: tuple, true: tuple, precision: float) -> None:
    """40 detections, more confident than all others."""
    found = counted([CARS_FOUND, false], [TRUE_CARS] if true is None else [TRUE_CARS, true])
    assert found.truth == CARS
    assert found.precision[-1] == pytest.approx(precision)


def test_a_car_whose_only_detection_is_low_is_neither_found_nor_missed() -> None:
    first = (row_of(40), FALLING[:40], image(40))
    rest = row_of(CARS)[np.arange(40, CARS)]
    low = counted([first, (rest, FALLING[40:], image(40, height_px=20.0))], [TRUE_CARS])
    assert low.precision.tolist() == [1.0] * 21 + [0.0] * 20 and low.detections == 40
    # A high one beside it is taken, though it overlaps less and is surer.
    aside = Boxes.from_array(rest.array + np.array([0.2, 0, 0, 0, 0, 0, 0]))
    both = counted([first, (rest, 0.45, image(40, height_px=20.0)), (aside, 0.48, image(40))], [TRUE_CARS])
    assert both.precision.tolist() == [1.0] * 41


def test_levels_ask_more_of_the_image() -> None:
    hidden, cut, low = image(80, occluded=1), image(80, truncated=0.3), image(80, height_px=30.0)
    for part, counts in (
        (hidden, (0, 80, 80)),
        (cut, (0, 80, 80)),
        (low, (0, 80, 80)),
        (image(80, occluded=2), (0, 0, 80)),
    ):
        assert tuple(counted([CARS_FOUND], [(row_of(80), part)], level).truth for level in LEVELS) == counts


def test_numbers_equal_those_of_mmdet3d(tmp_path: Path) -> None:
    expected = json.loads((GOLDENS / "kitti_scores.json").read_text())
    tree = unpack("kitti_boxes", tmp_path)
    found = score(tree / "found", tree / "label_2", [name for name, one in PROTOCOLS.items() if one.level])
    numbers = {
        f"{one.protocol.name}/{space}/{round(100 * threshold)}": 100 * value
        for one in found
        for (space, threshold), value in one.ap.items()
    }
    assert numbers == pytest.approx(expected, rel=1e-12) and len(set(numbers.values())) > 20
