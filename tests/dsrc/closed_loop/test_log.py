"""The episode log: all of an episode comes back, small, in equal bytes, and its traffic replays."""

import math
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dsrc.closed_loop.log import EpisodeLog, EpisodeSettings
from dsrc.closed_loop.types import Decision, Outcome, Percept, Tick, Tracks
from dsrc.messages.message import Told
from sim.boxes import Boxes
from sim.contact import Contact
from sim.errors import DataError
from sim.radio import Link, Obstruction
from sim.traffic.base import TrafficLight
from tests.dsrc.closed_loop.logged import EGO_ID, SCENARIO, Mover, actors_at, ahead, episode, ticks_of

HIT = Contact(0.75, 1001, "conflict", 12.3456789, 14.1, 7.1, "left", True)


def assert_same(left: Any, right: Any, where: str = "log") -> None:
    """Assert that two values are equal in every field, numbers bit for bit."""
    assert type(left) is type(right), where
    if is_dataclass(left):
        for field in fields(left):
            assert_same(getattr(left, field.name), getattr(right, field.name), f"{where}.{field.name}")
    elif isinstance(left, np.ndarray):
        assert left.dtype == right.dtype and left.shape == right.shape, where
        assert left.tobytes() == right.tobytes(), where
    elif isinstance(left, dict):
        assert list(left) == list(right), where
        for key in left:
            assert_same(left[key], right[key], f"{where}[{key}]")
    elif isinstance(left, tuple):
        assert len(left) == len(right), where
        for row, pair in enumerate(zip(left, right, strict=True)):
            assert_same(*pair, f"{where}[{row}]")
    else:
        assert left == right or (math.isnan(left) and math.isnan(right)), where


def boxes_of(rng: np.random.Generator, n: int, ids: list[int] | None = None) -> Boxes:
    rows = np.column_stack([rng.normal(0, 40, (n, 3)), rng.uniform(0.5, 9, (n, 3)), rng.uniform(-3, 3, n)])
    return Boxes.from_array(rows, rng.integers(0, 7, n), ids)


def full_log(rng: np.random.Generator | None = None) -> EpisodeLog:
    """Log with something of everything: missed percepts, unknown velocities, lost packets, lights, claims, a crash."""
    rng = rng or np.random.default_rng(1)
    movers = [
        Mover("ego", ahead(10.0)),
        Mover("conflict", lambda t: (30.0, 9.0 * t - 20.0)),
        Mover("bus", ahead(3.0, y=4)),
    ]
    before, bare = ticks_of(movers, 8)
    ticks = []
    for step, tick in enumerate(bare):
        n = int(rng.integers(0, 5))
        velocity = rng.normal(size=(n, 2))
        velocity[::2] = np.nan
        link = Link(
            -1, EGO_ID, step, 0.1, 0.05, 60_000, 11, rng.random(11) < 0.5, 31.4159, Obstruction.BUILDING, 0.9, 0.2
        )
        lost = replace(link, sender=1002, sent=-1, age_s=math.nan, delay_s=math.nan, arrived=np.zeros(11, bool))
        lost = replace(lost, held=True, offered=70_000)
        seen = Percept(tick.actors.time_s - 0.1, boxes_of(rng, n), rng.random(n), velocity, (link, lost)[: step % 3])
        seen = replace(seen, told=(Told(-1, 5, 2, 3, 1, True), Told(1002, 4, 0, 0, 0, False))[: step % 3])
        ids = sorted(rng.choice(20, n, replace=False).tolist())
        tracks = Tracks(
            tick.actors.time_s, boxes_of(rng, n, ids), rng.normal(size=(n, 2)), *(rng.random(n) for _ in range(4))
        )
        lights = (TrafficLight("red", 12.5), TrafficLight("green", 80.123456))[: step % 3]
        claims = {"truck": actors_at([Mover("ghost", ahead(2.0, x=9.0))], tick.actors.time_s)} if step > 4 else {}
        ticks.append(
            replace(
                tick,
                ego=replace(tick.ego, lights=lights, speed_mps=float(rng.random()), route=rng.normal(size=(step, 2))),
                percept=None if step == 3 else seen,
                tracks=tracks,
                decision=Decision(float(rng.normal()), ("follow", "emergency")[step % 2], step - 1),
                claims=claims,
                contact=HIT if step == 7 else None,
            )
        )
    settings = EpisodeSettings(
        scenario=SCENARIO, seed=3, ego_id=EGO_ID, perception="dsrc.pt", corruption="fog", severity=3,
        channel="its-g5-6", loop={"duration_s": 20.0}, route_m=74.5, versions={"numpy": "2"},
        fault="ghost:1", defence="motion",
    )  # fmt: skip
    return EpisodeLog(settings, before, ticks, Outcome.CRASHED, "")


