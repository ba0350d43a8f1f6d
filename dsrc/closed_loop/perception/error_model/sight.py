"""What the LiDARs of the ego and its helpers can see of road users, without casting a sweep.

Ten points of each object are looked at from each LiDAR: rays through the static world, boxes of other road users, see
`sensors.scan.line_of_sight.seen_share`.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.kept import world_scene
from sensors.recording.mounting import mount
from sensors.recording.rig import Rig
from sensors.scan.line_of_sight import seen_share
from sim.boxes import CLASSES
from sim.scenario import Scenario
from sim.traffic.base import Actors

Sight = Literal["hidden", "helpers", "partly", "clear"]
"""Nobody sees the object; a helper alone sees it; whoever sees best sees less than `CLEAR_SHARE` of it; or more."""
Kind = Literal["car", "large vehicle", "two-wheeler", "pedestrian"]

SIGHTS: tuple[Sight, ...] = get_args(Sight)
KINDS: tuple[Kind, ...] = get_args(Kind)
CLASSES_OF: dict[Kind, tuple[str, ...]] = {
    "car": ("car", "van"),
    "large vehicle": ("truck", "bus"),
    "two-wheeler": ("motorcycle", "bicycle"),
    "pedestrian": ("pedestrian",),
}
KIND_OF_LABEL = np.array([next(k for k, kind in enumerate(KINDS) if name in CLASSES_OF[kind]) for name in CLASSES])
"""Row of `KINDS` by row of `CLASSES`."""
CLEAR_SHARE = 0.6
RANGES_M = (0.0, 15.0, 30.0, 50.0, 80.0, 200.0)
"""Borders of the distances from the ego, m."""
BANDS = tuple(pairwise(RANGES_M))


class Viewpoints:
    """LiDARs of the ego and its helpers over an episode, the same agents as of `dsrc.closed_loop.perception.senses`.

    Args:
        ego_id: object id of the ego.
        cooperative: False leaves the ego alone.
    """

    def __init__(self, scenario: Scenario, seed: int, ego_id: int, cooperative: bool) -> None:
        self._scene = world_scene(scenario, seed)
        self._rig = Rig(scenario, self._scene, seed, visibility=False)
        self._ego_id, self._cooperative = ego_id, cooperative
        self._carriers: tuple[int, ...] = ()

    def sight(self, before: Actors, now: Actors, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return (K,) rows of `SIGHTS` of objects.

        Args:
            before: actors one step ago; at the first call they decide who the helpers are.
            rows: (K,) objects, as rows of `now`.
        """
        if not self._carriers:
            self._carriers = self._rig.carriers(before, self._ego_id) if self._cooperative else (self._ego_id,)
        present = [agent for agent in self._carriers if agent in now.boxes.object_id]
        bodies, spec = now.world_from_body(), self._rig.vehicle_spec
        lidars = [bodies[k] @ mount(spec, now.boxes.size[k, 2], self._rig.mount) for k in map(now.row, present)]
        roadside = self._rig.roadside if self._cooperative else {}
        lidars += [unit.world_from_lidar for unit in roadside.values()]
        places = np.array([pose[:3, 3] for pose in lidars]).reshape(-1, 3)
        share = seen_share(self._scene, now.boxes, places, [*present, *roadside], rows)
        return sights_of(share[0], share[1:].max(axis=0, initial=0.0))


def sights_of(ego: NDArray[np.floating], helpers: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return (K,) rows of `SIGHTS`.

    Args:
        ego: (K,) share of each object that the ego sees.
        helpers: (K,) largest share that a helper sees.
    """
    best = np.maximum(ego, helpers)
    seen = np.where(best >= CLEAR_SHARE, SIGHTS.index("clear"), SIGHTS.index("partly"))
    seen = np.where(ego > 0.0, seen, SIGHTS.index("helpers"))
    return np.where(best > 0.0, seen, SIGHTS.index("hidden")).astype(np.int64)


def ego_frame(xy: NDArray[np.float64], ego: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N, 2) places in the ego's frame, m.

    Args:
        xy: (N, 2) m.
        ego: (3,) x, y, m, and yaw, rad, in the same frame.
    """
    cos, sin = np.cos(ego[2]), np.sin(ego[2])
    return np.asarray((xy - ego[:2]) @ np.array([[cos, -sin], [sin, cos]]), np.float64)


def within(area_m: Sequence[float], local: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the (N,) mask of places of the ego's frame inside an area and the ranges.

    Args:
        area_m: x and y of the low and of the high corner, m.
        local: (N, 2) m.
    """
    inside = ((local >= area_m[:2]) & (local <= area_m[2:])).all(axis=1)
    return np.asarray(inside & (np.linalg.norm(local, axis=1) < RANGES_M[-1]), bool)


def bands_of(local: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the (N,) rows of `BANDS` of places of the ego's frame."""
    return np.searchsorted(RANGES_M[1:-1], np.linalg.norm(local, axis=1), side="right").astype(np.int64)


def quarters_of(turn: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the nearest (N,) quarter turns to angles, rad: 0 ahead, 1 to the left, 2 back, 3 to the right."""
    return np.rint(turn / (0.5 * np.pi)).astype(np.int64) % 4
