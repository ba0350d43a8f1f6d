"""What the tracker makes of driven episodes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.tracking.tracker import Tracker
from dsrc.closed_loop.types import Outcome, Percept
from sim.traffic.base import Actors
from tests.commands import run_study, study
from tests.dsrc.closed_loop.logged import Mover, ahead, episode, ticks_of


def test_false_tracks_and_late_ones_are_counted(tmp_path: Path) -> None:
    """A car that is found from 1 s on, and a box 20 m beside it in each of the 45 percepts, where nobody is."""

    def sees(now: Actors) -> Percept:
        boxes = now.boxes[[1, 1]]
        boxes = replace(boxes, center=boxes.center + np.array([[0.0, 0.0, 0.0], [0.0, 20.0, 0.0]]))
        score = np.array([0.7 if now.time_s > 0.95 else 0.05, 0.7])
        return Percept(now.time_s, boxes, score, np.full((2, 2), np.nan))

    movers = [Mover("ego", ahead(0.0)), Mover("car", ahead(5.0, x=30.0))]
    (tmp_path / "episodes").mkdir()
    episode(movers, 45, sees=sees, detector="0" * 64).save(tmp_path / "episodes/one.npz")
    printed = study("closed_loop.tracking", str(tmp_path), "--set", "ghosts_per_m2=1e9").splitlines()
    assert {"| 0 to 0.1 | 10 | 100 |", "| 0.7 to 1 | 80 | 44 |"} <= set(printed)
    now, never = (line.split(" | ")[1:] for line in printed[-2:])
    # Both are known from their second box on: the false one in 44 of 45 instants, the car a second late.
    assert now == ["45", "0.98", "0.98", "76", "1.10", "0 |"]
    assert never == ["45", "0.00", "0.00", "0", "3.00", "100 |"]


def test_what_a_perception_knows_of_the_conflict_actor_is_counted(tmp_path: Path) -> None:
    """A car that is in every second percept from 1 s on, with a score of 0.4."""

    def sees(now: Actors) -> Percept:
        seen = now.time_s > 0.95 and round(10 * now.time_s) % 2 == 0
        boxes = now.boxes[[1] if seen else []]
        return Percept(now.time_s, boxes, np.full(len(boxes), 0.4), np.full((len(boxes), 2), np.nan))

    movers = [Mover("ego", ahead(0.0)), Mover("conflict", ahead(5.0, x=30.0))]
    before, ticks = ticks_of(movers, 45, sees)
    tracker = Tracker()
    ticks = [replace(tick, tracks=tracker.update(tick.percept, tick.ego.time_s)) for tick in ticks]
    (tmp_path / "episodes").mkdir()
    settings = episode(movers, 1, detector="0" * 64, perception="team").settings
    other = episode(movers, 1, detector="1" * 64, perception="team", corruption="snow", severity=3).settings
    EpisodeLog(settings, before, ticks, Outcome.TIMEOUT).save(tmp_path / "episodes/one.npz")
    EpisodeLog(other, before, ticks[:5], Outcome.TIMEOUT).save(tmp_path / "episodes/other.npz")
    script, scenario = "closed_loop.tracking", settings.scenario.name
    head, _, row, never = study(script, str(tmp_path), "--scenario", scenario).splitlines()[-4:]
    assert head.split(" | ")[2:5] == ["episodes", "percepts with a box of it, %", "median score"]
    name, condition, episodes, boxed, score, tracked = row.strip("| ").split(" | ")
    assert (name, condition, episodes, score) == ("team 00000000", "clean", "1", "0.40")
    assert float(boxed) == pytest.approx(50, abs=2)
    assert 50 < float(tracked) < 100, tracked  # one weak box confirms no track
    assert never == "| team 11111111 | snow 3 | 1 | - | - | - |"
    wrong = run_study(script, str(tmp_path), "--scenario", scenario, "elsewhere")
    assert wrong.returncode == 2 and f"--scenario: expected some of {scenario}, found elsewhere" in wrong.stderr
