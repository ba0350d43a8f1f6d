"""The worker fills sets of detections over whole runs and reads frames ahead, with progress and without a page."""

import threading
import time
from collections.abc import Iterator

import pytest

from dsrc.data.sample import Sample
from dsrc.ops.detections import Detections
from dsrc.review.errors.judgements import DETECTOR
from dsrc.review.model import ReviewModel
from dsrc.review.sources.base import MemorySet, Setup
from dsrc.review.state import ReviewState
from dsrc.review.worker import Worker
from sensors.corruptions import Condition
from sensors.frame import Frame
from sim.errors import DataError, SettingsError
from tests.dsrc.review.conftest import FakeDetector, FakeDrive


@pytest.fixture
def worker() -> Iterator[Worker]:
    worker = Worker()
    yield worker
    worker.close()


def test_a_run_is_detected_once_from_a_frame_on(
    worker: Worker, model: ReviewModel, drive: FakeDrive, detector: FakeDetector
) -> None:
    store = model.stores[0]
    job = worker.wait(worker.detect(store, DETECTOR, Setup(), start=5), 60.0)
    assert (job.state, job.done, job.total, job.skipped) == ("done", 12, 12, [])
    assert store.source.sets[DETECTOR].rows(Setup()).tolist() == list(range(12))
    order = [int(sample.key.split("/")[1]) for sample in detector.samples]
    assert order == [*range(5, 12), *range(5)]
    again = worker.wait(worker.detect(store, DETECTOR, Setup()), 60.0)
    assert again.state == "done" and len(detector.samples) == 12
    # The page finds all of them, and detects nothing itself.
    assert model.view(ReviewState(frame=7)).seen_frames == 12 and len(detector.samples) == 12


def test_a_cancelled_job_keeps_what_it_found(worker: Worker, model: ReviewModel, detector: FakeDetector) -> None:
    entered, go = threading.Event(), threading.Event()
    detect = detector.detect

    def slow(sample: Sample) -> Detections:
        entered.set()
        assert go.wait(30.0)
        return detect(sample)

    detector.detect = slow
    runs = worker.detect(model.stores[0], DETECTOR, Setup())
    waits = worker.detect(model.stores[0], DETECTOR, Setup(ego_id=1002))
    assert worker.detect(model.stores[0], DETECTOR, Setup()) is runs
    assert entered.wait(30.0)
    assert (runs.state, waits.state) == ("running", "waiting") and worker.jobs() == [runs, waits]
    worker.cancel(waits)
    worker.cancel(runs)
    go.set()
    assert worker.wait(runs, 30.0).state == worker.wait(waits, 30.0).state == "cancelled"
    assert len(model.stores[0].source.sets[DETECTOR].rows(Setup())) == 1
    assert worker.jobs() == []


def test_a_broken_frame_is_skipped_and_told_and_a_broken_detector_ends_the_job(
    worker: Worker, model: ReviewModel, drive: FakeDrive, detector: FakeDetector
) -> None:
    read = drive.read

    def broken(row: int) -> Frame:
        if row == 3:
            raise DataError("000003.pcd: not a readable point cloud")
        return read(row)

    drive.read = broken
    job = worker.wait(worker.detect(model.stores[0], DETECTOR, Setup()), 60.0)
    assert job.state == "done" and job.skipped == [(3, "000003.pcd: not a readable point cloud")]
    assert 3 not in model.stores[0].source.sets[DETECTOR].rows(Setup())

    def fails(sample: Sample) -> None:
        raise RuntimeError("out of memory")

    detector.detect = fails
    failed = worker.wait(worker.detect(model.stores[0], DETECTOR, Setup(cooperative=False)), 60.0)
    assert failed.state == "failed" and "RuntimeError: out of memory" in failed.error
    # The worker itself goes on.
    worker.prefetch(model.stores[0], [9])


def test_frames_are_read_ahead_and_then_drawn_without_reading(
    worker: Worker, model: ReviewModel, drive: FakeDrive, fake_fog: list[tuple[int, str, int]]
) -> None:
    worker.prefetch(model.stores[0], [4, 5, 6, 99], Condition("fog", 3))
    deadline = time.monotonic() + 30.0
    while len(fake_fog) < 3 and time.monotonic() < deadline:
        time.sleep(0.01)
    reads = list(drive.reads)
    assert sorted(reads) == [4, 5, 6]
    model.stores[0].corrupted(5, Condition("fog", 3))
    assert drive.reads == reads and len(fake_fog) == 3


def test_a_newer_request_replaces_what_was_to_be_read_ahead(
    worker: Worker, model: ReviewModel, drive: FakeDrive
) -> None:
    entered, go = threading.Event(), threading.Event()
    read = drive.read

    def slow(row: int) -> Frame:
        entered.set()
        assert go.wait(30.0)
        return read(row)

    drive.read = slow
    worker.prefetch(model.stores[0], [0, 1, 2])
    assert entered.wait(30.0)
    worker.prefetch(model.stores[0], [8])
    go.set()
    deadline = time.monotonic() + 30.0
    while 8 not in drive.reads and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(0.05)
    assert drive.reads == [0, 8]


def test_only_detectors_can_be_asked(worker: Worker, model: ReviewModel, drive: FakeDrive) -> None:
    model.sources[0].sets["stored"] = MemorySet("stored")
    with pytest.raises(SettingsError, match="street: stored: expected a detector, found recorded detections"):
        worker.detect(model.stores[0], "stored", Setup())
    with pytest.raises(SettingsError, match="street: nothing: expected a detector, found none"):
        worker.detect(model.stores[0], "nothing", Setup())


def test_a_closed_worker_ends_its_jobs(drive: FakeDrive, detector: FakeDetector) -> None:
    model, worker = ReviewModel([drive], detector), Worker()
    jobs = [worker.detect(model.stores[0], DETECTOR, Setup(ego_id=ego)) for ego in (1000, 1002)]
    worker.close()
    assert all(job.state in ("cancelled", "done") for job in jobs)
    with pytest.raises(RuntimeError, match="closed"):
        worker.detect(model.stores[0], DETECTOR, Setup())
