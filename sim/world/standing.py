"""Standing: road users on the ground of their world, tilted by it, by braking and by turning.

Bodies lean quasi-statically, as on a suspension without inertia. Per g of acceleration a car rolls outwards by about
4.5 degrees, of the 3 to 7 of passenger cars (Gillespie, Fundamentals of Vehicle Dynamics, SAE 1992), and pitches as a
mass on springs of a natural frequency of 1.3 Hz at its axles would, of which anti-dive geometry takes away a third.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sim.boxes import CLASSES
from sim.geometry import Array
from sim.scenario import Scenario
from sim.traffic.base import Actors, DrivableTraffic, Limits, TrafficLight
from sim.traffic.open import open_traffic

_G_MPS2 = 9.81
_MOST_MPS2 = 8.0
"""Largest acceleration that leans a body, m/s2: what tyres carry; more is a jump of a simulation."""
_ROLL_RAD_PER_G = np.radians(4.5)
_BOUNCE_RAD_S = 2.0 * np.pi * 1.3
_DIVE_SHARE = 2.0 / 3.0
_MASS_HEIGHT = 0.37
"""Height of the centre of mass, share of the height of a body."""
_WHEELBASE, _TRACK = 0.6, 0.85
"""Shares of length and width of a body; as `sim.exchange.openscenario` has its track."""
_CORNERS = 0.5 * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])


def stand(actors: Actors, height: Callable[[Array], Array]) -> Actors:
    """Return road users whose wheels or feet are on the ground.

    Pedestrians stay upright, two-wheelers pitch but keep upright across; all others pitch and roll with the plane
    through their wheels, and by their acceleration. Boxes stay upright, their bottoms at the height of the plane.

    Args:
        height: gives (N,) heights of the ground at (N, 2) positions, m.
    """
    if not len(actors):
        return actors
    boxes = actors.boxes
    walks = np.isin(boxes.label, [CLASSES.index("pedestrian")])
    narrow = walks | np.isin(boxes.label, [CLASSES.index("bicycle"), CLASSES.index("motorcycle")])
    base_m = np.where(walks, 0.0, _WHEELBASE * boxes.size[:, 0])
    track_m = np.where(narrow, 0.0, _TRACK * boxes.size[:, 1])
    ahead = np.column_stack([np.cos(boxes.yaw), np.sin(boxes.yaw)])
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    along, across = (share[:, None] * ways for share, ways in ((base_m, ahead), (track_m, left)))
    wheels = boxes.center[:, None, :2] + _CORNERS @ np.stack([along, across], axis=1)
    level = height(wheels.reshape(-1, 2)).reshape(-1, 4)
    pitch = -np.arctan(_slope(level[:, :2], level[:, 2:], base_m))
    roll = np.arctan(_slope(level[:, ::2], level[:, 1::2], track_m) * np.cos(pitch))
    dive, lean = _leaning(actors, ahead, left)
    center = boxes.center.copy()
    center[:, 2] = level.mean(axis=1) + 0.5 * boxes.size[:, 2]
    return replace(
        actors,
        boxes=replace(boxes, center=center),
        pitch=pitch + np.where(narrow, 0.0, dive),
        roll=roll + np.where(narrow, 0.0, lean),
    )


def _slope(high: Array, low: Array, apart_m: Array) -> Array:
    rise = high.mean(axis=1) - low.mean(axis=1)
    return np.divide(rise, apart_m, out=np.zeros_like(rise), where=apart_m > 0.0)


def _leaning(actors: Actors, ahead: Array, left: Array) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (N,) pitch and roll of bodies on their suspension, rad."""
    along, aside = (np.clip((actors.acceleration * way).sum(axis=1), -_MOST_MPS2, _MOST_MPS2) for way in (ahead, left))
    length, _, tall = actors.boxes.size.T
    lever = _MASS_HEIGHT * tall / (_BOUNCE_RAD_S * 0.5 * _WHEELBASE * length) ** 2
    return -_DIVE_SHARE * lever * along, _ROLL_RAD_PER_G / _G_MPS2 * aside


def standing(scenario: Scenario, seed: int) -> Callable[[Actors], Actors]:
    """Return what stands the road users of a scenario on its ground: in a level world nothing moves them.

    Raises:
        ScenarioError: the network is missing or cannot be read.
    """
    if not scenario.uneven:
        return _as_they_are
    from sim.world.ground import streets_of

    return partial(stand, height=streets_of(scenario, seed).height)


def _as_they_are(actors: Actors) -> Actors:
    return actors


def open_standing(scenario: Scenario, seed: int) -> DrivableTraffic:
    """Start the traffic of a scenario, see `sim.traffic.open.open_traffic`, on the ground of its world."""
    if not scenario.uneven:
        return open_traffic(scenario, seed)
    return StandingTraffic(open_traffic(scenario, seed), standing(scenario, seed))


class StandingTraffic(DrivableTraffic):
    """Traffic whose road users stand on the ground; all else is that of a backend.

    Args:
        backend: traffic on level ground, closed with this one.
        place: stands its road users on the ground.
    """

    def __init__(self, backend: DrivableTraffic, place: Callable[[Actors], Actors]) -> None:
        self.step_s = backend.step_s
        self._backend, self._place = backend, place
        self._flat: Actors | None = None
        self._standing: Actors | None = None

    @property
    def actors(self) -> Actors:
        """The actors at the current time."""
        flat = self._backend.actors
        if self._standing is None or flat is not self._flat:
            self._flat, self._standing = flat, self._place(flat)
        return self._standing

    def step(self) -> Actors:
        """Advance by `step_s` and return the actors."""
        self._backend.step()
        return self.actors

    def close(self) -> None:
        """End the simulation."""
        self._backend.close()

    def command(self, object_id: int, speed_mps: float | None) -> None:
        """Drive a vehicle, see `DrivableTraffic.command`."""
        self._backend.command(object_id, speed_mps)

    def place(self, object_id: int, xy: NDArray[np.float64], yaw: float, speed_mps: float) -> None:
        """Put a vehicle somewhere, see `DrivableTraffic.place`."""
        self._backend.place(object_id, xy, yaw, speed_mps)

    def speed(self, object_id: int) -> float:
        """Return the odometer reading of a vehicle, m/s."""
        return self._backend.speed(object_id)

    def route(self, object_id: int, ahead_m: float) -> NDArray[np.float64]:
        """Return the path ahead of a vehicle, see `DrivableTraffic.route`."""
        return self._backend.route(object_id, ahead_m)

    def limits(self, object_id: int) -> Limits:
        """Return the limits of a vehicle where it is."""
        return self._backend.limits(object_id)

    def signals(self, object_id: int) -> tuple[TrafficLight, ...]:
        """Return the traffic lights on the route of a vehicle, nearest first."""
        return self._backend.signals(object_id)

    def goal_m(self, object_id: int) -> float | None:
        """Return the distance left to a goal, see `DrivableTraffic.goal_m`."""
        return self._backend.goal_m(object_id)

    def encounter_gap_s(self, object_id: int) -> float | None:
        """Return the difference of arrival at an encounter, see `DrivableTraffic.encounter_gap_s`."""
        return self._backend.encounter_gap_s(object_id)

    def claims(self) -> dict[str, Actors]:
        """Return what helpers report although it does not exist, by the name of the helper."""
        return {name: self._place(ghosts) for name, ghosts in self._backend.claims().items()}
