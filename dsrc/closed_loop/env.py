"""The closed loop as a gymnasium environment: an ego in SUMO traffic that acts on what its perception gives it."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dsrc.closed_loop.corridor import FREE, Obstacle, nearest_obstacle
from dsrc.closed_loop.idm import IdmSettings
from dsrc.closed_loop.metrics.surrogate import time_to_collision
from dsrc.closed_loop.former_perception import Perception, TruthPerception
from dsrc.closed_loop.tracker import Tracker
from sensors.recording.encounter_check import with_proven_encounter
from sim.boxes import CLASSES, Boxes, concatenate
from sim.catalog.load import load_scenario
from sim.collisions import collide
from sim.errors import TrafficError
from sim.geometry import wrap_angle
from sim.scenario import Scenario
from sim.traffic.base import Actors, DrivableTraffic

Observation = dict[str, NDArray[np.float32]]

LOOK_AHEAD = 60.0
"""How far ahead the ego knows its route and minds obstacles, m."""


class CoopDrivingEnv(gym.Env[Observation, NDArray[np.float32]]):
    """One ego keeps its route in SUMO traffic and chooses its acceleration; red signals hold it whatever it chooses.

    Observation (float32; obstacles come from the tracked boxes of the perception, never from the simulation):
        speed (1,): the ego's, m/s.
        desired_speed (1,): on a free road, m/s.
        gap (1,): to the nearest perceived box in the ego's corridor, m; `LOOK_AHEAD` when free.
        lead_speed (1,): of that box along the path, m/s; the ego's own when free.
        boxes (M, 6): the nearest perceived boxes, nearest first, zero-padded: x, y, length, width, yaw, speed in
            the ego's body frame, m, rad and m/s.

    Action: (1,) in [-1, 1]: -1 brakes as hard as the car can, +1 accelerates as hard as is comfortable.

    Reward: progress of the step in metres, minus 100 at a collision.

    An encounter is the seed's first draw whose proof holds, see `sensors.recording.encounter_check`. False objects that
    a helper claims are added to the boxes of a cooperative perception.

    An episode ends with a collision (oriented boxes of truth) or when the ego leaves the road network, and is cut
    after `duration_s`.

    Args:
        scenario: name, path or struct.
        perception: what the ego sees; default: the truth.
        duration_s: length of an episode, s.
        max_boxes: M.
        idm: limits of the car.
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        scenario: str | Scenario = "braunschweig",
        perception: Perception | None = None,
        duration_s: float = 20.0,
        max_boxes: int = 16,
        idm: IdmSettings | None = None,
    ) -> None:
        self.scenario = load_scenario(scenario) if isinstance(scenario, str) else scenario
        self.perception = perception or TruthPerception()
        self.duration_s = duration_s
        self.max_boxes = max_boxes
        self.idm = idm or IdmSettings()
        scalar = spaces.Box(-100.0, 200.0, (1,), np.float32)
        self.observation_space: spaces.Dict = spaces.Dict(  # type: ignore[assignment]
            {
                "speed": scalar,
                "desired_speed": scalar,
                "gap": scalar,
                "lead_speed": scalar,
                "boxes": spaces.Box(-1e3, 1e3, (max_boxes, 6), np.float32),
            }
        )
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self._traffic: DrivableTraffic | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict]:
        """Start the scenario with the traffic of `seed` and choose the ego; one seed, one episode.

        Raises:
            TrafficError: when another simulation runs in this process or no vehicle can be the ego.
        """
        from sim.traffic.open import open_traffic

        super().reset(seed=seed)
        self.close()
        episode_seed = int(self.np_random.integers(2**31)) if seed is None else seed
        scenario = with_proven_encounter(self.scenario, episode_seed)
        self._traffic = traffic = open_traffic(scenario, episode_seed)
        self._ego_id = choose_ego(traffic, scenario)
        self._before = traffic.actors
        self._tracker = Tracker()
        self.perception.reset(scenario, self._ego_id, episode_seed)
        self._min_ttc, self._progress, self._last_speed = math.inf, 0.0, 0.0
        traffic.command(self._ego_id, self._speed())
        actors = traffic.step()
        self._start_s = actors.time_s
        return self._observe(actors), self._info(actors, collided_with=())

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict]:
        """Accelerate for one traffic step, then sense, detect and track."""
        acceleration = float(np.clip(action[0], -1.0, 1.0))
        acceleration *= self.idm.max_acceleration if acceleration > 0.0 else self.idm.max_deceleration
        self._before = self.traffic.actors
        was = self._ego(self._before)
        self.traffic.command(self._ego_id, max(0.0, self._speed() + acceleration * self.traffic.step_s))
        actors = self.traffic.step()
        if self._ego_id not in actors.boxes.object_id:
            return (
                self._observation(FREE, Boxes.zeros(), np.zeros((0, 2)), None),
                0.0,
                True,
                False,
                self._info(None, ()),
            )
        ego = self._ego(actors)
        moved = float(np.linalg.norm(ego.center[0, :2] - was.center[0, :2]))
        self._progress += moved
        collided_with = self._collisions(actors)
        self._min_ttc = min(self._min_ttc, self._time_to_collision(actors))
        observation = self._observe(actors)
        terminated = bool(collided_with)
        truncated = actors.time_s - self._start_s >= self.duration_s - 1e-6
        return observation, moved - 100.0 * terminated, terminated, truncated, self._info(actors, collided_with)

    @property
    def traffic(self) -> DrivableTraffic:
        """The running traffic; ResetNeeded before `reset` and after `close`."""
        if self._traffic is None:
            raise gym.error.ResetNeeded("expected an environment that was reset, found one without running traffic")
        return self._traffic

    def close(self) -> None:
        """End the simulation."""
        if self._traffic is not None:
            self._traffic.close()
            self._traffic = None

    def _ego(self, actors: Actors) -> Boxes:
        row = actors.row(self._ego_id)
        return actors.boxes[row : row + 1]

    def _speed(self) -> float:
        return self.traffic.speed(self._ego_id)

    def _others(self, actors: Actors) -> NDArray[np.bool_]:
        near = np.linalg.norm(actors.boxes.center[:, :2] - self._ego(actors).center[0, :2], axis=1) < 80.0
        return near & (actors.boxes.object_id != self._ego_id)

    def _collisions(self, actors: Actors) -> tuple[int, ...]:
        others = actors.boxes[self._others(actors)]
        return tuple(int(i) for i in others.object_id[collide(self._ego(actors), others)])

    def _time_to_collision(self, actors: Actors) -> float:
        others = self._others(actors)
        velocity = actors.velocity[actors.row(self._ego_id)]
        return time_to_collision(self._ego(actors), velocity, actors.boxes[others], actors.velocity[others])

    def _observe(self, actors: Actors) -> Observation:
        """Sense, detect, track and describe the corridor."""
        perceived = concatenate([self.perception.perceive(self._before, actors), self._claimed()])
        boxes, velocity = self._tracker.update(perceived, actors.time_s)
        ego = self._ego(actors)
        path = self.traffic.route(self._ego_id, LOOK_AHEAD)
        obstacle = nearest_obstacle(path, boxes, ego.size[0, 0], ego.size[0, 1])
        return self._observation(obstacle, boxes, velocity, ego)

    def _claimed(self) -> Boxes:
        """Return the ghosts that helpers report to a cooperative ego."""
        if not self.perception.cooperative:
            return Boxes.zeros()
        return concatenate([claimed.boxes for claimed in self.traffic.claims().values()])

    def _observation(
        self, obstacle: Obstacle, boxes: Boxes, velocity: NDArray[np.float64], ego: Boxes | None
    ) -> Observation:
        self._last_speed = speed = self._last_speed if ego is None else self._speed()
        desired = 0.0 if ego is None else self.traffic.limits(self._ego_id).speed_mps
        lead = speed
        if obstacle.row >= 0:
            lead = float(velocity[obstacle.row] @ [math.cos(obstacle.heading), math.sin(obstacle.heading)])
        table = np.zeros((self.max_boxes, 6), np.float32)
        if ego is not None and len(boxes):
            c, s = math.cos(ego.yaw[0]), math.sin(ego.yaw[0])
            offset = boxes.center[:, :2] - ego.center[0, :2]
            rows = np.argsort(np.linalg.norm(offset, axis=1), kind="stable")[: self.max_boxes]
            local = offset[rows] @ np.array([[c, -s], [s, c]])
            heading = wrap_angle(boxes.yaw[rows] - ego.yaw[0])
            fast = np.linalg.norm(velocity[rows], axis=1)
            table[: len(rows)] = np.column_stack([local, boxes.size[rows, :2], heading, fast])
        values = {"speed": speed, "desired_speed": desired, "gap": min(obstacle.gap, LOOK_AHEAD), "lead_speed": lead}
        bounded = {k: np.clip(np.array([v], np.float32), -100.0, 200.0) for k, v in values.items()}
        return {**bounded, "boxes": np.clip(table, -1e3, 1e3)}

    def _info(self, actors: Actors | None, collided_with: tuple[int, ...]) -> dict[str, Any]:
        return {
            "time_s": self._start_s if actors is None else actors.time_s,
            "ego_id": self._ego_id,
            "collided_with": collided_with,
            "min_ttc_s": self._min_ttc,
            "progress_m": self._progress,
        }


