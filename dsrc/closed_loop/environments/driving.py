"""Gymnasium environment of the closed loop, on highway-env's observations, actions and pictures.

What an agent observes are the tracks of its perception, never the simulation. Observation and action types are
highway-env's own (`config["observation"]`, `config["action"]`), so that an agent trained on one of its environments
runs here unchanged where both spaces are the same.
"""

import math
from typing import Any

import numpy as np
from gymnasium import spaces
from highway_env import utils
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.road.road import Road
from highway_env.vehicle.kinematics import Vehicle
from numpy.typing import NDArray

from dsrc.closed_loop.environments.roads import network_of, to_plane
from dsrc.closed_loop.loop import ClosedLoop, LoopSettings
from dsrc.closed_loop.perception.open import open_perception
from dsrc.closed_loop.types import Outcome, Perception
from sim.boxes import Boxes
from sim.errors import SettingsError, complaint
from sim.scenario import Scenario

COLLIDED = (Outcome.CRASHED, Outcome.LEFT)
_OVER = (Outcome.TIMEOUT, Outcome.DESYNCHRONISED)
"""Outcomes that cut an episode: the task itself has not ended."""


class DrivingEnv(AbstractEnv):
    """Ego in simulated traffic that acts on its perception.

    With an action that has no lateral part the ego keeps its route (`dsrc/Rail-v0`, `dsrc/Meta-v0`); with one it
    steers a bicycle model that is pushed into the traffic (`dsrc/Free-v0`). Red lights do not hold it by themselves in
    `Free`.

    Observation: highway-env's type of `config["observation"]`, of perceived tracks in highway-env's plane
    (x, -y of the world). Default: `Kinematics` of the ego and the 15 nearest tracks with a presence flag, in [-1, 1].

    Action: highway-env's type of `config["action"]`; accelerations are bounded by the vehicle's limits.

    Reward in [0, 1] (`normalize_reward`): `collision_reward` at a crash or off the road, `progress_reward` times the
    distance of the step over that at the speed limit, `comfort_reward` times the share of the acceleration's bound of
    4.05 m/s2 (nuPlan) that is exceeded. `info["rewards"]` holds the terms.

    An episode terminates with an arrival, a crash, off the road, stuck, or a failed perception, and is truncated after
    `duration` s. `info["outcome"]` names it.

    Args:
        config: changes of `default_config`; `scenario` and `perception` may be objects.
        render_mode: `human` or `rgb_array`: the road with the ego and its tracks.
        settings: single settings in place of a `config`, such as `scenario="four_way"`.
    """

    def __init__(self, config: dict | None = None, render_mode: str | None = None, **settings: Any) -> None:
        self._loop: ClosedLoop | None = None
        self._ready = False  # highway-env resets while it is constructed; a simulation starts with the first reset
        super().__init__({**(config or {}), **settings}, render_mode)
        self._ready = True

    @classmethod
    def default_config(cls) -> dict:
        """Return the settings with their defaults, see the class."""
        config = super().default_config()
        config.update(
            {
                "scenario": "four_way",
                "perception": "truth",
                "observation": {
                    "type": "Kinematics",
                    "vehicles_count": 16,
                    "features": ["presence", "x", "y", "vx", "vy", "cos_h", "sin_h"],
                    "features_range": {"x": [-100, 100], "y": [-100, 100], "vx": [-30, 30], "vy": [-30, 30]},
                    "see_behind": True,
                    "order": "sorted",
                    "bounded": True,
                },
                "action": {"type": "ContinuousAction", "longitudinal": True, "lateral": False},
                "duration": 20.0,
                "policy_frequency": 10,
                "detect_every_s": 0.1,
                "latency_s": 0.0,
                "collision_reward": -1.0,
                "progress_reward": 1.0,
                "comfort_reward": -0.2,
                "normalize_reward": True,
                "screen_width": 600,
                "screen_height": 600,
                "centering_position": [0.5, 0.5],
            }
        )
        return config

    def define_spaces(self) -> None:
        """Set the types of observation and action and their spaces.

        highway-env gives no bounds to clipped observations; `bounded` among the observation's settings does.
        """
        super().define_spaces()
        space = self.observation_space
        if self.config["observation"].get("bounded") and isinstance(space, spaces.Box):
            self.observation_space = spaces.Box(-1.0, 1.0, space.shape, np.float32)

    @property
    def loop(self) -> ClosedLoop:
        """The closed loop below: ticks, outcome, perception."""
        if self._loop is None:
            self._loop = self._new_loop()
        return self._loop

    def configure(self, config: dict | None) -> None:
        """Change settings; another scenario or perception takes effect with the next reset.

        Raises:
            SettingsError: an unknown setting, or a frequency that is not a whole share of the traffic's.
        """
        known = self.default_config()
        for name in config or {}:
            if name not in known:
                raise SettingsError(complaint("environment", name, f"one of {', '.join(sorted(known))}", "it"))
        super().configure(config)
        self._loop = None

    def _new_loop(self) -> ClosedLoop:
        perception: str | Perception = self.config["perception"]
        settings = LoopSettings(
            duration_s=self.config["duration"],
            detect_every_s=self.config["detect_every_s"],
            latency_s=self.config["latency_s"],
        )
        found = open_perception(perception) if isinstance(perception, str) else perception
        return ClosedLoop(self.config["scenario"], found, settings=settings)

    @property
    def _steps(self) -> int:
        """Traffic steps per action."""
        scenario: Scenario = self.loop.base
        steps = 1.0 / (scenario.step_s * self.config["policy_frequency"])
        if abs(steps - round(steps)) > 1e-6 or steps < 1.0:
            expected = f"a whole share of {1.0 / scenario.step_s:g} Hz"
            raise SettingsError(
                complaint("environment", "policy_frequency", expected, str(self.config["policy_frequency"]))
            )
        return round(steps)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        """Begin an episode; one seed, one episode.

        Raises:
            UserError: scenario or perception cannot be opened.
        """
        self._seed = seed
        return super().reset(seed=seed, options=options) if self._ready else (None, {})

    def _reset(self) -> None:
        episode = int(self.np_random.integers(2**31)) if self._seed is None else self._seed
        self.config["simulation_frequency"] = self._steps * self.config["policy_frequency"]
        tick = self.loop.start(episode)
        network = network_of(self.loop.scenario, episode)
        self.road = Road(network, np_random=self.np_random, record_history=False)
        box = tick.ego.box
        x, y = to_plane(box.center[0, :2])
        ego = self.action_type.vehicle_class(self.road, [x, y], -float(box.yaw[0]), tick.ego.speed_mps)
        self._shape(ego, box, 0)
        self.vehicle = ego
        self._mirror()

    def _simulate(self, action: Any = None) -> None:
        for number in range(self._steps):
            if self.loop.outcome is not None:
                return
            if number == 0 and action is not None:
                self.action_type.act(action)
            else:
                self.vehicle.act()
            self._advance()
            self.steps += 1
            self._mirror()

    def _advance(self) -> None:
        ego = self.vehicle
        if not getattr(self.action_type, "lateral", False):
            self.loop.advance(float(ego.action["acceleration"]))
            return
        ego.step(self.loop.scenario.step_s)
        x, y = to_plane(ego.position)
        self.loop.advance_to((float(x), float(y), -float(ego.heading)), float(ego.speed))

    def _mirror(self) -> None:
        """Put the ego and its tracks on highway-env's road."""
        tick = self.loop.tick
        ego, box = self.vehicle, tick.ego.box
        ego.position = to_plane(box.center[0, :2])
        ego.heading, ego.speed = -float(box.yaw[0]), tick.ego.speed_mps
        ego.on_state_update()
        ego.crashed = self.loop.outcome in COLLIDED
        self.road.vehicles = [ego]
        for row in range(len(tick.tracks)):
            self.road.vehicles.append(self._track(tick.tracks.boxes, tick.tracks.velocity, row))

    def _track(self, boxes: Boxes, velocity: NDArray[np.float64], row: int) -> Vehicle:
        yaw = float(boxes.yaw[row])
        along = float(velocity[row] @ [math.cos(yaw), math.sin(yaw)])
        other = Vehicle(self.road, to_plane(boxes.center[row, :2]), -yaw, along)
        self._shape(other, boxes, row)
        return other

    @staticmethod
    def _shape(vehicle: Vehicle, boxes: Boxes, row: int) -> None:
        vehicle.LENGTH, vehicle.WIDTH = float(boxes.size[row, 0]), float(boxes.size[row, 1])
        vehicle.diagonal = math.hypot(vehicle.LENGTH, vehicle.WIDTH)

    def _rewards(self, action: Any) -> dict[str, float]:
        ticks = self.loop.ticks[-self._steps - 1 :]
        seconds = self.loop.scenario.step_s * max(len(ticks) - 1, 1)
        limit = max(ticks[-1].ego.limits.speed_mps, 1e-3)
        moved = ticks[-1].ego.progress_m - ticks[0].ego.progress_m
        hardest = max(abs(tick.ego.acceleration_mps2) for tick in ticks[1:] or ticks)
        return {
            "collision_reward": float(self.loop.outcome in COLLIDED),
            "progress_reward": float(np.clip(moved / (limit * seconds), 0.0, 1.0)),
            "comfort_reward": float(np.clip((hardest - _COMFORT_MPS2) / _COMFORT_MPS2, 0.0, 1.0)),
        }

    def _reward(self, action: Any) -> float:
        terms = self._rewards(action)
        reward = sum(self.config[name] * value for name, value in terms.items())
        if not self.config["normalize_reward"]:
            return float(reward)
        low = self.config["collision_reward"] + self.config["comfort_reward"]
        return float(np.clip(utils.lmap(reward, [low, self.config["progress_reward"]], [0.0, 1.0]), 0.0, 1.0))

    def _is_terminated(self) -> bool:
        return self.loop.outcome is not None and self.loop.outcome not in _OVER

    def _is_truncated(self) -> bool:
        return self.loop.outcome in _OVER

    def _info(self, obs: Any, action: Any = None) -> dict:
        tick, outcome = self.loop.tick, self.loop.outcome
        return {
            "time_s": tick.actors.time_s - self.loop.start_s,
            "speed": tick.ego.speed_mps,
            "progress_m": tick.ego.progress_m,
            "crashed": outcome in COLLIDED,
            "outcome": "" if outcome is None else outcome.value,
            "message": self.loop.message,
            "rewards": self._rewards(action),
        }

    def close(self) -> None:
        """End the simulation and close the window."""
        if self._loop is not None:
            self._loop.close()
        super().close()


_COMFORT_MPS2 = 4.05
"""Bound of comfortable braking, m/s2 (nuPlan)."""
