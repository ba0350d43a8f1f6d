"""Closed loop of several egos in one traffic: each with its own perception, tracker and driver, helpers of each other.

Each ego is a `ClosedLoop` that shares the traffic with the others; an episode of one is that of `ClosedLoop`, and has
the same bytes.
"""

from collections.abc import Mapping, Sequence

import msgspec

from dsrc.closed_loop.ego import choose_egos
from dsrc.closed_loop.loop import ClosedLoop, LoopSettings
from dsrc.closed_loop.types import Driver, Outcome, Perception
from sensors.recording.encounter_check import with_proven_encounter
from sim.catalog.load import load_scenario
from sim.errors import SettingsError, complaint
from sim.scenario import Scenario
from sim.traffic.base import DrivableTraffic
from sim.world.standing import open_standing


class TeamLoop:
    """Episodes of several egos, see the module.

    Attributes:
        loops: of the egos; their ticks, outcomes and logs are those of one each.

    Args:
        scenario: name, path or struct. Several egos name each other as agents: with a perception that has helpers, they
            are each other's.
        perceptions: one of each ego; not one object twice.
        drivers: of each ego; default: `PlanningDriver`.
        settings: intervals and limits of time.

    Raises:
        SettingsError: no perception, another number of drivers, or one object of two egos.
    """

    def __init__(
        self,
        scenario: str | Scenario,
        perceptions: Sequence[Perception],
        drivers: Sequence[Driver] | None = None,
        settings: LoopSettings | None = None,
    ) -> None:
        self.base = load_scenario(scenario) if isinstance(scenario, str) else scenario
        given = [None] * len(perceptions) if drivers is None else list(drivers)
        if not perceptions or len(given) != len(perceptions):
            expected = "as many drivers as perceptions, one or more"
            raise SettingsError(complaint("team", "drivers", expected, f"{len(given)} and {len(perceptions)}"))
        own = [id(one) for one in (*perceptions, *given) if one is not None]
        if len(set(own)) < len(own):
            raise SettingsError(complaint("team", "perceptions, drivers", "an object for each ego", "one of two egos"))
        both = zip(perceptions, given, strict=True)
        self.loops = tuple(ClosedLoop(self.base, eyes, driver, settings) for eyes, driver in both)
        self._traffic: DrivableTraffic | None = None

    @property
    def running(self) -> tuple[int, ...]:
        """Numbers of the egos whose episodes have not ended, from 0."""
        return tuple(number for number, loop in enumerate(self.loops) if loop.outcome is None)

    def start(self, seed: int) -> None:
        """Begin the episode of a seed: open its traffic, choose the egos, and let all perceive for the first time.

        Raises:
            ScenarioError: network, demand or encounter is invalid.
            TrafficError: another simulation runs in this process, or too few vehicles can be egos.
        """
        self.close()
        scenario = with_proven_encounter(self.base, seed)
        self._traffic = traffic = open_standing(scenario, seed)
        try:
            self._board(traffic, scenario, seed)
        except BaseException:
            self.close()
            raise

    def _board(self, traffic: DrivableTraffic, scenario: Scenario, seed: int) -> None:
        """Choose the egos, and let all perceive for the first time."""
        egos = choose_egos(traffic, scenario, len(self.loops))
        if len(egos) > 1:
            names = [traffic.actors.name[traffic.actors.row(ego)] for ego in egos]
            named = dict.fromkeys([*names, *scenario.agents.named])
            agents = msgspec.structs.replace(scenario.agents, named=tuple(named))
            scenario = msgspec.structs.replace(scenario, agents=agents)
        for loop, ego in zip(self.loops, egos, strict=True):
            loop.board(scenario, traffic, ego, seed)
        traffic.step()
        for loop in self.loops:
            loop.look()

    def advance(self, accelerations_mps2: Mapping[int, float] | None = None) -> None:
        """Act for one traffic step with every ego whose episode runs, move once, and let each see what has become.

        An ego that has crashed brakes and stands in the way; one whose episode has ended otherwise is traffic.

        Args:
            accelerations_mps2: in place of the drivers' decisions, by the number of the ego.

        Raises:
            ValueError: an acceleration is not finite.
            TrafficError: the episode has not begun, or all have ended.
        """
        running, given = self.running, accelerations_mps2 or {}
        traffic = self.loops[0].traffic
        for number in running or (0,):  # a loop says it when all have ended
            self.loops[number].act(given.get(number))
        before = traffic.actors
        traffic.step()
        for number in running:
            loop = self.loops[number]
            loop.arrive(before)
            if loop.outcome is not None and loop.ego_id in traffic.actors.boxes.object_id:
                traffic.command(loop.ego_id, 0.0 if loop.outcome is Outcome.CRASHED else None)

    def run(self, seed: int) -> tuple[Outcome, ...]:
        """Drive a whole episode by the drivers' decisions and return the outcomes of the egos."""
        self.start(seed)
        try:
            while self.running:
                self.advance()
        finally:
            self.close()
        return tuple(loop.outcome for loop in self.loops if loop.outcome is not None)

    def close(self) -> None:
        """End the traffic; ticks and outcomes stay."""
        if self._traffic is not None:
            self._traffic.close()
            self._traffic = None
