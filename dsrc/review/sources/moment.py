"""EpisodeMoment and EpisodeTimeline: a step and the course of an episode as plain arrays."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sensors.frame import AgentFrame
from sim.boxes import Boxes

if TYPE_CHECKING:
    # Meshes take half a second to import, and drives have no contacts.
    from sim.contact import Contact

AROUND_M, CELL_M = 60.0, 0.5
"""Distance from the ego within which unseen places are drawn, and their size, m."""
RUNNING = "running"
"""Outcome of an episode that has not ended."""


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """Receptions of the helpers' messages, one row each.

    Attributes:
        line: (K, 2, 3) float64 from sender to ego, world frame, m; NaN where the log does not place the sender.
        received: (K,) bool.
        senders: (K,) displayed names.
        age_s: (K,) time from the measurement to the percept, s; NaN without a message.
    """

    line: NDArray[np.float64]
    received: NDArray[np.bool_]
    senders: tuple[str, ...]
    age_s: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class EpisodeMoment:
    """Step of an episode as drawn, world frame.

    Attributes:
        time_s: the present, s.
        plan: (K, 4) float64 x, y, z, m, and speed, m/s: the route of the next seconds, as the decision has it.
        route: (R, 2) float64 of the ego, m.
        percept_age_s: age of the newest measurement; NaN without one.
        tracks: confirmed tracks; ids are numbers of tracks.
        track_velocity: (T, 2) float64 m/s.
        links: receptions behind the percept.
        claims: false objects that helpers report.
        claimed_by: (C,) names of these helpers.
        acceleration_mps2: that the driver wants.
        reason: what decided.
        decisive: number of the decisive track, -1 without one.
        contact: first contact, at its step; else None.
        touched: displayed name of whom or what the ego touches then, "" elsewhere.
        unseen: (N, N) places around the ego's LiDAR, rows along y and columns along x, `CELL_M` apart, on which a road
            user may stand that no sweep that arrived shows; None where no sweep is known.
    """

    time_s: float
    plan: NDArray[np.float64]
    route: NDArray[np.float64]
    percept_age_s: float
    tracks: Boxes
    track_velocity: NDArray[np.float64]
    links: Links
    claims: Boxes
    claimed_by: tuple[str, ...]
    acceleration_mps2: float
    reason: str
    decisive: int
    contact: "Contact | None"
    touched: str = ""
    unseen: NDArray[np.bool_] | None = None

    def moved(self, by: NDArray[np.float64]) -> "EpisodeMoment":
        """Moment in a frame whose axes are the world's, moved by (3,) m."""
        return replace(
            self,
            plan=self.plan + np.append(by, 0.0),
            route=self.route + by[:2],
            tracks=replace(self.tracks, center=self.tracks.center + by),
            claims=replace(self.claims, center=self.claims.center + by),
            links=replace(self.links, line=self.links.line + by),
        )


@dataclass(frozen=True, slots=True, eq=False)
class EpisodeTimeline:
    """Course of an episode of T steps, for plots and marks on the timeline.

    Attributes:
        time_s: (T,) float64.
        speed_mps: (T,) float64 of the ego.
        wanted_mps2: (T,) float64 acceleration that the driver wants.
        acceleration_mps2: (T,) float64 that the ego has.
        contact_row: step of the first contact, None without one.
        outcome: how it ended, or `RUNNING`.
        message: explanation of a failed perception, or "".
        closing_mps: speed at which the bodies approached at the first contact; 0 without one.
    """

    time_s: NDArray[np.float64]
    speed_mps: NDArray[np.float64]
    wanted_mps2: NDArray[np.float64]
    acceleration_mps2: NDArray[np.float64]
    contact_row: int | None
    outcome: str
    message: str
    closing_mps: float = 0.0


def unseen_places(agents: Sequence[AgentFrame], ego_id: int) -> NDArray[np.bool_] | None:
    """Places around an ego that no sweep of the agents shows to be free, see `EpisodeMoment.unseen`."""
    # The closed loop takes a second to import; its episodes are open.
    from dsrc.messages.seen_space import seen_of

    if not any(len(agent.sweep) for agent in agents):
        return None
    (ego,) = (agent for agent in agents if agent.agent_id == ego_id)
    offset = np.arange(-AROUND_M, AROUND_M, CELL_M) + 0.5 * CELL_M
    places = np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2) + ego.sweep.world_from_lidar[:2, 3]
    return ~seen_of([(agent, None) for agent in agents]).sees(places).reshape(len(offset), -1)
