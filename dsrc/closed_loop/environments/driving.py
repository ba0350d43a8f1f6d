"""Gymnasium environment of the closed loop, on highway-env's observations, actions and pictures.

What an agent observes are the tracks of its perception, never the simulation. Observation and action types are
highway-env's own (`config["observation"]`, `config["action"]`), so that an agent trained on one of its environments
runs here unchanged where both spaces are the same.
"""

import math
from typing import Any

import numpy as np
from gymnasium import spaces
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.road.road import Road
from numpy.typing import NDArray

from dsrc.closed_loop.environments.observation import Kinematics
from dsrc.closed_loop.environments.roads import Origin, junction_ahead, network_of, to_plane
from dsrc.closed_loop.environments.vehicles import TrackedVehicle
from dsrc.closed_loop.environments.viewer import CRASHED, EGO, TRACK, LoopViewer
from dsrc.closed_loop.loop import ClosedLoop, LoopSettings
from dsrc.closed_loop.perception.open import open_perception
from dsrc.closed_loop.types import Decision, EgoState, LaneMap, Outcome, Perception, Tick, Tracks
from dsrc.messages.seen_space import SeenSpace
from sim.errors import SettingsError, complaint, did_you_mean
from sim.scenario import Scenario

COLLIDED = (Outcome.CRASHED, Outcome.LEFT)
_OVER = (Outcome.TIMEOUT, Outcome.DESYNCHRONISED)
"""Outcomes that cut an episode: the task itself has not ended."""
_WALKS_MPS = 0.5
"""Speed from which the motion of somebody on foot or on two wheels gives the heading, m/s."""


class _Agent:
    """Driver of the loop in whose place an environment's agent decides, and its newest seen space."""

    seen: SeenSpace | None = None

    def reset(self, lanes: LaneMap | None) -> None:
        """Begin an episode."""
        self.seen = None

    def see(self, seen: SeenSpace) -> None:
        """Take the newest seen space."""
        self.seen = seen

    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        """Return no acceleration: the agent's replaces it."""
        return Decision(0.0)


