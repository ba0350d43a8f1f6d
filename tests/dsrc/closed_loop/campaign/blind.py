"""Perceptions that see nothing, a driver that faints, and a campaign of two short episodes with one."""

import numpy as np

from dsrc.closed_loop.campaign.plan import Campaign, PerceptionSpec
from dsrc.closed_loop.loop import LoopSettings
from dsrc.closed_loop.types import Decision, EgoState, LaneMap, Percept, Tracks
from sim.boxes import VEHICLES, Boxes
from sim.scenario import Scenario
from sim.traffic.base import Actors

EYES = __name__
"""Module of the perceptions, as `module:Class` names it."""

PLAN = Campaign(
    scenarios=("ima_building",),
    perceptions=(PerceptionSpec(name="truth"), PerceptionSpec(name="nothing", uses=f"{__name__}:Blind")),
    corruption=("clean",),
    clean_seeds=2,
    seeds=1,
    loop=LoopSettings(duration_s=15.0),
    controls=False,
    careful=False,
)


class Blind:
    """Perceives nothing."""

    cooperative = False

    def reset(self, scenario: Scenario, ego_id: int, seed: int) -> None:
        pass

    def perceive(self, before: Actors, now: Actors, claims: dict[str, Actors]) -> Percept:
        return Percept(now.time_s, Boxes.zeros(), np.zeros(0), np.zeros((0, 2)))


class BlindForPeople(Blind):
    """Perceives nothing, and says that it has classes for vehicles alone."""

    classes = VEHICLES


class Broken(Blind):
    """Fails after a while."""

    def perceive(self, before: Actors, now: Actors, claims: dict[str, Actors]) -> Percept:
        if now.time_s > 1.0:
            raise MemoryError("no memory left")
        return super().perceive(before, now, claims)


class Fainting:
    """Driver that fails after a second."""

    def reset(self, lanes: LaneMap | None) -> None:
        pass

    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        if ego.time_s > 1.0:
            raise ZeroDivisionError("nobody\nis there")
        return Decision(0.0)