def test_everything_of_an_episode_comes_back(tmp_path: Path) -> None:
    log = full_log()
    again = EpisodeLog.load(log.save(tmp_path / "episode.npz"))
    assert again.settings == log.settings
    assert (again.outcome, again.message) == (Outcome.CRASHED, "")
    assert again.contact == HIT
    assert len(again) == 8
    assert_same(again.ticks, log.ticks)


def test_a_log_rounds_boxes_and_routes_by_no_more_than_half_a_step_and_keeps_what_the_ego_knows_of_itself() -> None:
    _, (tick, *_) = ticks_of([Mover("ego", ahead(7.123456789, x=1 / 3))], 1)
    log = episode([Mover("ego", ahead(7.123456789, x=1 / 3))], 1)
    (kept,) = log.ticks
    assert kept.ego.speed_mps == tick.ego.speed_mps
    assert kept.ego.box.center.tobytes() == tick.ego.box.center.tobytes()
    assert np.abs(kept.actors.boxes.center - tick.actors.boxes.center).max() <= 0.5e-3
    assert np.abs(kept.ego.route - tick.ego.route).max() <= 0.5e-3


def test_equal_logs_are_equal_bytes_and_loading_loses_nothing(tmp_path: Path) -> None:
    first, second = full_log().save(tmp_path / "a.npz"), full_log().save(tmp_path / "b.npz")
    assert first.read_bytes() == second.read_bytes()
    assert EpisodeLog.load(first).save(tmp_path / "c.npz").read_bytes() == first.read_bytes()
    other = full_log(np.random.default_rng(2)).save(tmp_path / "d.npz")
    assert other.read_bytes() != first.read_bytes()


def test_a_replay_gives_the_same_actors_from_one_step_before_the_first_tick(tmp_path: Path) -> None:
    log = full_log()
    again = EpisodeLog.load(log.save(tmp_path / "episode.npz"))
    with again.replay() as replay:
        assert replay.actors.time_s == pytest.approx(-0.1)
        for tick in log.ticks:
            assert_same(replay.step(), tick.actors)


def test_an_episode_that_ended_at_once_has_a_log(tmp_path: Path) -> None:
    before, _ = ticks_of([Mover("ego", ahead(1.0))], 0)
    settings = EpisodeSettings(scenario=SCENARIO, seed=0, ego_id=EGO_ID)
    log = EpisodeLog(settings, before, [], Outcome.PERCEPTION_FAILED, "ValueError: no weights")
    again = EpisodeLog.load(log.save(tmp_path / "e.npz"))
    assert (again.outcome, again.message, len(again)) == (Outcome.PERCEPTION_FAILED, "ValueError: no weights", 0)


@pytest.mark.parametrize("value", [np.inf, 1e12])
def test_a_number_that_cannot_be_stored_is_refused_when_the_log_is_made(value: float) -> None:
    before, (tick, *_) = ticks_of([Mover("ego", ahead(1.0))], 1)
    boxes = Boxes.from_array([[value, 0, 0, 4, 2, 1.5, 0]])
    wild = Tick(tick.actors, tick.ego, Percept(0.0, boxes, np.ones(1), np.zeros((1, 2))), tick.tracks, tick.decision)
    with pytest.raises(ValueError, match="not finite or beyond"):
        EpisodeLog(EpisodeSettings(scenario=SCENARIO, seed=0, ego_id=EGO_ID), before, [wild], Outcome.TIMEOUT)


