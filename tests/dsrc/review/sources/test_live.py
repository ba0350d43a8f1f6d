"""A live source keeps the latest frames and their detections, and whoever makes them never waits."""

import threading
import time

import numpy as np
import pytest

from dsrc.evaluation.detection_table import DetectionTable, one_frame
from dsrc.ops.detections import Detections
from dsrc.review.sources.base import MemorySet, Setup
from dsrc.review.sources.live import LiveSource
from sim.boxes import Boxes
from sim.errors import DataError
from tests.dsrc.review.conftest import street_frame


def table(row: int) -> DetectionTable:
    return one_frame(row, row, 1000, Detections.zeros(), Boxes.zeros())


def test_frames_grow_and_old_ones_are_dropped_with_their_detections() -> None:
    live = LiveSource("street", kept=3)
    assert len(live) == 0 and not live.labelled
    with pytest.raises(DataError, match="street: frame: expected a first frame to come, found 0"):
        live.read(0)
    for row in range(5):
        assert live.put(street_frame(row), {"method": table(row)}) == row
    assert (len(live), live.first, live.labelled) == (5, 2, True)
    assert [live.read(row).index for row in (2, 3, 4)] == [2, 3, 4]
    assert live.sets["method"].rows(Setup()).tolist() == [2, 3, 4]
    assert live.sets["method"].run(Setup()).position.tolist() == [2, 3, 4]
    for row in (1, 5):
        with pytest.raises(DataError, match=f"street: frame: expected 2 to 4, found {row}"):
            live.read(row)


def test_the_maker_never_waits_for_a_reader() -> None:
    live, frame = LiveSource("street", kept=2), street_frame(0)
    stop = threading.Event()

    def read() -> None:
        while not stop.is_set():
            if len(live):
                try:
                    live.read(live.first)
                except DataError:
                    continue

    readers = [threading.Thread(target=read) for _ in range(3)]
    for reader in readers:
        reader.start()
    start = time.perf_counter()
    for _ in range(200):
        live.put(frame)
    took = time.perf_counter() - start
    stop.set()
    for reader in readers:
        reader.join()
    assert took < 20.0 and len(live) == 200


def test_no_frame_comes_after_the_end() -> None:
    live = LiveSource("street")
    live.put(street_frame(0))
    live.end()
    assert live.ended and len(live) == 1
    with pytest.raises(ValueError, match="has ended"):
        live.put(street_frame(1))


def test_wrong_tables_and_sets_are_refused() -> None:
    live = LiveSource("street")
    with pytest.raises(ValueError, match="frame 0 alone"):
        live.put(street_frame(0), {"method": table(3)})
    live.sets["computed"] = MemorySet("computed", recorded=False)
    with pytest.raises(ValueError, match="computed, not recorded"):
        live.put(street_frame(0), {"computed": table(0)})
    with pytest.raises(ValueError, match="at least 1"):
        LiveSource("street", kept=0)


def test_a_set_that_grows_gives_the_newest_run() -> None:
    grows = MemorySet("method")
    assert len(grows.run(Setup())) == 0 and grows.conditions() == ()
    for row in (3, 1, 2):
        grows.put(row, table(row))
    assert grows.run(Setup()).position.tolist() == [1, 2, 3] and grows.conditions() == (Setup().condition,)
    grows.forget(3)
    np.testing.assert_array_equal(grows.rows(Setup()), [3])
