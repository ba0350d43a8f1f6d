"""DriveHistory: what every frame of a source says of its objects, read once in the background for plots over time."""

import threading
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dsrc.review.sources.base import Source
from sim.errors import UserError

MOST = 300
"""Frames of a source that are read; longer ones are read at equal distances."""


class Seen(NamedTuple):
    """Course of an object over K frames.

    Attributes:
        rows: (K,) the frames that are read.
        distance_m: (K,) of its centre from the ego in the plane; NaN where either is absent.
        points: (K,) float64 points of each agent on it as recorded, by its id.
        visible: (K,) visible share from each agent, 0 to 1; NaN where it is unknown.
    """

    rows: NDArray[np.int64]
    distance_m: NDArray[np.float64]
    points: dict[int, NDArray[np.float64]]
    visible: dict[int, NDArray[np.float64]]


class _Facts(NamedTuple):
    object_id: NDArray[np.int64]
    center: NDArray[np.float64]
    agents: tuple[int, ...]
    places: NDArray[np.float64]
    lidars: NDArray[np.float64]
    points: NDArray[np.int32]
    visible: NDArray[np.float32]


class DriveHistory:
    """Objects of the frames of a source; a thread reads them while others ask."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._facts: dict[int, _Facts | None] = {}
        self._lock = threading.Lock()

    def lacking(self) -> list[int]:
        """Rows of the frames that are still to be read."""
        first, count = self._source.first, len(self._source)
        with self._lock:
            for row in [row for row in self._facts if row < first]:
                del self._facts[row]
            return [row for row in range(first, count, max(-(-(count - first) // MOST), 1)) if row not in self._facts]

    def read(self, row: int) -> None:
        """Read a frame; one that cannot be read has no objects."""
        facts = None
        try:
            # The sweeps of an episode are cast anew: only for frames that are looked at.
            frame = self._source.outline(row)
            truth, agents = frame.truth, frame.agents
            places = np.array([agent.world_from_body[:2, 3] for agent in agents])
            lidars = np.array([agent.sweep.world_from_lidar for agent in agents])
            ids = tuple(agent.agent_id for agent in agents)
            facts = _Facts(
                *(truth.object_id, truth.center[:, :2], ids, places, lidars),
                *(frame.points_on, np.asarray(frame.visible_fraction, np.float32)),
            )
        except UserError:
            pass  # told where it is drawn
        with self._lock:
            self._facts[row] = facts

    def lacks(self, object_id: int) -> bool:
        """Whether every frame is read, and none has an object."""
        rows = range(self._source.first, len(self._source))
        with self._lock:
            read = [facts for row in rows if (facts := self._facts.get(row)) is not None]
        return len(read) == len(rows) and not any(object_id in facts.object_id for facts in read)

    def of(self, object_id: int, ego_id: int) -> Seen:
        """Course of an object as far as it is read."""
        with self._lock:
            known = sorted(self._facts.items())
        agents = dict.fromkeys(one for _, facts in known if facts is not None for one in facts.agents)
        distance = np.full(len(known), np.nan)
        points, visible = ({one: np.full(len(known), np.nan) for one in agents} for _ in range(2))
        for k, (_, facts) in enumerate(known):
            found = np.flatnonzero(() if facts is None else facts.object_id == object_id)
            if facts is None or not len(found):
                continue
            column = int(found[0])
            for row, agent in enumerate(facts.agents):
                if agent == ego_id:
                    distance[k] = np.hypot(*(facts.center[column] - facts.places[row]))
                if facts.points.any():
                    points[agent][k] = facts.points[row, column]
                visible[agent][k] = facts.visible[row, column] if facts.visible.size else np.nan
        return Seen(np.array([row for row, _ in known], np.int64), distance, points, visible)

    def lidars(self, agent_id: int) -> dict[int, NDArray[np.float64]]:
        """(4, 4) world poses of an agent's LiDAR by row, as far as they are read."""
        with self._lock:
            known = [(row, facts) for row, facts in self._facts.items() if facts and agent_id in facts.agents]
        return {row: facts.lidars[facts.agents.index(agent_id)] for row, facts in known}
