"""Episodes made by hand: movers on given motions, and what the ego perceives of them."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dsrc.closed_loop.log import EpisodeLog, EpisodeSettings
from dsrc.closed_loop.types import Decision, EgoState, Outcome, Percept, Tick, Tracks
from sim.boxes import CLASSES, Boxes
from sim.contact import Contact
from sim.radio import Link
from sim.scenario import AgentRule, Scenario
from sim.traffic.base import Actors, Limits

STEP_S = 0.1
EGO_ID = 1000
CAR = (4.0, 2.0, 1.6)
LIMITS = Limits(speed_mps=13.9, acceleration_mps2=2.6, deceleration_mps2=7.5)
SCENARIO = Scenario(name="by_hand", description="Made by hand.", agents=AgentRule())


@dataclass(frozen=True)
class Mover:
    """Road user whose centre, (x, y) in m, is a function of the time in s; it looks where it goes, or at `yaw`."""

    name: str
    at: Callable[[float], tuple[float, float]]
    yaw: float | None = None
    size: tuple[float, float, float] = CAR
    label: str = "car"
    lane: str = "lane_0"


def ahead(speed_mps: float, x: float = 0.0, y: float = 0.0) -> Callable[[float], tuple[float, float]]:
    """Motion along +x at a constant speed."""
    return lambda time_s: (x + speed_mps * time_s, y)


def actors_at(movers: Sequence[Mover], time_s: float) -> Actors:
    now, before, earlier = (
        np.array([m.at(time_s - k * STEP_S) for m in movers], float).reshape(-1, 2) for k in range(3)
    )
    velocity, past = (now - before) / STEP_S, (before - earlier) / STEP_S
    yaw = [np.arctan2(v[1], v[0]) if m.yaw is None else m.yaw for m, v in zip(movers, velocity, strict=True)]
    size = np.array([m.size for m in movers], float).reshape(-1, 3)
    n = len(movers)
    return Actors(
        time_s=time_s,
        boxes=Boxes(
            center=np.column_stack([now, 0.5 * size[:, 2]]),
            size=size,
            yaw=np.array(yaw, float),
            label=np.array([CLASSES.index(m.label) for m in movers], np.int64),
            object_id=EGO_ID + np.arange(n),
        ),
        pitch=np.zeros(n),
        velocity=velocity,
        acceleration=(velocity - past) / STEP_S,
        model=("body",) * n,
        name=tuple(m.name for m in movers),
        signals=np.zeros(n, np.int32),
        lane=tuple(m.lane for m in movers),
    )


def no_tracks(time_s: float) -> Tracks:
    return Tracks(time_s, Boxes.zeros(), np.zeros((0, 2)), *(np.zeros(0) for _ in range(4)))


def percept_of(actors: Actors, rows: Sequence[int], links: Iterable[Link] = ()) -> Percept:
    """Percept of some actors, their ids kept."""
    chosen = np.array(rows, np.int64)
    return Percept(actors.time_s, actors.boxes[chosen], np.ones(len(chosen)), actors.velocity[chosen], tuple(links))


def ticks_of(
    movers: Sequence[Mover], steps: int, sees: Callable[[Actors], Percept | None] = lambda actors: None
) -> tuple[Actors, list[Tick]]:
    """Actors one step before, and the ticks of an episode whose first mover is the ego; times begin at 0."""
    ticks, driven = [], 0.0
    for step in range(steps):
        actors = actors_at(movers, STEP_S * step)
        speed = float(np.linalg.norm(actors.velocity[0]))
        driven += speed * STEP_S if step else 0.0
        ego = EgoState(
            time_s=actors.time_s,
            box=actors.boxes[:1],
            speed_mps=speed,
            acceleration_mps2=0.0,
            route=actors.boxes.center[:1, :2] + np.array([[0.0, 0.0], [50.0, 0.0], [100.0, 0.0]]),
            limits=LIMITS,
            lights=(),
            progress_m=driven,
        )
        ticks.append(Tick(actors, ego, sees(actors), no_tracks(actors.time_s), Decision(0.0, "free")))
    return actors_at(movers, -STEP_S), ticks


def episode(
    movers: Sequence[Mover],
    steps: int,
    outcome: Outcome = Outcome.TIMEOUT,
    *,
    contact: Contact | None = None,
    sees: Callable[[Actors], Percept | None] = lambda actors: None,
    **settings: Any,
) -> EpisodeLog:
    """Log of an episode; a contact is in its last tick."""
    before, ticks = ticks_of(movers, steps, sees)
    if contact is not None:
        ticks[-1] = replace(ticks[-1], contact=contact)
    about = EpisodeSettings(**{"scenario": SCENARIO, "seed": 0, "ego_id": EGO_ID, **settings})
    return EpisodeLog(about, before, ticks, outcome)
