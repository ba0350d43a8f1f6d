"""Sweeps of an episode log, cast again as its perception had them: the log holds scenario, seed, traffic and faults."""

import threading

import msgspec
import numpy as np

from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.loop import LoopSettings
from dsrc.closed_loop.perception.open import MODELLED, TELLING, WITHOUT_SENSOR, parse_perception, uses_helpers
from dsrc.closed_loop.perception.senses import Senses, sensed_every_s
from dsrc.faults.fault import parse_faults
from dsrc.messages.inbox import Inbox
from sensors.corruptions import Condition
from sensors.frame import AgentFrame, Frame
from sensors.presets import scenario_lidars
from sensors.recording.mounting import Mount, mount
from sim.geometry import Array
from sim.radio import IDEAL


class RecastSenses:
    """LiDARs of an episode that has ended, whose ego and helpers are those of the loop; threads may share it.

    A perception of one's own name is taken for one with helpers, as in `dsrc.closed_loop.causes`.

    Attributes:
        ready: whether the world is built, see `open`.
    """

    def __init__(self, log: EpisodeLog) -> None:
        self._log, settings = log, log.settings
        kind = parse_perception(settings.perception).kind
        self._truth = kind in WITHOUT_SENSOR
        self._cooperative = uses_helpers(kind)
        loop = msgspec.convert(settings.loop, LoopSettings)
        faults = parse_faults(settings.fault, "log") if settings.fault else ()
        radio = any(fault.radio for fault in faults)
        told = kind in TELLING or any(tick.percept is not None and tick.percept.told for tick in log.ticks)
        self._faults = () if self._truth else faults
        self._attacked = self._cooperative and not told and any(fault.attack for fault in self._faults)
        at_once = self._truth or not self._cooperative or (settings.channel in ("", IDEAL) and not radio)
        turned_s, told_s = (sensed_every_s(loop.detect_every_s, at_once=one) for one in (self._truth, at_once))
        self._every, self._told_every = (max(1, round(one / settings.scenario.step_s)) for one in (turned_s, told_s))
        self._times = np.array([tick.actors.time_s for tick in log.ticks])
        self._percepts = sorted({self._measured(row) for row, tick in enumerate(log.ticks) if tick.percept is not None})
        self._senses: Senses | None = None
        self._casting = threading.Lock()
        self.ready = False

    def lidar(self, row: int) -> Array:
        """Return the (4, 4) world pose of the ego's LiDAR behind the percept that the ego has at a step."""
        scenario, ego_id = self._log.settings.scenario, self._log.settings.ego_id
        actors = self._log.ticks[self._measured(row)].actors
        own, agents = actors.row(ego_id), scenario.agents
        place = Mount(agents.mount_xyz_m, agents.mount_pitch_deg)
        return actors.world_from_body()[own] @ mount(scenario_lidars(scenario)[0], actors.boxes.size[own, 2], place)

    def open(self) -> None:
        """Build the world; raises UserError where that fails."""
        with self._casting:
            self._begin()
        self.ready = True

    def agents(self, row: int) -> tuple[AgentFrame, ...]:
        """Return the agents behind the percept that the ego has at a step, ego first, each with the sweep that arrived.

        Helpers whose message is missing are left out; that of a late one is as old as it was.

        Raises:
            UserError: the world cannot be built.
        """
        percept = self._log.ticks[self._arrived(row)].percept
        now = self._measured(row)
        with self._casting:
            frame = self._frame(now)
            links = () if percept is None else percept.links
            if not links:
                return frame.agents
            heard = {link.sender: (link.sent - 1) * self._told_every for link in links if link.received}
            frames = {step: self._frame(step) for step in sorted({*heard.values()} - {now})} | {now: frame}
        own = self._log.settings.ego_id
        sent = {agent.agent_id: agent for step in frames.values() for agent in step.agents}
        sent |= {one: frames[step].agent(one) for one, step in heard.items()}
        return tuple(sent[agent.agent_id] for agent in frame.agents if agent.agent_id in (own, *heard))

    def _arrived(self, row: int) -> int:
        """Return the step at which the newest percept of a step arrived; the step itself before the first."""
        return next((k for k in range(row, -1, -1) if self._log.ticks[k].percept is not None), row)

    def _measured(self, row: int) -> int:
        percept = self._log.ticks[self._arrived(row)].percept
        return row if percept is None else int(np.abs(self._times - percept.time_s).argmin())

    def _begin(self) -> Senses:
        settings = self._log.settings
        condition = Condition() if self._truth else settings.condition
        self._senses = Senses(condition, self._cooperative, self._faults)
        self._senses.reset(settings.scenario, settings.ego_id, settings.seed)
        self._inbox, self._aimed = Inbox(self._faults, ()), 0
        self._inbox.reset(settings.seed, settings.ego_id)
        return self._senses

    def _frame(self, step: int) -> Frame:
        """Return the frame of a step at which the perception measured."""
        number, actors = step // self._every, self._log.actors
        senses = self._senses
        if senses is None or senses.index > number:
            senses = self._begin()
        while senses.index < number:
            earlier = senses.index * self._every
            senses.pass_over(actors[earlier], self._log.ticks[earlier].actors)
        tick = self._log.ticks[step]
        frame = senses.frame(actors[step], tick.actors, {} if self._truth else tick.claims)
        return self._shared(frame, step) if self._attacked else frame

    def _shared(self, frame: Frame, step: int) -> Frame:
        """Return what liars shared of a frame, whose ghosts stand by where the ego was at every percept until then."""
        for row in self._percepts[self._aimed :]:
            if row > step:
                break
            ego = self._log.ticks[row].ego
            self._inbox.aim(ego.box, ego.route, ego.time_s)
            self._aimed += 1
        truth = self._log.ticks[step].actors.boxes
        return frame.with_sweeps([self._inbox.measured(agent, truth, frame.time_s) for agent in frame.agents])


def recast_senses(log: EpisodeLog) -> RecastSenses | None:
    """Return the senses of an episode; None of a perception without sweeps."""
    kind = parse_perception(log.settings.perception).kind
    return None if kind in ("truth", MODELLED) else RecastSenses(log)
