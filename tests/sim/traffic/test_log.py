"""The traffic log and its replay: what was recorded comes back bit for bit, and without SUMO."""

import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from sim.boxes import Boxes
from sim.errors import DataError, TrafficError
from sim.geometry import wrap_angle
from sim.traffic.base import Actors
from sim.traffic.log import TrafficLog
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
        roll=rng.normal(size=n),
    ).rounded()


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


def test_a_saved_run_replays_bit_for_bit(tmp_path: Path) -> None:
    log = example()
    with ReplayTraffic(log.save(tmp_path / "traffic.npz")) as replay:
        assert len(replay) == 4 and replay.step_s == 0.1
        assert_equal(replay.actors, log[0])
        for step in range(1, 4):
            assert_equal(replay.step(), log[step])
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
    wrong = {
        "short": {"row/yaw": columns["row/yaw"][:, :-1]},
        "object": {"run/object": columns["run/object"] + 50},
        "order": {"run/object": columns["run/object"][::-1]},
        "lane": {"lane/name": columns["lane/name"][:1]},
        "old": {"version": np.array(2)},
        "label": {"object/label": columns["object/label"] + 50},
        "step": {"step_s": np.array(0.0)},
        "nan": {"step_s": np.array(np.nan)},
        "count": {"run/length": columns["run/length"] * 0},
        "late": {"run/start": columns["run/start"] + 9},
        "twice": {"object/id": np.array([1000, 1000, 1003, 1004])},
        "kind": {"row/yaw": columns["row/yaw"].astype(np.float32)},
        "flat": {"row/yaw": columns["row/yaw"].ravel()},
        "roll": {"row/roll": columns["row/roll"][:, :-1]},
        "tilt": {"row/roll": columns["row/roll"].astype(np.float32)},
        "name": {"object/name": np.array([{}] * 4, dtype=object)},
        "about": {"about": np.array("[1]")},
    }
    for name, change in wrong.items():
        np.savez(tmp_path / f"{name}.npz", **{**columns, **change})
    for name in (*cases, *(f"{stem}.npz" for stem in ("other", "missing", *wrong))):
        with pytest.raises(DataError) as caught:
            ReplayTraffic(tmp_path / name)
        assert name in str(caught.value) and "\n" not in str(caught.value)


def test_rounding_moves_nothing_by_more_than_half_a_step_and_again_by_nothing() -> None:
    rng = np.random.default_rng(0)
    exact = actors(1.0 / 3.0, [1000, 1001, 1002], rng)
    moved = replace(exact, boxes=replace(exact.boxes, center=exact.boxes.center + rng.normal(size=(3, 3))))
    rounded = moved.rounded()
    assert np.abs(rounded.boxes.center - moved.boxes.center).max() <= 0.5e-3 + 1e-12
    assert_equal(rounded.rounded(), rounded)
    with pytest.raises(ValueError, match="not finite"):
        replace(moved, pitch=np.full(3, np.nan)).rounded()


def test_a_log_says_what_it_is_of_and_is_a_few_bytes_per_actor_and_step(tmp_path: Path) -> None:
    """Forty cars in curves, their speeds and accelerations the differences of their places, for 20 s."""
    time, cars = 0.1 * np.arange(-2, 200), np.arange(40)
    heading = 0.1 * np.sin(time[:, None] * 0.3 + cars) + cars
    speed = 10.0 + 3.0 * np.sin(time[:, None] * 0.2 + cars)
    velocity = speed[..., None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    place = 0.1 * np.cumsum(velocity, axis=0) + 1000.0
    log = TrafficLog(0.1, {"scenario": "curves"})
    base = actors(0.0, (1000 + cars).tolist(), np.random.default_rng(0))
    for step in range(2, 202):
        center = np.concatenate([place[step], np.full((40, 1), 0.75)], axis=1)
        boxes = replace(base.boxes, center=center, yaw=wrap_angle(heading[step]))
        now = (place[step] - place[step - 1]) / 0.1
        before = (place[step - 1] - place[step - 2]) / 0.1
        rows = {"velocity": now, "acceleration": (now - before) / 0.1, "pitch": np.zeros(40), "roll": np.zeros(40)}
        log.append(replace(base, time_s=float(time[step]), boxes=boxes, **rows))
    path = log.save(tmp_path / "curves.npz")
    again = TrafficLog.load(path)
    assert again.about == {"scenario": "curves"}
    for step in range(200):
        assert_equal(again[step], log[step])
    assert path.stat().st_size < 6 * 40 * 200


def test_a_log_of_bodies_that_do_not_roll_is_what_it_was_before_they_could(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    upright, rolling = TrafficLog(0.1), TrafficLog(0.1)
    for step in range(3):
        now = actors(0.1 * step, [1000, 1001], rng)
        rolling.append(now)
        upright.append(replace(now, roll=np.zeros(2)))
    assert set(rolling.columns()) - set(upright.columns()) == {"row/roll"}
    with ReplayTraffic(upright.save(tmp_path / "traffic.npz")) as replay:
        assert_equal(replay.actors, upright[0])
        assert not replay.actors.roll.any()


def test_a_log_within_an_area_keeps_the_whole_way_of_who_is_ever_there() -> None:
    log = TrafficLog(1.0)
    rng = np.random.default_rng(1)
    for step in range(4):
        now = actors(float(step), [1000, 1001, 1002], rng)
        center = np.array([[-100.0 + 50.0 * step, 0.0, 0.0], [0.0, 500.0, 0.0], [60.0, 5.0, 0.0]])
        log.append(replace(now, boxes=replace(now.boxes, center=center)))
    kept = log.within((40.0, -10.0, 80.0, 10.0))
    assert [kept[step].boxes.object_id.tolist() for step in range(4)] == [[1000, 1002]] * 4
    assert kept[2].lane == (log[2].lane[0], log[2].lane[2])


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
