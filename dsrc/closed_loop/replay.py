"""Replay of an episode: the same traffic, bit for bit, for the same or for other eyes.

The ego moves as it did in the log, whatever its eyes see now: two perceptions of one replay differ in nothing but
themselves. What its driver would have decided is in the ticks.
"""

import msgspec
import numpy as np

from dsrc.closed_loop.driving.lanes import lanes_of
from dsrc.closed_loop.driving.own.checked import CheckedDriver
from dsrc.closed_loop.driving.planner import PlanningDriver
from dsrc.closed_loop.ego import without_ego
from dsrc.closed_loop.ego_faults import EgoFaults
from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.loop import LoopSettings, PerceptionClock
from dsrc.closed_loop.tracking.tracker import Tracker
from dsrc.closed_loop.types import Decision, Driver, Outcome, Perception, Tick


def replay(log: EpisodeLog, perception: Perception, name: str, driver: Driver | None = None) -> EpisodeLog:
    """Return the log of an episode with the percepts, tracks and decisions of another perception.

    Args:
        name: of the perception, for the log.
        driver: decides by its tracks; default: `PlanningDriver`.
    """
    settings = log.settings
    loop = msgspec.convert(settings.loop, LoopSettings)
    wheel, tracker = CheckedDriver(driver or PlanningDriver(), loop.perception_limit_s), Tracker()
    wheel.reset(lanes_of(settings.scenario, settings.seed))
    own = EgoFaults(getattr(perception, "faults", ()), settings.seed, settings.ego_id, settings.scenario.step_s)
    clock = PerceptionClock(perception, loop, settings.scenario.step_s, own)
    clock.begin(settings.scenario, settings.ego_id, settings.seed)
    times = np.array([tick.ego.time_s for tick in log.ticks])
    before, ticks, outcome, message = log.actors[0], list[Tick](), log.outcome, log.message
    for tick in log.ticks:
        if settings.ego_id not in tick.actors.boxes.object_id:
            break
        percept = wheel.shown(clock.percept(before, tick.actors, tick.claims, tick.ego))
        if clock.failure:
            outcome, message = Outcome.PERCEPTION_FAILED, clock.failure
            break
        others = None
        if percept is not None:
            measured = log.ticks[int(np.abs(times - percept.time_s).argmin())].ego
            others = without_ego(percept, own.believed(measured, measured.time_s - times[0]))
        tracks = tracker.update(others, tick.actors.time_s)
        known = own.believed(tick.ego, tick.ego.time_s - times[0])
        decision = wheel.decide(known, tracks) if tick.contact is None else Decision(0.0)
        if wheel.failure and tick.contact is None:
            outcome, message = Outcome.DRIVER_FAILED, wheel.failure
            break
        ticks.append(Tick(tick.actors, tick.ego, percept, tracks, decision, tick.claims, tick.contact))
        before = tick.actors
    return EpisodeLog(msgspec.structs.replace(settings, perception=name), log.actors[0], ticks, outcome, message)