def test_twenty_seconds_with_a_hundred_actors_are_a_few_hundred_kilobytes(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    place, speed, phase = rng.uniform(-200, 200, (100, 2)), rng.uniform(0, 15, 100), rng.uniform(0, 6, 100)

    def motion(i: int) -> Callable[[float], tuple[float, float]]:
        return lambda t: tuple(place[i] + speed[i] * t * np.array([np.cos(phase[i]), np.sin(phase[i])]))

    movers = [Mover(f"v{i}", motion(i)) for i in range(100)]
    before, bare = ticks_of(movers, 200)
    ticks = []
    for tick in bare:
        near = tick.actors.boxes[:40]
        noisy = replace(near, center=near.center + rng.normal(0, 0.1, near.center.shape), object_id=np.full(40, -1))
        numbered = replace(near, object_id=np.arange(40))
        rest = (rng.normal(0, 0.1, 40), rng.random(40), rng.random(40), np.zeros(40))
        percept = Percept(tick.actors.time_s, noisy, rng.random(40), np.full((40, 2), np.nan))
        tracks = Tracks(tick.actors.time_s, numbered, tick.actors.velocity[:40], *rest)
        ticks.append(replace(tick, percept=percept, tracks=tracks))
    settings = EpisodeSettings(scenario=SCENARIO, seed=0, ego_id=EGO_ID)
    path = EpisodeLog(settings, before, ticks, Outcome.TIMEOUT).save(tmp_path / "big.npz")
    assert path.stat().st_size < 400_000


def test_logs_of_earlier_versions_hold_nobody_back(tmp_path: Path) -> None:
    path = full_log().save(tmp_path / "log.npz")
    with np.load(path) as columns:
        np.savez(tmp_path / "old.npz", **{name: column for name, column in columns.items() if name != "link/held"})
    for name, held in (("log.npz", True), ("old.npz", False)):
        percepts = [tick.percept for tick in EpisodeLog.load(tmp_path / name).ticks if tick.percept is not None]
        assert any(link.held for percept in percepts for link in percept.links) is held


def test_damaged_logs_are_told_in_one_line(tmp_path: Path) -> None:
    good = full_log().save(tmp_path / "good.npz")
    columns = dict(np.load(good))
    content = good.read_bytes()
    for name, damaged in {"cut": content[:-300], "text": b"no archive", "empty": b"", "half": content[:2000]}.items():
        (tmp_path / name).write_bytes(damaged)
    np.savez(tmp_path / "foreign.npz", points=np.zeros(3))
    wrong = {
        "old": {"episode": np.array(0)},
        "odd": {"episode": np.array("one")},
        "about": {"about": np.array('{"settings": {}}')},
        "json": {"about": np.array("no json")},
        "outcome": {"about": np.array(str(columns["about"]).replace("crashed", "vanished"))},
        "actors": {"actors/run/length": columns["actors/run/length"] + 1},
        "count": {"percept/count": columns["percept/count"] * 1000},
        "huge": {"track/count": columns["track/count"] + 2**62},
        "negative": {"route/count": -columns["route/count"]},
        "label": {"track/label": columns["track/label"] + 80},
        "planes": {"track/x": np.zeros((9, columns["track/x"].shape[1]), np.uint8)},
        "short": {"track/x": columns["track/x"][:, :-1]},
        "kind": {"ego/numbers": columns["ego/numbers"].astype(np.float32)},
        "lights": {"light/state": columns["light/state"] + 9},
        "reason": {"decision/reason": columns["decision/reason"] - 1},
        "packets": {"link/ids": columns["link/ids"] + 2**40},
        "claims": {"claim0/steps": columns["claim0/steps"] + 100},
        "contact": {"contact/ids": columns["contact/ids"] + 100},
        "flat": {"percept/present": columns["percept/present"][:, None]},
        "steps": {"decision/track": columns["decision/track"][:-1]},
        "told": {"told": columns["told"] + 100},
        "toldless": {"told": columns["told"][:, 1:]},
    }
    for name, change in wrong.items():
        np.savez(tmp_path / f"{name}.npz", **{**columns, **change})
    names = ("cut", "text", "empty", "half", *(f"{stem}.npz" for stem in ("foreign", "missing", *wrong)))
    for name in names:
        with pytest.raises(DataError) as caught:
            EpisodeLog.load(tmp_path / name)
        assert name in str(caught.value) and "\n" not in str(caught.value), name
    for name in sorted(set(columns) - {"link/held", "link/offered", "told"}):
        np.savez(tmp_path / "less.npz", **{key: value for key, value in columns.items() if key != name})
        with pytest.raises(DataError, match=r"less\.npz"):
            EpisodeLog.load(tmp_path / "less.npz")