class DrivingEnv(AbstractEnv):
    """Ego in simulated traffic that acts on its perception.

    With an action that has no lateral part the ego keeps its route (`dsrc/Rail-v0`, `dsrc/Meta-v0`); with one it
    steers a bicycle model that is pushed into the traffic (`dsrc/Free-v0`). Red lights do not hold it by themselves in
    `Free`.

    Observation: highway-env's type of `config["observation"]`, of perceived tracks in highway-env's plane
    (x, -y of the world). Default: `Kinematics` of the ego and the 15 nearest tracks with a presence flag, in [-1, 1].
    `origin` says where absolute positions and headings of `Kinematics` begin: `world`, or `junction`, the next one on
    the ego's route, approached towards smaller y, as an agent of highway-env's `intersection-v0` knows it.

    Action: highway-env's type of `config["action"]`; accelerations are bounded by the vehicle's limits.

    Reward: its sum over an episode lies in [-1.2, 1] (`normalize_reward`; else a step at the speed limit is worth 1).
    `progress_reward` times the distance of the step over that of `duration` at the speed limit, an arrival counting as
    that speed for the time left: to stand or to creep to the end never pays. `collision_reward` once, at a crash or
    off the road. `comfort_reward` times the excess over 4.05 m/s2 (nuPlan) as a share of it, at most 1, per `duration`.
    `info["rewards"]` holds the terms.

    An episode terminates with an arrival, a crash, off the road, stuck, or a failed perception, and is truncated after
    `duration` s. `info["outcome"]` names it.

    Args:
        config: changes of `default_config`; `scenario` and `perception` may be objects.
        render_mode: `human` or `rgb_array`: the road with the ego and its tracks.
        action: highway-env's settings of the action, where `config` has none; each id has its own.
        settings: single settings in place of a `config`, such as `scenario="four_way"`.
    """

    viewer: LoopViewer | None

    def __init__(
        self,
        config: dict | None = None,
        render_mode: str | None = None,
        action: dict[str, object] | None = None,
        **settings: object,
    ) -> None:
        self._loop: ClosedLoop | None = None
        self._origin: Origin | None = None
        self._since = 0  # tick at which the last action began
        self._ready = False  # highway-env resets while it is constructed; a simulation starts with the first reset
        super().__init__({**({} if action is None else {"action": action}), **(config or {}), **settings}, render_mode)
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
                "origin": "world",
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
                "scaling": 5.0,
            }
        )
        return config

    def define_spaces(self) -> None:
        """Set the types of observation and action and their spaces.

        highway-env gives no bounds to clipped observations; `bounded` among the observation's settings does.
        """
        super().define_spaces()
        settings = self.config["observation"]
        if Kinematics.serves(settings):
            self.observation_type = Kinematics(self, self._origin, **settings)
        space = self.observation_type.space()
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
                hint = did_you_mean(name, known)
                raise SettingsError(complaint("environment", "config", "known settings", name, hint))
        origin = (config or {}).get("origin", "world")
        if origin not in ("world", "junction"):
            raise SettingsError(complaint("environment", "origin", "'world' or 'junction'", str(origin)))
        super().configure(config)
        self._end_loop()

    def _end_loop(self) -> None:
        """Give the simulation back: only one runs in a process."""
        if self._loop is not None:
            self._loop.close()
        self._loop = None

    def _new_loop(self) -> ClosedLoop:
        perception: str | Perception = self.config["perception"]
        settings = LoopSettings(
            duration_s=self.config["duration"],
            detect_every_s=self.config["detect_every_s"],
            latency_s=self.config["latency_s"],
        )
        interval_s = self.config["detect_every_s"]
        found = open_perception(perception, interval_s=interval_s) if isinstance(perception, str) else perception
        return ClosedLoop(self.config["scenario"], found, _Agent(), settings)

    @property
    def seen(self) -> SeenSpace | None:
        """The newest seen space of the perception; None of one without sweeps, see `dsrc.messages.seen_space`."""
        driver = self.loop.driver
        return driver.seen if isinstance(driver, _Agent) else None

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
        tick = self._start(episode)
        self._since = 0
        network = network_of(self.loop.scenario, episode)
        at_junction = self.config["origin"] == "junction"
        self._origin = junction_ahead(self.loop.scenario, episode, tick.ego.route) if at_junction else None
        self.road = Road(network, np_random=self.np_random, record_history=False)
        box = tick.ego.box
        x, y = to_plane(box.center[0, :2])
        ego = self.action_type.vehicle_class(self.road, [x, y], -float(box.yaw[0]), tick.ego.speed_mps)
        ego.LENGTH, ego.WIDTH = float(box.size[0, 0]), float(box.size[0, 1])
        ego.diagonal = math.hypot(ego.LENGTH, ego.WIDTH)
        self.vehicle = ego
        self._mirror()

    def _start(self, episode: int) -> Tick:
        return self.loop.start(episode)

    def _simulate(self, action: Any = None) -> None:
        if action is not None:
            self._check_action(action)
        self._since = len(self.loop.ticks) - 1
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

    def _check_action(self, action: Any) -> None:
        space, shape = self.action_space, np.shape(action)
        if not np.isfinite(action).all():
            raise ValueError(f"action must be finite, got {action}")
        if shape != space.shape:
            raise ValueError(f"action must have the shape {space.shape}, got {shape}")
        if isinstance(space, spaces.Discrete) and not space.contains(action):
            raise ValueError(f"action must be of {space}, got {action}")

    def _advance(self) -> None:
        ego = self.vehicle
        if not getattr(self.action_type, "lateral", False):
            self.loop.advance(float(ego.action["acceleration"]))
            return
        self.loop.advance(float(ego.action["acceleration"]), -float(ego.action["steering"]))

    def _mirror(self) -> None:
        """Put the ego and its tracks on highway-env's road."""
        tick = self.loop.tick
        ego, box = self.vehicle, tick.ego.box
        ego.position = to_plane(box.center[0, :2])
        ego.heading, ego.speed = -float(box.yaw[0]), tick.ego.speed_mps
        ego.on_state_update()
        ego.crashed = self.loop.outcome in COLLIDED
        ego.color = CRASHED if ego.crashed else EGO
        self.road.vehicles = [ego]
        boxes, velocity = tick.tracks.boxes, tick.tracks.velocity
        positions = to_plane(boxes.center[:, :2])
        # A vehicle of highway-env moves along its heading. People step sideways: theirs is that of their motion.
        sideways = ~boxes.is_vehicle & (np.hypot(*velocity.T) > _WALKS_MPS)
        heading = np.where(sideways, np.arctan2(velocity[:, 1], velocity[:, 0]), boxes.yaw)
        along = velocity[:, 0] * np.cos(heading) + velocity[:, 1] * np.sin(heading)
        for row in range(len(boxes)):
            size = (float(boxes.size[row, 0]), float(boxes.size[row, 1]))
            other = TrackedVehicle(self.road, positions[row], -float(heading[row]), float(along[row]), size)
            other.color = TRACK
            self.road.vehicles.append(other)

    def _rewards(self, action: object) -> dict[str, float]:
        ticks = self.loop.ticks[self._since :]
        if len(ticks) == 1 and self.loop.outcome is not None:  # a step after the end earns nothing
            return dict.fromkeys(("collision_reward", "progress_reward", "comfort_reward"), 0.0)
        duration = self.config["duration"]
        seconds = self.loop.scenario.step_s * max(len(ticks) - 1, 1)
        limit = max(ticks[-1].ego.limits.speed_mps, 1e-3)
        moved = ticks[-1].ego.progress_m - ticks[0].ego.progress_m
        hardest = max(abs(tick.ego.acceleration_mps2) for tick in ticks[1:] or ticks)
        arrived = self.loop.outcome == Outcome.ARRIVED
        left = duration - (ticks[-1].actors.time_s - self.loop.start_s) if arrived else 0.0
        return {
            "collision_reward": float(self.loop.outcome in COLLIDED),
            "progress_reward": float(np.clip(moved / limit, 0.0, seconds) + max(left, 0.0)) / duration,
            "comfort_reward": float(np.clip(hardest / _COMFORT_MPS2 - 1.0, 0.0, 1.0)) * seconds / duration,
        }

    def _reward(self, action: object) -> float:
        reward = sum(self.config[name] * value for name, value in self._rewards(action).items())
        actions = 1.0 if self.config["normalize_reward"] else self.config["duration"] * self.config["policy_frequency"]
        return float(reward * actions)

    def _is_terminated(self) -> bool:
        return self.loop.outcome is not None and self.loop.outcome not in _OVER

    def _is_truncated(self) -> bool:
        return self.loop.outcome in _OVER

    def _info(self, obs: object, action: object = None) -> dict:
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

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the present step; return the picture with `rgb_array`."""
        if self.viewer is None and self.render_mode is not None:
            self.viewer = LoopViewer(self)
        return super().render()

    def close(self) -> None:
        """End the simulation and close the window."""
        if self._loop is not None:
            self._loop.close()
        super().close()


_COMFORT_MPS2 = 4.05
"""Bound of comfortable braking, m/s2 (nuPlan)."""
