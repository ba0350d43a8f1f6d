"""PettingZoo's parallel environment of several egos in one traffic, each as in a gymnasium environment of ours."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Space
from pettingzoo import ParallelEnv

from dsrc.closed_loop.environments.driving import DrivingEnv
from dsrc.closed_loop.loop import ClosedLoop, LoopSettings
from dsrc.closed_loop.perception.open import open_perception
from dsrc.closed_loop.team import TeamLoop
from dsrc.closed_loop.types import Perception, Tick
from sim.errors import SettingsError, complaint


class TeamEnv(ParallelEnv):
    """Several egos in simulated traffic, agents `ego_0`, `ego_1` and so on, see `parallel_env`.

    Observation, action, reward and info of each agent are those of `DrivingEnv`. An agent whose episode has ended
    leaves `agents`.

    Args:
        scenario: name, path or struct.
        egos: number of them.
        perception: of all, or one of each; texts, or objects that no two egos share.
        action: highway-env's settings of the action, without steering.
        settings: others of `DrivingEnv.default_config`.

    Raises:
        SettingsError: an unknown setting, an action that steers, or another number of perceptions than egos.
    """

    metadata: dict[str, Any] = {"name": "dsrc_team_v0", "render_modes": [], "is_parallelizable": True}  # noqa: RUF012

    def __init__(
        self,
        scenario: Any,
        egos: int,
        perception: str | Sequence[str | Perception],
        action: Mapping[str, object],
        **settings: Any,
    ) -> None:
        if action.get("lateral"):
            raise SettingsError(complaint("environment", "action", "one without steering", "lateral = True"))
        eyes = [perception] * egos if isinstance(perception, str) else list(perception)
        if egos < 1 or len(eyes) != egos:
            expected = f"one or more egos, and a perception of all or one of each of {egos}"
            raise SettingsError(complaint("environment", "perception", expected, f"{len(eyes)}"))
        known = DrivingEnv.default_config() | settings
        loop = LoopSettings(
            duration_s=known["duration"], detect_every_s=known["detect_every_s"], latency_s=known["latency_s"]
        )
        interval_s = loop.detect_every_s
        opened = [open_perception(one, interval_s=interval_s) if isinstance(one, str) else one for one in eyes]
        self.team = TeamLoop(scenario, opened, settings=loop)
        self.possible_agents = [f"ego_{number}" for number in range(egos)]
        self.agents: list[str] = []
        seats = [_Seat(one, {**settings, "scenario": self.team.base}, dict(action)) for one in self.team.loops]
        self._seats = dict(zip(self.possible_agents, seats, strict=True))
        self._rng = np.random.default_rng()
        self.render_mode = None

    def observation_space(self, agent: str) -> Space:
        """Return the space of an agent's observations."""
        return self._seats[agent].observation_space

    def action_space(self, agent: str) -> Space:
        """Return the space of an agent's actions."""
        return self._seats[agent].action_space

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode; one seed, one episode.

        Raises:
            UserError: the scenario cannot be opened, or has too few vehicles.
        """
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        episode = int(self._rng.integers(2**31)) if seed is None else seed
        self.team.start(episode)
        self.agents = list(self.possible_agents)
        found = {agent: self._seats[agent].reset(seed=episode) for agent in self.agents}
        return {agent: one[0] for agent, one in found.items()}, {agent: one[1] for agent, one in found.items()}

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, Any]]:
        """Act with every agent; see PettingZoo.

        Raises:
            ValueError: an action is not finite or not of its space.
            KeyError: an agent has no action.
        """
        seats = {agent: self._seats[agent] for agent in self.agents}
        for agent, seat in seats.items():
            seat.begin(actions[agent])
        numbers = {agent: number for number, agent in enumerate(self.possible_agents)}
        for _ in range(next(iter(seats.values())).traffic_steps if seats else 0):
            if not self.team.running:
                break
            going = [agent for agent, seat in seats.items() if seat.loop.outcome is None]
            self.team.advance({numbers[agent]: seats[agent].wanted_mps2() for agent in going})
            for agent in going:
                seats[agent].moved()
        results = {agent: seat.result(actions[agent]) for agent, seat in seats.items()}
        self.agents = [agent for agent in self.agents if seats[agent].loop.outcome is None]
        return (
            {agent: result[0] for agent, result in results.items()},
            {agent: result[1] for agent, result in results.items()},
            {agent: result[2] for agent, result in results.items()},
            {agent: result[3] for agent, result in results.items()},
            {agent: result[4] for agent, result in results.items()},
        )

    def close(self) -> None:
        """End the simulation."""
        self.team.close()


class _Seat(DrivingEnv):
    """Environment of one ego whose traffic the team starts and moves."""

    def __init__(self, loop: ClosedLoop, config: dict[str, Any], action: dict[str, object]) -> None:
        self._given = loop
        super().__init__(config, None, action)

    @property
    def traffic_steps(self) -> int:
        """Traffic steps per action."""
        return self._steps

    def begin(self, action: Any) -> None:
        """Take the action of a step."""
        self._check_action(action)
        self._since, self._fresh = len(self.loop.ticks) - 1, True
        self.action_type.act(action)

    def wanted_mps2(self) -> float:
        """Return the acceleration for the next traffic step, m/s2."""
        if not self._fresh:
            self.vehicle.act()
        self._fresh = False
        return float(self.vehicle.action["acceleration"])

    def moved(self) -> None:
        """Look at what became of a traffic step."""
        self.steps += 1
        self._mirror()

    def result(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        """Return observation, reward, whether the episode terminated or was truncated, and info."""
        observation = self.observation_type.observe()
        info = self._info(observation, action)
        return observation, self._reward(action), self._is_terminated(), self._is_truncated(), info

    def _new_loop(self) -> ClosedLoop:
        return self._given

    def _end_loop(self) -> None:
        self._loop = None

    def _start(self, episode: int) -> Tick:
        return self.loop.tick
