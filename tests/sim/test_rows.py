from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from sim.boxes import Boxes
from sim.rows import Rows, stacked


@dataclass(frozen=True, slots=True, eq=False)
class Seen(Rows):
    SHARED: ClassVar = ("time_s",)

    time_s: float
    boxes: Boxes
    name: tuple[str, ...]
    score: NDArray[np.float64]


def seen(*names: str, time_s: float = 1.0) -> Seen:
    boxes = Boxes.from_array(np.arange(7.0 * len(names)).reshape(-1, 7))
    return Seen(time_s, boxes, names, np.arange(len(names), dtype=np.float64))


@pytest.mark.parametrize("rows", [np.array([True, False, True]), np.array([0, 2]), [0, 2], slice(0, 3, 2)])
def test_all_columns_are_selected_alike_and_what_rows_share_stays(rows: NDArray) -> None:
    some = seen("a", "b", "c")[rows]
    assert (len(some), some.name, some.score.tolist(), some.time_s) == (2, ("a", "c"), [0.0, 2.0], 1.0)
    assert some.boxes.center.tolist() == seen("a", "b", "c").boxes.center[[0, 2]].tolist()


def test_none_are_selected_by_an_empty_list_and_by_a_mask_of_falsehoods() -> None:
    assert len(seen("a", "b")[[]]) == len(seen("a", "b")[np.zeros(2, bool)]) == 0


def test_a_mask_of_another_length_and_an_index_beyond_the_end_are_refused() -> None:
    with pytest.raises(IndexError, match="mask for 2 rows"):
        seen("a", "b")[np.ones(3, bool)]
    with pytest.raises(IndexError):
        seen("a", "b")[np.array([2])]


def test_stacked_rows_keep_their_order_and_what_the_first_shares() -> None:
    both = stacked(seen("a"), seen("b", "c", time_s=2.0))
    assert (len(both), both.name, both.time_s) == (3, ("a", "b", "c"), 1.0)
    assert both.boxes.yaw.shape == (3,)


def test_a_column_keeps_its_memory_order() -> None:
    boxes = Boxes.from_array(np.zeros((4, 7)))
    odd = Boxes(np.asfortranarray(np.zeros((4, 3))), boxes.size, boxes.yaw, boxes.label, boxes.object_id)
    assert odd[np.array([1, 2])].center.flags == odd.center[np.array([1, 2])].flags
