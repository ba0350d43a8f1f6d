"""The traffic log and its replay: what was recorded comes back bit for bit, and without SUMO."""

import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from sim.boxes import Boxes
from sim.errors import DataError, TrafficError
from sim.traffic.base import Actors
from sim.traffic.log import RecordingTraffic, TrafficLog
from sim.traffic.replay import ReplayTraffic


def actors(time_s: float, ids: list[int], rng: np.random.Generator) -> Actors:
    n = len(ids)
    rows = np.column_stack(
        [rng.normal(size=(n, 3)), np.array([[4 + i / 1e4, 2, 1.5] for i in ids]).reshape(n, 3), rng.uniform(-3, 3, n)]
    )
    return Actors(
        time_s=time_s,
        boxes=Boxes.from_array(rows, label=[i % 7 for i in ids], object_id=ids),
        pitch=rng.normal(size=n),
        velocity=rng.normal(size=(n, 2)),
        acceleration=rng.normal(size=(n, 2)),
        model=tuple(f"model:{i}" for i in ids),
        name=tuple(f"v{i}" for i in ids),
        signals=rng.integers(0, 9, n).astype(np.int32),
        lane=tuple("" if i % 2 else f"lane_{i % 3}" for i in ids),
    )


def example() -> TrafficLog:
    rng = np.random.default_rng(4)
    log = TrafficLog(0.1)
    for step, ids in enumerate(([1000, 1001], [], [1000, 1003, 1004], [1003])):
        log.append(actors(5.0 + 0.1 * step, ids, rng))
    return log


def assert_equal(left: Actors, right: Actors) -> None:
    assert left.time_s == right.time_s
    assert (left.model, left.name, left.lane) == (right.model, right.name, right.lane)
    for owner in ((left, right), (left.boxes, right.boxes)):
        for field in fields(owner[0]):
            values = [getattr(side, field.name) for side in owner]
            if isinstance(values[0], np.ndarray):
                assert values[0].dtype == values[1].dtype and values[0].shape == values[1].shape
                assert values[0].tobytes() == values[1].tobytes(), field.name


class FakeTraffic:
    step_s = 0.1

    def __init__(self, log: TrafficLog) -> None:
        self.log, self.index, self.closed = log, 0, False

    @property
    def actors(self) -> Actors:
        return self.log[self.index]

    def step(self) -> Actors:
        self.index += 1
        return self.actors

    def close(self) -> None:
        self.closed = True


def test_a_recorded_run_replays_bit_for_bit(tmp_path: Path) -> None:
    inner = FakeTraffic(example())
    with RecordingTraffic(inner, tmp_path / "traffic.npz") as traffic:
        for _ in range(3):
            traffic.step()
    assert inner.closed
    with ReplayTraffic(tmp_path / "traffic.npz") as replay:
        assert len(replay) == 4 and replay.step_s == 0.1
        assert_equal(replay.actors, inner.log[0])
        for step in range(1, 4):
            assert_equal(replay.step(), inner.log[step])
        with pytest.raises(TrafficError, match="ends after 4 steps"):
            replay.step()
    with pytest.raises(TrafficError, match="closed"):
        replay.step()


def test_equal_logs_are_equal_bytes_and_no_partial_file_stays(tmp_path: Path) -> None:
    first, second = example().save(tmp_path / "a.npz"), example().save(tmp_path / "b.npz")
    assert first.read_bytes() == second.read_bytes()
    assert TrafficLog.load(first).save(tmp_path / "c.npz").read_bytes() == first.read_bytes()
    assert {p.name for p in tmp_path.iterdir()} == {"a.npz", "b.npz", "c.npz"}


def test_an_object_that_changes_its_size_is_a_bug() -> None:
    log = example()
    grown = actors(9.0, [1000], np.random.default_rng(0))
    grown.boxes.size[0, 0] = 9.0
    with pytest.raises(ValueError, match="object 1000 changed"):
        log.append(grown)


def test_damaged_logs_are_told_in_one_line(tmp_path: Path) -> None:
    good = example().save(tmp_path / "good.npz")
    columns = dict(np.load(good))
    cases = {
        "truncated": good.read_bytes()[:-200],
        "text": b"no archive",
        "empty": b"",
    }
    for name, content in cases.items():
        (tmp_path / name).write_bytes(content)
    np.savez(tmp_path / "other.npz", points=np.zeros(3))
    np.savez(tmp_path / "short.npz", **{**columns, "row/yaw": columns["row/yaw"][:-1]})
    np.savez(tmp_path / "ids.npz", **{**columns, "row/object": columns["row/object"] + 50})
    np.savez(tmp_path / "lane.npz", **{**columns, "row/lane": columns["row/lane"] + 50})
    np.savez(tmp_path / "old.npz", **{**columns, "version": np.array(1)})
    np.savez(tmp_path / "label.npz", **{**columns, "object/label": columns["object/label"] + 50})
    np.savez(tmp_path / "nan.npz", **{**columns, "row/center": columns["row/center"] * np.nan})
    np.savez(tmp_path / "step.npz", **{**columns, "step_s": np.array(0.0)})
    np.savez(tmp_path / "count.npz", **{**columns, "step/count": np.array([3, -1, 3, 1])})
    np.savez(tmp_path / "twice.npz", **{**columns, "object/id": np.array([1000, 1000, 1003, 1004])})
    np.savez(tmp_path / "kind.npz", **{**columns, "row/yaw": columns["row/yaw"].astype(np.float32)})
    np.savez(tmp_path / "object.npz", **{**columns, "object/name": np.array([{}] * 4, dtype=object)})
    made = (
        "other",
        "short",
        "ids",
        "lane",
        "old",
        "label",
        "nan",
        "step",
        "count",
        "twice",
        "kind",
        "object",
        "missing",
    )
    for name in (*cases, *(f"{stem}.npz" for stem in made)):
        with pytest.raises(DataError) as caught:
            ReplayTraffic(tmp_path / name)
        assert name in str(caught.value) and "\n" not in str(caught.value)


def test_a_log_without_steps_cannot_be_replayed(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="at least one step"):
        ReplayTraffic(TrafficLog(0.1).save(tmp_path / "none.npz"))


def test_replay_does_not_import_sumo(tmp_path: Path) -> None:
    path = example().save(tmp_path / "traffic.npz")
    code = (
        "import sys; from sim.traffic.replay import ReplayTraffic\n"
        f"t = ReplayTraffic({str(path)!r}); t.step()\n"
        "found = {'libsumo', 'traci', 'sumolib', 'sumo', 'torch'} & set(sys.modules)\n"
        "sys.exit(f'imported {found}' if found else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