def choose_ego(traffic: DrivableTraffic, scenario: Scenario) -> int:
    """Return the first vehicle that the scenario names, else the car or van with the longest way left inside its area.

    Of cars and vans one that moves is taken, if there is one; a parked car goes nowhere.

    Raises:
        TrafficError: when there is none.
    """
    actors = traffic.actors
    if scenario.agents.named:
        return _named(actors, scenario)
    fit = np.isin(actors.boxes.label, [CLASSES.index("car"), CLASSES.index("van")]) & ~actors.parked()
    moving = np.linalg.norm(actors.velocity, axis=1) > 2.0
    way_left = {
        row: _way_left(traffic.route(int(actors.boxes.object_id[row]), 300.0), scenario) for row in np.flatnonzero(fit)
    }
    rows = [row for row, way in way_left.items() if way > 0.0]
    if not rows:
        raise TrafficError(f"{scenario.name}: expected a car or van inside the area after the warm-up, found none")
    return int(actors.boxes.object_id[max(rows, key=lambda row: (moving[row], way_left[row]))])


def _named(actors: Actors, scenario: Scenario) -> int:
    name = scenario.agents.named[0]
    if name not in actors.name:
        raise TrafficError(f"{scenario.name}: expected the ego '{name}' on the road at the start, found it nowhere")
    return int(actors.boxes.object_id[actors.name.index(name)])


def _way_left(path: NDArray[np.float64], scenario: Scenario) -> float:
    """Return how much of a route lies inside the scenario's area before it first leaves it, m."""
    if scenario.network.area_m is not None:
        low, high = np.array(scenario.network.area_m).reshape(2, 2)
        inside = ((path >= low) & (path <= high)).all(axis=1)
        path = path[: len(path) if inside.all() else int(np.argmin(inside))]
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
